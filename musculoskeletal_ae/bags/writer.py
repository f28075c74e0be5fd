# SPDX-License-Identifier: Apache-2.0
"""Writes a rosbag2 directory that can be read to the last second if the writer is killed.

`recover` makes a finished bag of what is then left.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from mcap.records import Schema
from mcap.writer import CompressionType, Writer

from musculoskeletal_ae.bags import message_types, metadata
from musculoskeletal_ae.bags.mcap_file import CDR, NO_SCHEMA
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.exceptions import BagError

COMPRESSIONS = {'none': CompressionType.NONE, 'zstd': CompressionType.ZSTD}
# A chunk is also closed when it has grown to this size.
_LARGEST_CHUNK = 1 << 20  # [bytes]


class BagWriter:
    """Writes messages to `DIR/DIR_0.mcap` and metadata.yaml.

    What was written before the last `flush` survives the death of the process.
    """

    def __init__(self, directory: Path, compression: str = 'zstd') -> None:
        """Create the directory; one that exists must be empty, else there is a BagError.

        metadata.yaml names the file after it, so a name that is not UTF-8 is one as well.
        """
        self.directory = Path(directory)
        self._name = f'{self.directory.resolve().name}_0.mcap'
        try:
            self._name.encode()
        except UnicodeEncodeError as error:  # Python's stand-ins for other bytes
            problem = 'the name is not UTF-8'
            raise BagError(self.directory, problem, 'choose another name') from error
        self.topics: dict[str, metadata.Topic] = {}
        self._numbers: dict[str, int] = {}  # of topics
        self._schemas: dict[str, int] = {}
        self._pending: list[tuple[int, str, int, bytes]] = []
        self._pending_size = 0
        self._counts: Counter[str] = Counter()
        self._times: list[int] = []  # the earliest and the latest
        with self._writing():
            new = not self.directory.exists()
            self.directory.mkdir(parents=True, exist_ok=True)
            if any(self.directory.iterdir()):
                raise BagError(self.directory, 'is not empty', 'name a new directory to record to')
            try:
                self._file = (self.directory / self._name).open('xb')
            except OSError:  # its name may be too long where the directory's is not
                if new:
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
        self._write_metadata(finished=False)

    def add_topic(
        self, name: str, type_name: str, qos: Sequence[metadata.Qos], schema: Schema = NO_SCHEMA
    ) -> None:
        """Add a topic by its absolute name.

        The schema is a definition to copy as it is, for a type that is not of ROS 2 Jazzy.
        """
        encoding, text, type_hash = schema.encoding, schema.data, ''
        if message_types.known(type_name):
            type_hash = message_types.type_hash(type_name)
            encoding, text = message_types.ENCODING, message_types.definition(type_name).encode()
        if type_name not in self._schemas:
            self._schemas[type_name] = self._mcap.register_schema(type_name, encoding, text)
        extra = {'offered_qos_profiles': metadata.qos_text(qos), 'topic_type_hash': type_hash}
        number = self._mcap.register_channel(name, CDR, self._schemas[type_name], extra)
        self._numbers[name] = number
        self.topics[name] = metadata.Topic(name, type_name, CDR, qos, type_hash)
        self._write_metadata(finished=False)

    def write(self, topic: str, log_time: int, publish_time: int, data: bytes) -> None:
        """Add a serialized message to a topic; the next `flush` puts it into the file."""
        self._pending.append((log_time, topic, publish_time, data))
        self._pending_size += len(data)
        if self._pending_size > _LARGEST_CHUNK:
            self.flush()

    def flush(self) -> None:
        """Close the chunk and give it to the operating system."""
        # Callbacks of several topics come a little out of order; readers like files in order.
        pending = sorted(self._pending, key=lambda entry: entry[0])
        self._pending, self._pending_size = [], 0
        with self._writing():
            for log_time, topic, publish_time, data in pending:
                self._mcap.add_message(self._numbers[topic], log_time, data, publish_time)
                self._counts[topic] += 1
            self._mcap.flush()
        if pending:
            times = [*self._times, pending[0][0], pending[-1][0]]
            self._times = [min(times), max(times)]

    @property
    def message_count(self) -> int:
        """Messages in the file."""
        return self._counts.total()

    def close(self) -> None:
        """End the file and its metadata.yaml."""
        self.flush()
        with self._writing():
            self._mcap.finish()
            self._file.close()
        self._write_metadata(finished=True)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End the bag; after an error it stays marked as unfinished."""
        if kind is None:
            self.close()
        else:
            with suppress(OSError):  # what Python still holds: the first error says why
                self._file.close()

    def _write_metadata(self, finished: bool) -> None:
        # Counts come with the end: until then readers go by what is in the mcap file.
        counts, times = (self._counts, self._times) if finished else (Counter[str](), [])
        topics = [metadata.TopicCount(topic, counts[name]) for name, topic in self.topics.items()]
        with self._writing():
            metadata.write_metadata(self.directory, self._name, topics, times, finished)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            problem = f'cannot be written: {error.strerror or error}'
            raise BagError(self.directory, problem, 'name another place') from error


