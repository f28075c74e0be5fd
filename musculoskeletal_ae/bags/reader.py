# SPDX-License-Identifier: Apache-2.0
"""Opens rosbag2 recordings, and reads their messages in chronological order.

bag = Bag.open('my_bag')
for message in bag.messages(): …
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from musculoskeletal_ae.bags import mcap_file, message_types, sqlite3_file
from musculoskeletal_ae.bags.metadata import FILE, read_metadata
from musculoskeletal_ae.bags.storage import (
    CONVERT_ROS1,
    LATEST,
    LONGEST_PAUSE,
    NAME_A_BAG,
    BagMessage,
    BagTopic,
    StorageFile,
    add_topic,
    open_file,
    reading,
)
from musculoskeletal_ae.exceptions import BagError

ROS1_MAGIC = b'#ROSBAG V'  # recognise a bag file of ROS 1, which is refused, by its first bytes
MOST_HELD = 64 << 20  # hold messages of at most this total size in memory to sort them [bytes]
_OVERHEAD = 100  # count this in addition to the data of each message that is held in memory [bytes]


@dataclass
class Bag:
    """A recording: a rosbag2 directory, or one mcap or sqlite3 file."""

    path: Path
    files: list[StorageFile]
    topics: dict[str, BagTopic] = field(default_factory=dict)  # topics by recorded name
    unfinished: list[str] = field(default_factory=list)  # why the recording may be incomplete

    @classmethod
    def open(cls, path: str | Path) -> Bag:
        """Open a recording: read and check all of it.

        If the recorder was killed, the recording is read up to its last complete record, and
        `unfinished` says why the rest is missing.

        Raises:
            BagError: If the recording is damaged, or the path does not name a recording.
        """
        path = Path(path)
        files, count, problem = read_metadata(path) if path.is_dir() else ([path], None, '')
        bag = cls(path, [_open_file(file) for file in files])
        for opened in bag.files:
            for topic in opened.topics.values():
                add_topic(bag.topics, topic, opened.path)
        reasons = [problem, *(opened.unfinished for opened in bag.files)]
        if count not in (None, bag.message_count):
            counts = f'{count} messages; there are {bag.message_count}'
            reasons.append(f'{FILE} counts {counts}')
        bag.unfinished = [reason for reason in reasons if reason]
        return bag

    @property
    def message_count(self) -> int:
        """Number of messages on all topics."""
        return sum(topic.message_count for topic in self.topics.values())

    @property
    def start(self) -> int:
        """Earliest log time [ns], 0 without messages."""
        return min(file.start for file in self.files) if self.message_count else 0

    @property
    def end(self) -> int:
        """Latest log time [ns], 0 without messages."""
        return max(file.end for file in self.files)

    def messages(
        self, topics: Collection[str] | None = None, start: int = 0, stop: int = LATEST
    ) -> Iterator[BagMessage]:
        """Yield the messages whose log times are from `start` to `stop` [ns], both included.

        The messages are sorted by log time, unless more than 64 MiB of messages would have to be
        sorted at once. Messages with the same time keep the order of the file.

        Args:
            topics: Recorded names of the topics, or None for all topics.
            start: Earliest log time [ns].
            stop: Latest log time [ns].
        """
        wanted = frozenset(self.topics if topics is None else topics)
        ordered = (_in_order(file.messages(wanted, start, stop)) for file in self.files)
        return heapq.merge(*ordered, key=lambda message: message.log_time)

    def decode(self, message: BagMessage) -> Any:
        """Decode a message: deserialize it with the type of its topic.

        Raises:
            BagError: If the message does not fit the type of its topic.
        """
        topic = self.topics[message.topic]
        with reading(message.file):
            if topic.problem:
                raise ValueError(f'topic {topic.name} {topic.problem}')
            try:
                return message_types.decode(message.data, topic.type)
            except Exception as error:
                problem = f'a message of {topic.name} is not a valid {topic.type}: {error}'
                raise ValueError(problem) from error


def _open_file(path: Path) -> StorageFile:
    """Open an mcap or sqlite3 file, or raise a BagError."""
    with open_file(path) as stream:
        head = stream.read(len(sqlite3_file.MAGIC))  # long enough for the magic of any format
    if not head:
        raise BagError(path, 'the file is empty', 'record again')
    if head.startswith(sqlite3_file.MAGIC):
        return sqlite3_file.Sqlite3File(path)
    if head.startswith(mcap_file.MAGIC):
        return mcap_file.McapFile(path)
    if head.startswith(ROS1_MAGIC):
        raise BagError(path, 'is a bag file of ROS 1', CONVERT_ROS1)
    raise BagError(path, 'is neither an mcap nor a sqlite3 file', NAME_A_BAG)


def _in_order(messages: Iterator[BagMessage]) -> Iterator[BagMessage]:
    """Yield the messages of a file, which are at most LONGEST_PAUSE out of order, by log time.

    Messages whose sorting would require more than 64 MiB (MOST_HELD) of memory are not sorted.
    """
    waiting: list[tuple[int, int, BagMessage]] = []
    newest = held = 0
    for number, message in enumerate(messages):
        newest = max(newest, message.log_time)
        heapq.heappush(waiting, (message.log_time, number, message))
        held += len(message.data) + _OVERHEAD
        # A single message may be larger than MOST_HELD; this loop then empties `waiting`.
        while waiting and (waiting[0][0] < newest - LONGEST_PAUSE or held > MOST_HELD):
            _, _, earliest = heapq.heappop(waiting)
            held -= len(earliest.data) + _OVERHEAD
            yield earliest
    while waiting:
        yield heapq.heappop(waiting)[-1]
