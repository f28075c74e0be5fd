# SPDX-License-Identifier: Apache-2.0
"""What the storage files of a recording have in common: topics, messages, and their errors.

A file is read once from end to end when it is opened. After that its topics, its times and how much
of it is complete are known, and `messages` reads it again.
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

# A topic's log times may go back by this much. More is a jump of the recorder's clock.
LONGEST_DISORDER = 1_000_000_000  # [ns]
LATEST = (1 << 63) - 1  # [ns]; ROS time is signed

DAMAGED = 'use a copy or another recording'
CONVERT = 'convert it with `rosbags-convert` (of the Python package rosbags) or `ros2 bag convert`'

_TOPIC_NAME = re.compile(r'(/[A-Za-z_]\w*)+', re.ASCII)
_LONGEST_NAME = 256  # [characters]


@contextmanager
def reading(file: Path) -> Iterator[None]:
    """Translate every error that reading a recording raises into a BagError.

    Damaged bytes make the libraries raise almost any kind of exception, from struct.error to
    MemoryError. This is the one place where they become a message to the user.
    """
    try:
        yield
    except BagError:
        raise
    except Exception as error:
        reason = ' '.join(str(error).split())[:300]
        problem = f'cannot be read as a recording ({reason or type(error).__name__})'
        raise BagError(file, problem, DAMAGED) from error


@dataclass
class BagTopic:
    """A topic of a recording."""

    name: str  # absolute, as recorded
    type: str
    qos: list[Qos] = field(default_factory=list)  # offered profiles
    encoding: str = CDR  # of its messages
    schema: Schema | None = None  # the recorded definition, to be copied and never used
    problem: str = ''  # why its messages cannot be used; '' if they can
    message_count: int = 0

    @property
    def is_latched(self) -> bool:
        """Whether its last message reaches late joiners."""
        return any(profile.durability == QosDurability.TRANSIENT_LOCAL for profile in self.qos)


class BagMessage(NamedTuple):
    """A message as it was recorded."""

    topic: str  # absolute name
    log_time: int  # when it was received [ns]
    publish_time: int  # when it was sent [ns]; 0 if not recorded
    data: bytes  # serialized
    file: Path  # the storage file it is from


class StorageFile(Protocol):
    """One file of a recording."""

    path: Path
    topics: dict[str, BagTopic]  # by recorded name
    start: int  # earliest log time [ns]; LATEST without messages
    end: int  # latest log time [ns]; 0 without messages
    unfinished: str  # what is known to be missing at its end; '' if nothing is
    has_checksums: bool  # whether these protect all messages

    def messages(
        self, topics: Collection[str], start: int = 0, stop: int = LATEST
    ) -> Iterator[BagMessage]:
        """Yield messages of some topics from start to stop [ns], both included.

        They come in the order of the file, which is that of time within LONGEST_DISORDER.
        """
        ...


def open_file(path: Path) -> BinaryIO:
    """Open a regular file for reading, or raise a BagError."""

    def refuse(file: Path, problem: str) -> BagError:
        return BagError(file, problem, 'name another bag directory or .mcap')

    return open_regular(path, refuse)


def absolute(name: str) -> str:
    """Return the absolute name of a recorded topic."""
    return f'/{name.lstrip("/")}'


def topic_problem(topic: BagTopic, recorded_hash: str) -> str:
    """Return why messages of a topic cannot be used; '' if they can."""
    if len(topic.name) > _LONGEST_NAME or not _TOPIC_NAME.fullmatch(topic.name):
        return 'has a name that no topic of ROS can have'
    if topic.encoding != CDR:
        return f'is encoded as {topic.encoding[:40]!r}, not cdr'
    definition = topic.schema or Schema(0, b'', '', topic.type)
    return mismatch(topic.type, definition.encoding, definition.data, recorded_hash)


def add_topic(topics: dict[str, BagTopic], topic: BagTopic, file: Path) -> BagTopic:
    """Add a topic or find it among those that are there; return it with their messages summed."""
    first = topics.setdefault(topic.name, replace(topic, message_count=0))
    if (first.type, first.problem) != (topic.type, topic.problem):
        problem = f'topic {topic.name} has the types {first.type[:80]}, {topic.type[:80]}'
        raise BagError(file, problem, 'record one type on a topic')
    first.message_count += topic.message_count
    return first
