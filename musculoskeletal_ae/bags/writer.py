# SPDX-License-Identifier: Apache-2.0
"""Writes a rosbag2 directory that remains readable up to the last flush if the writer is killed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from mcap.records import Schema
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Qos

from musculoskeletal_ae.bags import message_types, metadata, sqlite3_file
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.storage import EMPTY, BagTopic
from musculoskeletal_ae.exceptions import BagError

#: compression of the chunks of an mcap file, by the value of the option --compression
COMPRESSIONS = {'none': CompressionType.NONE, 'zstd': CompressionType.ZSTD}
_LARGEST_CHUNK = 1 << 20  # write a chunk to the file once it has reached this size [bytes]


class BagWriter:
    """Writes messages to `DIR/DIR_0.mcap`, and their topics and times to `DIR/metadata.yaml`.

    Messages written before the last `flush` survive a crash of the process.
    """

    def __init__(self, directory: Path, compression: str = 'zstd') -> None:
        """Create the bag directory with an mcap file that contains no messages yet.

        Raises:
            BagError: If the directory exists and is not empty, cannot be written, or has a name
                that is not UTF-8, which metadata.yaml could not contain.
        """
        self.directory = Path(directory)
        self.topics: dict[str, BagTopic] = {}
        self._name = f'{self.directory.resolve().name}_0.mcap'
        try:
            self._name.encode()
        except UnicodeEncodeError as error:
            # Python replaces bytes that are not UTF-8 by surrogates, which cannot be encoded.
            problem = 'the name is not UTF-8'
            raise BagError(self.directory, problem, 'choose another name') from error
        #: further entries of metadata.yaml, which are written when the bag is completed
        self.custom: dict[str, str] = {}
        self._channels: dict[str, int] = {}  # numbers of the channels, by topic
        self._schemas: dict[str, int] = {}  # numbers of the schemas, by type
        self._pending: list[tuple[int, str, int, bytes]] = []
        self._pending_size = 0
        self._times: tuple[int, int] | None = None  # earliest and latest log time [ns]
        self._has_new_topics = True  # whether the next flush must write metadata.yaml
        with self._writing():
            is_new = not self.directory.exists()
            self.directory.mkdir(parents=True, exist_ok=True)
            if any(self.directory.iterdir()):
                raise BagError(self.directory, 'is not empty', 'name a new directory to record to')
            try:
                self._file = (self.directory / self._name).open('xb')
            except OSError:  # the file name can be too long although the directory's name is not
                if is_new:
                    self.directory.rmdir()
                raise
            self._mcap = Writer(
                self._file,
                chunk_size=_LARGEST_CHUNK,
                compression=COMPRESSIONS[compression],
                enable_data_crcs=True,
            )
            self._mcap.start(profile='ros2')
        self.flush()

    def add_topic(
        self, name: str, type_name: str, qos: Sequence[Qos] = (), schema: Schema | None = None
    ) -> None:
        """Add a topic. It appears in metadata.yaml after the next call of `flush`.

        Args:
            name: Absolute name.
            type_name: Message type.
            qos: Offered QoS profiles.
            schema: Definition to copy if ROS 2 Jazzy does not define the type.
        """
        if message_types.is_known(type_name):
            text = message_types.definition(type_name).encode()
            schema = Schema(0, text, message_types.MSG, type_name)
        elif schema is None:
            schema = Schema(0, b'', '', type_name)
        if type_name not in self._schemas:
            number = self._mcap.register_schema(type_name, schema.encoding, schema.data)
            self._schemas[type_name] = number
        extra = {
            'offered_qos_profiles': metadata.qos_text(qos),
            'topic_type_hash': message_types.type_hash(type_name),
        }
        self._channels[name] = self._mcap.register_channel(
            name, message_types.CDR, self._schemas[type_name], extra
        )
        self.topics[name] = BagTopic(name, type_name, qos=list(qos))
        self._has_new_topics = True

    def write(self, topic: str, log_time: int, publish_time: int, data: bytes) -> None:
        """Add a serialized message to a topic; the next `flush` writes it to the file."""
        self._pending.append((log_time, topic, publish_time, data))
        self._pending_size += len(data)
        if self._pending_size > _LARGEST_CHUNK:
            self.flush()

    def flush(self) -> None:
        """Write all messages so far to the file, and pass the data on to the operating system."""
        # Callbacks of several topics run slightly out of order, but readers expect ordered files.
        pending = sorted(self._pending, key=lambda entry: entry[0])
        self._pending, self._pending_size = [], 0
        with self._writing():
            for log_time, topic, publish_time, data in pending:
                self._mcap.add_message(self._channels[topic], log_time, data, publish_time)
                self.topics[topic].message_count += 1
                start, end = self._times or (log_time, log_time)
                self._times = min(start, log_time), max(end, log_time)
            self._mcap.flush()
        if self._has_new_topics:
            self._write_metadata(finished=False)

    @property
    def message_count(self) -> int:
        """Number of messages in the file."""
        return sum(topic.message_count for topic in self.topics.values())

    def close(self) -> None:
        """Complete the file and metadata.yaml."""
        self.flush()
        with self._writing():
            self._mcap.finish()
            self._file.close()
        self._write_metadata(finished=True)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Complete the bag with `close`; after an exception, only close the file."""
        if kind is None:
            self.close()
        else:
            with suppress(OSError):  # flushing may fail again; the first error has the reason
                self._file.close()

    def _write_metadata(self, finished: bool) -> None:
        with self._writing():
            metadata.write_metadata(
                self.directory,
                self._name,
                self.topics.values(),
                self._times,
                finished,
                self.custom,
            )
        self._has_new_topics = False

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            problem = f'cannot be written: {error.strerror or error}'
            raise BagError(self.directory, problem, 'choose another directory') from error


def recover(
    path: Path, target: Path, compression: str = 'zstd'
) -> tuple[int, list[str], list[str]]:
    """Recover a recording: write all readable messages to a new, finished bag.

    Returns:
        The number of messages in the new bag, the topics that were left out because their messages
        are not in CDR, and the files with messages that cannot be read.

    Raises:
        BagError: If no message can be read, or a bag cannot be read or written.
    """
    with TemporaryDirectory(prefix='musculoskeletal_ae-') as folder:
        bag, damaged = _open_damaged(path, Path(folder))
        if not bag.message_count:
            raise BagError(path, *EMPTY)
        with BagWriter(target, compression) as writer:
            for name, topic in bag.topics.items():
                if topic.encoding == message_types.CDR:
                    writer.add_topic(name, topic.type, topic.qos, topic.schema)
            for message in bag.messages(writer.topics):
                writer.write(message.topic, message.log_time, message.publish_time, message.data)
    left_out = [name for name in bag.topics if name not in writer.topics]
    return writer.message_count, left_out, damaged


def _open_damaged(path: Path, folder: Path) -> tuple[Bag, list[str]]:
    """Open a recording; return it, and the names of its damaged files.

    Instead of a damaged sqlite3 file, a copy of its readable rows in `folder` is read.
    """
    try:
        return Bag.open(path), []
    except BagError:
        files = metadata.read_metadata(path)[0] if path.is_dir() else [path]
        damaged = []
        for file in files:
            if sqlite3_file.is_damaged(file):
                sqlite3_file.salvage(file, folder / file.name)
                damaged.append(file.name)
                continue
            for each in (file, *sqlite3_file.logs_of(file)):
                (folder / each.name).symlink_to(each.absolute())
        if not damaged:
            raise
        return Bag.open(folder), damaged
