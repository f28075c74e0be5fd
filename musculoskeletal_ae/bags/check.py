# SPDX-License-Identifier: Apache-2.0
"""What is in a recording, and whether it is whole and fits a robot: `replay --check`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path

from musculoskeletal_ae.bags.muscle_order import misplaced_muscles
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.selection import interface_topics
from musculoskeletal_ae.bags.streams import Streams, read_streams
from musculoskeletal_ae.bags.topics import TOPICS
from musculoskeletal_ae.exceptions import BagError, MusculoskeletalError
from musculoskeletal_ae.robot.directories import shipped_robots
from musculoskeletal_ae.robot.robot import Robot


@dataclass
class BagCheck:
    """The report on a recording.

    Attributes:
        lines: What is in it.
        faults: Why it is not whole or does not fit; empty if all is well.
    """

    lines: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return '\n'.join([*self.lines, *(f'fault: {fault}' for fault in self.faults)])


@dataclass
class _Timing:
    count: int = 0
    first: int = 0
    last: int = 0
    gap: int = 0

    def add(self, time: int) -> None:
        if self.count:
            self.gap = max(self.gap, time - self.last)
        else:
            self.first = time
        self.last = time
        self.count += 1

    @property
    def rate(self) -> str:
        span = (self.last - self.first) / 1e9
        return f'{(self.count - 1) / span:9.2f}' if span else f'{"":>9}'


def check_bag(path: Path, robot: str | None = None, namespace: str | None = None) -> BagCheck:
    """Read a recording from end to end, every message included, and report.

    Args:
        path: A directory or a bare .mcap.
        robot: Shipped name or directory; None says which of the shipped robots it fits.
        namespace: The one that is meant where the bag has several.
    """
    check = BagCheck()
    try:
        bag = Bag.open(path, unfinished=True)
        check.faults += [f'unfinished: {reason}' for reason in bag.unfinished]
        _contents(bag, check)
        interface_topics(bag, namespace)
    except MusculoskeletalError as error:
        check.faults.append(str(error))
        return check
    if robot is not None:
        _fit(bag, robot, namespace, check)
    else:
        fits = [name for name in shipped_robots() if not _faults(bag, name, namespace)]
        for name in fits[:1]:
            _rejections(bag, name, namespace, check)
        check.lines.append(f'fits: {", ".join(fits) or "none of the shipped robots (see --robot)"}')
    return check


def _contents(bag: Bag, check: BagCheck) -> None:
    timing = {name: _Timing() for name in bag.topics}
    for message in bag.messages():
        timing[message.topic].add(message.log_time)
        if not bag.topics[message.topic].refused:
            bag.decode(message)
    begin = datetime.fromtimestamp(bag.start / 1e9, timezone.utc)
    summarised = all(found.summarised for found in bag.scans)
    backward = sum(found.backward for found in bag.scans)
    length = f'{(bag.end - bag.start) / 1e9:.3f} s from {begin:%Y-%m-%d %H:%M:%S} UTC'
    checked = all(found.checked for found in bag.scans)
    summary = 'as in the summary' if summarised else 'no summary to compare with'
    metadata = 'as in' if bag.metadata and not bag.unfinished else 'no final'
    check.lines += [
        f'{bag.path}: {bag.message_count} messages, {length}',
        f'counts: {summary}, {metadata} metadata.yaml',
        f'checksums: {"of everything" if checked else "none, or not of everything"}',
        f'order: {backward or "no"} messages in the file are earlier than the one before',
        '',
        f'{"topic":<44} {"messages":>9} {"Hz":>9} {"gap s":>8}  type',
    ]
    for name, topic in sorted(bag.topics.items()):
        timed = timing[name]
        line = f'{name:<44} {timed.count:>9} {timed.rate} {timed.gap / 1e9:8.3f}  {topic.type}'
        check.lines.append(f'{line}; ignored: {topic.refused}' if topic.refused else line)
        if timed.count != topic.message_count:
            check.faults.append(f'{name}: {timed.count} of {topic.message_count} messages read')
    check.lines.append('')


def _fit(bag: Bag, robot: str, namespace: str | None, check: BagCheck) -> None:
    faults = _faults(bag, robot, namespace)
    check.faults += faults
    if faults:
        return
    _rejections(bag, robot, namespace, check)
    check.lines.append(f'fits: {robot}')


def _rejections(bag: Bag, robot: str, namespace: str | None, check: BagCheck) -> None:
    streams = read_streams(bag, Robot.load(robot), namespace=namespace)
    check.lines += [f'rejected {count}: {why}' for why, count in streams.rejected.items()]


def _faults(bag: Bag, name: str, namespace: str | None) -> list[str]:
    try:
        robot = Robot.load(name)
        streams = read_streams(bag, robot, namespace=namespace)
    except BagError as error:
        return [f'does not fit {name}: {error}']
    except MusculoskeletalError as error:
        return [str(error)]
    return [*_empty(streams, name), *_misplaced(streams, robot, name)]


def _empty(streams: Streams, name: str) -> Iterable[str]:
    if not len(streams.muscles.time) and not len(streams.joints.time):
        listed = ', '.join(topic for topic in TOPICS if topic in ('joint_states', 'muscle_states'))
        yield f'nothing says whether it fits {name}: none of {listed} is in it'


def _misplaced(streams: Streams, robot: Robot, name: str) -> Iterable[str]:
    for column, other in misplaced_muscles(streams.pairs(), robot):
        yield f'the order of muscles is not that of {name}: {column} behaves like {other}'
