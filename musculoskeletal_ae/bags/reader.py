# SPDX-License-Identifier: Apache-2.0
"""Opens recordings: all of the messages in the order of their time, or an error.

bag = Bag.open('my_bag')
for message in bag.messages(): …
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from musculoskeletal_ae.bags import message_types
from musculoskeletal_ae.bags.mcap_file import DAMAGED, BagTopic, McapFile
from musculoskeletal_ae.bags.metadata import FILE, REMEDY, Metadata, read_metadata
from musculoskeletal_ae.exceptions import BagError, UnfinishedBagError

# Recorders may write checksums at the end only, or none.
UNCHECKED = 'no checksum protects what is left'
# Recorders differ in whether the first message or the earliest one starts the bag.
_TIME_TOLERANCE = 1_000_000_000  # [ns]
# Messages that may be held at once to bring them into order.
_MOST_HELD = 256 << 20  # [bytes]
_OVERHEAD = 100  # [bytes] a message counts beside its data; one chunk always fits


class BagMessage(NamedTuple):
    """A message as it was recorded.

    Attributes:
        topic: Absolute name.
        log_time: When it was received [ns].
        publish_time: When it was sent [ns].
        data: Serialized.
        file: The mcap file it is from.
        offset: Where in the file its chunk begins.
    """

    topic: str
    log_time: int
    publish_time: int
    data: bytes
    file: Path
    offset: int


@dataclass
class Bag:
    """A recording that has been read once from end to end and found whole.

    Attributes:
        path: Directory or mcap file.
        topics: By recorded name.
        unfinished: Why the recording is not complete, one entry for each reason; usually empty.
        metadata: metadata.yaml; None for a bare mcap file.
        files: Its mcap files.
    """

    path: Path
    topics: dict[str, BagTopic] = field(default_factory=dict)
    unfinished: list[str] = field(default_factory=list)
    metadata: Metadata | None = None
    files: list[McapFile] = field(default_factory=list)

    @classmethod
    def open(cls, path: str | Path, unfinished: bool = False) -> Bag:
        """Read a directory or a bare .mcap from end to end.

        Args:
            path: A rosbag2 directory or an mcap file.
            unfinished: Take also what a killed recorder left, up to the last complete record.

        Raises:
            UnfinishedBagError: If it was not ended and that is not allowed.
            BagError: If it is damaged or not what it says.
        """
        bag = cls(Path(path))
        for file in bag._paths():
            bag._add(McapFile.read(file))
        if bag.unfinished and not unfinished:
            problem = f'the recording is unfinished ({"; ".join(bag.unfinished)})'
            remedy = 'run `record --recover` to keep what is there'
            raise UnfinishedBagError(bag.path, None, problem, remedy)
        if bag.metadata is not None and not bag.unfinished:
            bag._compare(bag.metadata)
        return bag

    @property
    def message_count(self) -> int:
        """Number of messages on all topics."""
        return sum(topic.message_count for topic in self.topics.values())

    @property
    def start(self) -> int:
        """Earliest log time [ns], 0 without messages."""
        return min((block.start for file in self.files for block in file.blocks), default=0)

    @property
    def end(self) -> int:
        """Latest log time [ns], 0 without messages."""
        return max((block.end for file in self.files for block in file.blocks), default=0)

    def messages(
        self,
        topics: Collection[str] | None = None,
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[BagMessage]:
        """Yield messages by log time; equal times keep the order of the files.

        Args:
            topics: Recorded names; None for all.
            start: Log times from here [ns].
            stop: Log times up to here, included [ns].

        Raises:
            BagError: If a file has changed, or is so far out of order that memory would not do.
        """
        wanted = self.topics.keys() if topics is None else set(topics)
        first = self.start if start is None else start
        last = self.end if stop is None else stop
        blocks = [
            (block.start, number, block, file)
            for number, (file, block) in enumerate((f, b) for f in self.files for b in f.blocks)
            if block.start <= last and block.end >= first and not wanted.isdisjoint(block.topics)
        ]
        # What is earlier than all blocks to come is due; the heap holds what is not.
        heap: list[tuple[int, int, int, BagMessage]] = []
        held = 0
        for begin, number, block, file in sorted(blocks, key=lambda entry: entry[:2]):
            while heap and heap[0] < (begin, number):
                message = heapq.heappop(heap)[-1]
                held -= len(message.data) + _OVERHEAD
                yield message
            for row, (name, read) in enumerate(file.messages(block)):
                time, sent, data = read.log_time, read.publish_time, read.data
                if name in wanted and first <= time <= last:
                    message = BagMessage(name, time, sent, data, file.path, block.offset)
                    heapq.heappush(heap, (time, number, row, message))
                    held += len(message.data) + _OVERHEAD
                if held > _MOST_HELD:
                    problem = f'messages are out of order by more than {_MOST_HELD >> 20} MiB'
                    raise BagError(file.path, block.offset, problem, 'sort the file first')
        while heap:
            yield heapq.heappop(heap)[-1]

    def decode(self, message: BagMessage) -> Any:
        """Return the deserialised message.

        Raises:
            BagError: If its bytes are not what its type says.
        """
        topic = self.topics[message.topic]
        try:
            if topic.refused:
                raise ValueError(f'the topic {topic.refused}')
            return message_types.decode(message.data, topic.type)
        except ValueError as error:
            problem = f'a message of {topic.name} cannot be decoded: {error}'
            raise BagError(message.file, message.offset, problem, DAMAGED) from error

    def _paths(self) -> list[Path]:
        remedy = 'name a bag directory or .mcap'
        if not self.path.is_dir():
            if not self.path.exists():
                raise BagError(self.path, None, 'does not exist', remedy)
            return [self.path]
        try:
            self.metadata = read_metadata(self.path)
        except UnfinishedBagError:
            files = sorted(self.path.glob('*.mcap'))
            if not files:
                problem = 'has neither metadata.yaml nor an mcap file'
                raise BagError(self.path, None, problem, remedy) from None
            self.unfinished.append(f'{FILE} is missing')
            return files
        if not self.metadata.finished:
            self.unfinished.append(f'{FILE} was not completed')
        return [self.path / name for name in self.metadata.files]

    def _add(self, file: McapFile) -> None:
        self.files.append(file)
        if file.cut is not None:
            if not file.checked:
                self.unfinished.append(f'{file.path.name}: {UNCHECKED}')
            self.unfinished.append(
                f'{file.path.name} ends at byte {file.size}, within or before the record that '
                f'begins at byte {file.cut}'
            )
        for topic in file.channels.values():
            earlier = self.topics.setdefault(topic.name, replace(topic, message_count=0))
            if (earlier.type, earlier.refused) != (topic.type, topic.refused):
                problem = f'topic {topic.name} has the types {earlier.type}, {topic.type}'
                raise BagError(file.path, None, problem, 'record one type on a topic')
            earlier.message_count += topic.message_count

    def _compare(self, metadata: Metadata) -> None:
        file = self.path / FILE
        said = {(t.name, t.type): t.message_count for t in metadata.topics if t.message_count}
        read = {(t.name, t.type): t.message_count for t in self.topics.values() if t.message_count}
        if said != read:
            name = min(said.items() ^ read.items())[0][0]
            problem = (
                f'counts {sum(said.values())} messages, the mcap file has '
                f'{self.message_count}; topic {name[:80]} differs'
            )
            raise BagError(file, None, problem, REMEDY)
        late = abs((metadata.start or 0) - self.start)
        longer = abs(metadata.duration - (self.end - self.start))
        if read and max(late, longer) > _TIME_TOLERANCE:
            raise BagError(file, None, 'has another start or duration than the mcap file', REMEDY)
