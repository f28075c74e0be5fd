# SPDX-License-Identifier: Apache-2.0
"""Opens recordings: all of the messages in the order of their time, or an error.

bag = Bag.open('my_bag')
for message in bag.messages(): …
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from mcap.records import Schema

from musculoskeletal_ae.bags import definitions
from musculoskeletal_ae.bags.metadata import FILE, REMEDY, Metadata, read_metadata
from musculoskeletal_ae.bags.order import BagMessage, in_order
from musculoskeletal_ae.bags.records import DAMAGED
from musculoskeletal_ae.bags.scan import Scan, scan
from musculoskeletal_ae.exceptions import BagError, UnfinishedBagError

# Recorders may write checksums at the end only, or none.
UNCHECKED = 'no checksum protects what is left'
# Recorders differ in whether the first message or the earliest one starts the bag.
_TIME_TOLERANCE = 1_000_000_000  # [ns]


class BagTopic(NamedTuple):
    """A topic of a bag.

    Attributes:
        name: Absolute, as recorded.
        type: Message type.
        message_count: Number of messages.
        qos: Offered QoS profiles, YAML.
        refused: Why its messages cannot be used, '' if they can.
        schema: The recorded definition, to be copied and never used.
    """

    name: str
    type: str
    message_count: int
    qos: str
    refused: str
    schema: Schema


@dataclass
class Bag:
    """A recording that has been read once from end to end and found whole.

    Attributes:
        path: Directory or mcap file.
        topics: By recorded name.
        unfinished: Why the recording is not complete, one entry for each reason; usually empty.
        metadata: metadata.yaml; None for a bare mcap file.
        scans: What was found in each mcap file.
    """

    path: Path
    topics: dict[str, BagTopic] = field(default_factory=dict)
    unfinished: list[str] = field(default_factory=list)
    metadata: Metadata | None = None
    scans: list[Scan] = field(default_factory=list)

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
        for file in bag._files():
            bag._add(scan(file))
        if bag.unfinished and not unfinished:
            raise UnfinishedBagError(
                bag.path,
                None,
                f'the recording is unfinished ({"; ".join(bag.unfinished)})',
                'run `record --recover` to keep what is there',
            )
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
        return min((block.start for found in self.scans for block in found.blocks), default=0)

    @property
    def end(self) -> int:
        """Latest log time [ns], 0 without messages."""
        return max((block.end for found in self.scans for block in found.blocks), default=0)

    def messages(
        self,
        topics: Collection[str] | None = None,
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[BagMessage]:
        """Yield messages by log time; equal times keep the order of the file.

        Args:
            topics: Recorded names; None for all.
            start: Log times from here [ns].
            stop: Log times up to here, included [ns].

        Raises:
            BagError: If the file has changed, or is so far out of order that memory would not do.
        """
        return in_order(
            self.scans,
            self.topics.keys() if topics is None else topics,
            self.start if start is None else start,
            self.end if stop is None else stop,
        )

    def decode(self, message: BagMessage) -> Any:
        """Return the deserialised message.

        Raises:
            BagError: If its bytes are not what its type says.
        """
        topic = self.topics[message.topic]
        try:
            if topic.refused:
                raise ValueError(f'the topic {topic.refused}')
            return definitions.decode(message.data, topic.type)
        except ValueError as error:
            problem = f'a message of {topic.name} cannot be decoded: {error}'
            raise BagError(message.file, message.offset, problem, DAMAGED) from error

    def _files(self) -> list[Path]:
        if not self.path.is_dir():
            if not self.path.exists():
                raise BagError(self.path, None, 'does not exist', 'name a bag directory or .mcap')
            return [self.path]
        try:
            self.metadata = read_metadata(self.path)
        except UnfinishedBagError:
            files = sorted(self.path.glob('*.mcap'))
            if not files:
                problem = 'has neither metadata.yaml nor an mcap file'
                raise BagError(self.path, None, problem, 'name a bag directory or .mcap') from None
            self.unfinished.append(f'{FILE} is missing')
            return files
        if not self.metadata.finished:
            self.unfinished.append(f'{FILE} was not completed')
        return [self.path / name for name in self.metadata.files]

    def _add(self, found: Scan) -> None:
        self.scans.append(found)
        if found.cut is not None:
            if not found.checked:
                self.unfinished.append(f'{found.path.name}: {UNCHECKED}')
            self.unfinished.append(
                f'{found.path.name} ends at byte {found.size}, within or before the record that '
                f'begins at byte {found.cut}'
            )
        for key, channel in found.channels.by_id.items():
            count = found.counts[key]
            earlier = self.topics.get(channel.topic)
            if earlier:
                if (earlier.type, earlier.refused) != (channel.type, channel.refused):
                    problem = f'topic {channel.topic} has the types {earlier.type}, {channel.type}'
                    raise BagError(found.path, None, problem, 'record one type on a topic')
                count += earlier.message_count
            self.topics[channel.topic] = BagTopic(
                channel.topic, channel.type, count, channel.qos, channel.refused, channel.schema
            )

    def _compare(self, metadata: Metadata) -> None:
        file = self.path / FILE
        said = {
            (topic.name, topic.type): topic.message_count
            for topic in metadata.topics
            if topic.message_count
        }
        read = {(t.name, t.type): t.message_count for t in self.topics.values() if t.message_count}
        if said != read:
            name = min(said.items() ^ read.items())[0][0]
            problem = (
                f'counts {metadata.message_count} messages, the mcap file has '
                f'{self.message_count}; topic {name[:80]} differs'
            )
            raise BagError(file, None, problem, REMEDY)
        if read:
            late = abs((metadata.start or 0) - self.start)
            longer = abs(metadata.duration - (self.end - self.start))
            if max(late, longer) > _TIME_TOLERANCE:
                problem = 'has another start or duration than the mcap file'
                raise BagError(file, None, problem, REMEDY)
