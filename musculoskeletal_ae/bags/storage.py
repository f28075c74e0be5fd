# SPDX-License-Identifier: Apache-2.0
"""Common parts of the storage formats: topics, messages and errors.

Opening a file reads the whole file once, to find its topics, its times and the end of its complete
part. `messages` then reads the file again.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol

from mcap.records import Schema
from rosbags.interfaces import Qos, QosDurability

from musculoskeletal_ae.bags.message_types import CDR, mismatch
from musculoskeletal_ae.exceptions import BagError
from musculoskeletal_ae.files import open_regular

#: refuse a recording in which the log times of a topic go back by more than this [ns]: the clock of
#: the recorder has jumped
LONGEST_DISORDER = 1_000_000_000
#: refuse a recording in which messages of different topics are out of order by more than this [ns];
#: a recorder that was paused for a shorter time writes one topic after the other
LONGEST_PAUSE = 10_000_000_000
LATEST = (1 << 63) - 1  # the largest ROS time [ns]; stands for the end of any recording

ROS1 = 'ros1'  # the message encoding of ROS 1
DAMAGED = 'use a copy or another recording'  # remedy for a damaged recording
#: remedy if a path is not a recording
NAME_A_BAG = 'name a bag directory, or one mcap or sqlite3 file'
#: remedy for messages of ROS 1; their definitions have to become those of ROS 2
CONVERT_ROS1 = (
    'convert the bag file of ROS 1 with `rosbags-convert --src FILE.bag --dst DIR '
    '--dst-typestore ros2_jazzy` (of the Python package rosbags)'
)
#: problem and remedy of a recording of which nothing can be read
EMPTY = 'contains no complete message', 'record again, or use another recording'
#: remedy for a recording that is valid for ROS 2, but that this package does not read
CONVERT = 'convert it with `rosbags-convert` (of the Python package rosbags) or `ros2 bag convert`'

_TOPIC_NAME = re.compile(r'(/[A-Za-z_]\w*)+', re.ASCII)
_LONGEST_NAME = 256  # refuse a longer name of a topic [characters]


@contextmanager
def reading(file: Path, remedy: str = DAMAGED) -> Iterator[None]:
    """Turn every exception raised while reading a recording into a BagError with this remedy.

    With damaged files, the libraries raise almost any type of exception, from struct.error to
    MemoryError.
    """
    try:
        yield
    except BagError:
        raise
    except Exception as error:
        reason = ' '.join(str(error).split())[:300]
        problem = f'cannot be read as a recording ({reason or type(error).__name__})'
        raise BagError(file, problem, remedy) from error


@dataclass
class BagTopic:
    """A topic of a recording: its name, its type, and whether its messages can be used."""

    name: str  # absolute name, as recorded
    type: str  # message type, such as 'sensor_msgs/msg/Imu'
    qos: list[Qos] = field(default_factory=list)  # QoS profiles that its publishers offered
    encoding: str = CDR  # encoding of its messages
    schema: Schema | None = None  # the recorded definition of the type
    problem: str = ''  # why its messages cannot be used; '' if they can
    message_count: int = 0

    @property
    def is_of_ros1(self) -> bool:
        """Whether its messages were recorded with ROS 1."""
        return self.encoding.lower() == ROS1

    @property
    def is_latched(self) -> bool:
        """Whether a subscriber that joins later receives the last message of the topic."""
        return any(profile.durability == QosDurability.TRANSIENT_LOCAL for profile in self.qos)


class BagMessage(NamedTuple):
    """A recorded message, still serialized, with its times."""

    topic: str  # absolute name of its topic
    log_time: int  # time of reception [ns]
    publish_time: int  # time of publication [ns]; 0 if not recorded
    data: bytes  # the message, serialized with the encoding of its topic
    file: Path  # the storage file that contains it


class StorageFile(Protocol):
    """One mcap or sqlite3 file of a recording, from which messages are read."""

    path: Path
    topics: dict[str, BagTopic]  # topics by recorded name
    start: int  # earliest log time [ns]; LATEST without messages
    end: int  # latest log time [ns]; 0 without messages
    unfinished: str  # why the end of the file is missing; '' if the file is complete
    has_checksums: bool  # whether checksums protect all messages

    def messages(
        self, topics: Collection[str], start: int = 0, stop: int = LATEST
    ) -> Iterator[BagMessage]:
        """Yield messages of these topics from start to stop [ns], both included.

        The messages keep the order of the file, in which log times may go back by up to 10 s.
        """
        ...


def open_file(path: Path) -> BinaryIO:
    """Open a regular file for reading.

    Raises:
        BagError: If the file cannot be opened, or if it is not a regular file.
    """

    def refuse(file: Path, problem: str) -> BagError:
        return BagError(file, problem, 'name another bag directory, mcap or sqlite3 file')

    return open_regular(path, refuse)


def absolute(name: str) -> str:
    """Return the absolute name of a recorded topic."""
    return f'/{name.lstrip("/")}'


def topic_problem(topic: BagTopic, recorded_hash: str) -> str:
    """Return why the messages of a topic cannot be used, as a text for users; '' if they can.

    The text continues a sentence that begins with the topic.
    """
    if len(topic.name) > _LONGEST_NAME or not _TOPIC_NAME.fullmatch(topic.name):
        return 'has a name that is not legal in ROS'
    if topic.encoding != CDR:
        return f'is encoded as {topic.encoding[:40]!r}, not cdr'
    definition = topic.schema or Schema(0, b'', '', topic.type)
    return mismatch(topic.type, definition.encoding, definition.data, recorded_hash)


def add_topic(topics: dict[str, BagTopic], topic: BagTopic, file: Path) -> BagTopic:
    """Add a topic to `topics`, or its message count to the topic of the same name.

    Returns:
        The topic in `topics`.

    Raises:
        BagError: If the topic of the same name has another type or definition.
    """
    first = topics.setdefault(topic.name, replace(topic, message_count=0))
    if (first.type, first.problem) != (topic.type, topic.problem):
        if first.type != topic.type:
            problem = f'topic {topic.name} has the types {first.type[:80]} and {topic.type[:80]}'
            raise BagError(file, problem, 'record a topic with one type only')
        problem = f'topic {topic.name} was recorded with two definitions of {topic.type[:80]}'
        raise BagError(file, problem, 'record the topic with ROS 2 Jazzy only')
    first.message_count += topic.message_count
    return first
