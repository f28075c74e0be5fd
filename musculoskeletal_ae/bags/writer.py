# SPDX-License-Identifier: Apache-2.0
"""Writes a rosbag2 directory that can be read to the last second if the writer is killed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from mcap.records import Schema
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Qos

from musculoskeletal_ae.bags import definitions
from musculoskeletal_ae.bags.metadata import Metadata, TopicCount, qos_text, write_metadata
from musculoskeletal_ae.exceptions import BagError

COMPRESSIONS = {'none': CompressionType.NONE, 'zstd': CompressionType.ZSTD}
# A chunk is also closed when it has grown to this size.
_LARGEST_CHUNK = 1 << 20


class BagWriter:
    """Writes messages to `DIR/DIR_0.mcap` and metadata.yaml.

    What was written before the last `flush` survives the death of the process.
    """

    def __init__(self, directory: Path, compression: str = 'zstd') -> None:
        """Create the directory; one that exists must be empty.

        Raises:
            BagError: If it cannot be written to.
        """
        self.directory = Path(directory)
        self._name = f'{self.directory.resolve().name}_0.mcap'
        self._topics: dict[int, TopicCount] = {}
        self._schemas: dict[str, int] = {}
        self._pending: list[tuple[int, int, int, bytes]] = []
        self._pending_size = 0
        self._times: tuple[int, int] | None = None
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            if any(self.directory.iterdir()):
                raise BagError(
                    self.directory, None, 'is not empty', 'name a new directory to record to'
                )
            self._file = (self.directory / self._name).open('xb')
        except OSError as error:
            raise self._unwritable(error) from error
        self._mcap = Writer(
            self._file,
            chunk_size=_LARGEST_CHUNK,
            compression=COMPRESSIONS[compression],
            enable_data_crcs=True,
        )
        self._mcap.start(profile='ros2')
        self.flush()
        self._write_metadata(finished=False)

    def add_topic(
        self, name: str, type_name: str, qos: Sequence[Qos], schema: Schema | None = None
    ) -> int:
        """Add a topic and return its number.

        Args:
            name: Absolute name.
            type_name: Its message type.
            qos: Profiles its publishers offer.
            schema: A definition to copy as it is, for a type that is not of ROS 2 Jazzy.
        """
        if definitions.known(type_name):
            text, type_hash = definitions.definition(type_name), definitions.type_hash(type_name)
            schema = Schema(0, text.encode(), definitions.ENCODING, type_name)
        else:
            type_hash = ''
        if type_name not in self._schemas:
            schema = schema or Schema(0, b'', '', type_name)
            self._schemas[type_name] = self._mcap.register_schema(
                schema.name, schema.encoding, schema.data
            )
        extra = {'offered_qos_profiles': qos_text(qos), 'topic_type_hash': type_hash}
        number = self._mcap.register_channel(name, 'cdr', self._schemas[type_name], extra)
        self._topics[number] = TopicCount(name, type_name, 0, qos, type_hash)
        self._write_metadata(finished=False)
        return number

    def write(self, topic: int, log_time: int, publish_time: int, data: bytes) -> None:
        """Add a message; it is in the file after the next `flush`.

        Args:
            topic: Number from `add_topic`.
            log_time: When it was received [ns].
            publish_time: When it was sent [ns].
            data: Serialized message.
        """
        self._pending.append((log_time, topic, publish_time, data))
        self._pending_size += len(data)
        if self._pending_size > _LARGEST_CHUNK:
            self.flush()

    def flush(self) -> None:
        """Close the chunk and give it to the operating system."""
        # Callbacks of several topics come a little out of order; readers like files in order.
        self._pending.sort(key=lambda entry: entry[0])
        try:
            for log_time, topic, publish_time, data in self._pending:
                self._mcap.add_message(topic, log_time, data, publish_time)
                self._topics[topic] = self._topics[topic]._replace(
                    message_count=self._topics[topic].message_count + 1
                )
            if self._pending:
                first, last = self._pending[0][0], self._pending[-1][0]
                earliest, latest = self._times or (first, last)
                self._times = min(first, earliest), max(last, latest)
            self._mcap.flush()
        except OSError as error:
            raise self._unwritable(error) from error
        finally:
            self._pending, self._pending_size = [], 0

    @property
    def message_count(self) -> int:
        """Messages in the file."""
        return sum(topic.message_count for topic in self._topics.values())

    def close(self) -> None:
        """End the file and its metadata.yaml."""
        self.flush()
        try:
            self._mcap.finish()
            self._file.close()
        except OSError as error:
            raise self._unwritable(error) from error
        self._write_metadata(finished=True)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End the bag; after an error it stays marked as unfinished."""
        if error is None:
            self.close()
        else:
            self._file.close()

    def _write_metadata(self, finished: bool) -> None:
        start, last = self._times or (None, 0)
        # Counts come with the end: until then readers go by what is in the mcap file.
        topics = [t if finished else t._replace(message_count=0) for t in self._topics.values()]
        if not finished:
            start = None
        duration = last - start if start is not None else 0
        try:
            write_metadata(
                self.directory, Metadata([self._name], topics, start, duration, finished)
            )
        except OSError as error:
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> BagError:
        reason = error.strerror or str(error)
        return BagError(self.directory, None, f'cannot be written: {reason}', 'name another place')
