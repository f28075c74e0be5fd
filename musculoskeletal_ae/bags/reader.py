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
from typing import Any

from musculoskeletal_ae.bags import message_types
from musculoskeletal_ae.bags.mcap_file import DAMAGED, LATEST, BagMessage, BagTopic, McapFile
from musculoskeletal_ae.bags.metadata import FILE, REMEDY, Metadata, read_metadata
from musculoskeletal_ae.exceptions import BagError, UnfinishedBagError

# Recorders may write checksums at the end only, or none.
UNCHECKED = 'no checksum protects what is left'
# Recorders differ in whether the first message or the earliest one starts the bag.
_TIME_TOLERANCE = 1_000_000_000  # [ns]
# Messages that may be held at once to bring them into order.
_MOST_HELD = 256 << 20  # [bytes]
_OVERHEAD = 100  # [bytes] a message counts beside its data; one chunk always fits


@dataclass
class Bag:
    """A recording that has been read once from end to end and found whole."""

    path: Path  # directory or mcap file
    topics: dict[str, BagTopic] = field(default_factory=dict)  # by recorded name
    unfinished: list[str] = field(default_factory=list)  # why it is not complete; usually empty
    metadata: Metadata | None = None  # None for a bare mcap file
    files: list[McapFile] = field(default_factory=list)

    @classmethod
    def open(cls, path: str | Path, unfinished: bool = False) -> Bag:
        """Read a rosbag2 directory or a bare .mcap from end to end.

        Raises:
            UnfinishedBagError: If it was not ended; `unfinished` allows that and takes what a
                killed recorder left, up to the last complete record.
            BagError: If it is damaged or not what it says.
        """
        bag = cls(Path(path))
        for file in bag._paths():
            bag._add(McapFile.read(file))
        if bag.unfinished and not unfinished:
            problem = f'the recording is unfinished ({"; ".join(bag.unfinished)})'
            remedy = 'run `record --recover` to keep what is there'
            raise UnfinishedBagError(bag.path, problem, remedy)
        if bag.metadata and not bag.unfinished:
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
        self, topics: Collection[str] | None = None, start: int = 0, stop: int = LATEST
    ) -> Iterator[BagMessage]:
        """Yield messages on topics (None: all) from start to stop [ns, log time], both included.

        They come by log time; equal times keep the order of the files. A BagError says that a file
        has changed, or is so far out of order that memory would not do.
        """
        wanted = self.topics.keys() if topics is None else set(topics)
        blocks = [
            (block.start, number, block, file)
            for number, (file, block) in enumerate((f, b) for f in self.files for b in f.blocks)
            if block.start <= stop and block.end >= start and not wanted.isdisjoint(block.topics)
        ]
        # What is earlier than all blocks to come is due; the heap holds what is not.
        heap: list[tuple[int, int, int, BagMessage]] = []
        held = 0
        for begin, number, block, file in sorted(blocks, key=lambda entry: entry[:2]):
            while heap and heap[0] < (begin, number):
                message = heapq.heappop(heap)[-1]
                held -= len(message.data) + _OVERHEAD
                yield message
            for row, message in enumerate(file.messages(block)):
                if message.topic in wanted and start <= message.log_time <= stop:
                    heapq.heappush(heap, (message.log_time, number, row, message))
                    held += len(message.data) + _OVERHEAD
                if held > _MOST_HELD:
                    problem = f'messages are out of order by more than {_MOST_HELD >> 20} MiB'
                    raise BagError(file.path, problem, 'sort the file first', block.offset)
        while heap:
            yield heapq.heappop(heap)[-1]

    def decode(self, message: BagMessage) -> Any:
        """Return the deserialised message; a BagError says that it is not what its type says."""
        topic = self.topics[message.topic]
        try:
            if topic.refused:
                raise ValueError(f'the topic {topic.refused}')
            return message_types.decode(message.data, topic.type)
        except ValueError as error:
            problem = f'a message of {topic.name} cannot be decoded: {error}'
            raise BagError(message.file, problem, DAMAGED, message.offset) from error

    def _paths(self) -> list[Path]:
        if not self.path.is_dir():
            return [self.path]
        self.metadata = read_metadata(self.path)
        if self.metadata is None:
            files = sorted(self.path.glob('*.mcap'))
            if not files:
                raise BagError(self.path, f'has neither {FILE} nor an mcap file', 'name a bag')
            self.unfinished.append(f'{FILE} is missing')
            return files
        if not self.metadata.finished:
            self.unfinished.append(f'{FILE} was not completed')
        return [self.path / name for name in self.metadata.relative_file_paths]

    def _add(self, file: McapFile) -> None:
        self.files.append(file)
        if not file.ended:
            if not file.checked:
                self.unfinished.append(f'{file.path.name}: {UNCHECKED}')
            self.unfinished.append(
                f'{file.path.name} ends at byte {file.size}, within or before the record that '
                f'begins at byte {file.end}'
            )
        for topic in file.channels.values():
            earlier = self.topics.setdefault(topic.name, replace(topic, message_count=0))
            if (earlier.type, earlier.refused) != (topic.type, topic.refused):
                problem = f'topic {topic.name} has the types {earlier.type}, {topic.type}'
                raise BagError(file.path, problem, 'record one type on a topic')
            earlier.message_count += topic.message_count

    def _compare(self, metadata: Metadata) -> None:
        said = {
            (t.topic_metadata.name, t.topic_metadata.type): t.message_count
            for t in metadata.topics_with_message_count
            if t.message_count
        }
        read = {(t.name, t.type): t.message_count for t in self.topics.values() if t.message_count}
        file = self.path / FILE
        if said != read:
            (name, _), _ = min(said.items() ^ read.items())
            problem = (
                f'counts {sum(said.values())} messages, the mcap file has '
                f'{self.message_count}; topic {name[:80]} differs'
            )
            raise BagError(file, problem, REMEDY)
        late = metadata.starting_time.nanoseconds_since_epoch - self.start
        longer = metadata.duration.nanoseconds - (self.end - self.start)
        if read and max(abs(late), abs(longer)) > _TIME_TOLERANCE:
            raise BagError(file, 'has another start or duration than the mcap file', REMEDY)