def recover(
    path: Path, out: Path | None = None, compression: str = 'zstd'
) -> tuple[Path, int, Path | None, list[str]]:
    """Write all complete messages of an unfinished bag, directory or .mcap, into a finished one.

    Without a new directory `out`, a directory is replaced, and the original kept beside it as
    `DIR.unfinished`; of `FILE.mcap` becomes `FILE_recovered`. Returned are the finished bag, its
    number of messages, where the original is now if it was moved, and which topics were left out:
    a bag as we write it holds CDR and nothing else.
    """
    bag, finished = _open(path)
    if finished and out is None:
        raise BagError(path, 'the recording is finished', 'there is nothing to recover')
    if out is not None or not path.is_dir():
        target = out or path.with_name(f'{path.stem}_recovered')
        return target, _copy(bag, target, compression), None, _not_cdr(bag)
    # The new bag is complete before the old one is touched; its file carries the final name.
    path = path.resolve()
    backup, scratch = _free(path, '.unfinished'), _free(path, '.recovering')
    try:
        messages = _copy(bag, scratch / path.name, compression)
    except BaseException:
        shutil.rmtree(scratch, ignore_errors=True)
        raise
    path.rename(backup)
    (scratch / path.name).rename(path)
    scratch.rmdir()
    return path, messages, backup, _not_cdr(bag)


def _open(path: Path) -> tuple[Bag, bool]:
    """Open what is there, whatever metadata.yaml says; also return whether the bag is finished."""
    try:
        bag = Bag.open(path, unfinished=True)
    except BagError as error:
        files = sorted(path.glob('*.mcap')) if path.is_dir() else []
        # metadata.yaml may be what is wrong: the messages are in the mcap file.
        if len(files) == 1 and error.file == path / metadata.FILE:
            return Bag.open(files[0], unfinished=True), False
        raise
    return bag, not bag.unfinished


def _copy(bag: Bag, target: Path, compression: str) -> int:
    """Write a bag's CDR anew and read it again; return its number of messages."""
    with BagWriter(target, compression) as writer:
        for name, topic in bag.topics.items():
            if topic.encoding == CDR:
                writer.add_topic(name, topic.type, metadata.read_qos(topic.qos), topic.schema)
        for message in bag.messages(writer.topics):
            writer.write(*message[:4])
    return Bag.open(target).message_count


def _not_cdr(bag: Bag) -> list[str]:
    return [name for name, topic in bag.topics.items() if topic.encoding != CDR]


def _free(path: Path, suffix: str) -> Path:
    names = (path.with_name(f'{path.name}{suffix}{n or ""}') for n in count())
    return next(name for name in names if not name.exists())
