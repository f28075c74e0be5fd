# SPDX-License-Identifier: Apache-2.0
"""What is in a recording, and whether it is whole and fits a robot: `replay --check`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.streams import Pairs, Streams, read_streams
from musculoskeletal_ae.bags.topics import interface_topics
from musculoskeletal_ae.exceptions import BagError, MusculoskeletalError, printable
from musculoskeletal_ae.robot.directories import shipped_robots
from musculoskeletal_ae.robot.robot import Robot

# Another muscle must explain a column this much better before its place is doubted: bodies differ
# from their model by some of it, and neighbouring muscles are alike.
_DOUBT = 2.5
_LEAST_MOTION = 0.005  # [m] spread below which a muscle has not moved enough to be told
_MOST_SAMPLES = 2000


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
        lines = [*self.lines, *(f'fault: {fault}' for fault in self.faults)]
        return '\n'.join(map(printable, lines))


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
    fits: list[str] = []
    for name in shipped_robots() if robot is None else [robot]:
        try:
            streams = read_streams(bag, Robot.load(name), namespace=namespace)
            faults = list(_misfits(streams, name))
        except BagError as error:
            faults = [f'does not fit {name}: {error}']
        except MusculoskeletalError as error:
            faults = [str(error)]
        if not faults and not fits:
            check.lines += [f'rejected {n}: {why}' for why, n in streams.rejected.items()]
        fits += [] if faults else [name]
        check.faults += [] if robot is None else faults
    if fits or robot is None:
        check.lines.append(f'fits: {", ".join(fits) or "none of the shipped robots (see --robot)"}')
    return check


def misplaced_muscles(pairs: Pairs, robot: Robot) -> list[tuple[str, str]]:
    """Return (muscle of the column, muscle that it behaves like) where these differ.

    Arrays carry no names. But the true body is like the nominal one, so muscle i must follow

        l̂_j = f_geo(θ) − L_e(f_geo,abs(θ), T)

    best for j = i, up to a constant offset.

    Args:
        pairs: From a recording.
        robot: Whose order of muscles is expected.
    """
    rows = np.linspace(0, len(pairs.time) - 1, min(len(pairs.time), _MOST_SAMPLES)).astype(int)
    if len(rows) < 2:
        return []
    theta = pairs.theta[rows].clip(robot.lower, robot.upper)
    length, tension = pairs.length[rows], pairs.tension[rows]
    moved = length.std(axis=0) > _LEAST_MOTION
    errors = np.empty((robot.muscle_count, robot.muscle_count))
    for i in range(robot.muscle_count):
        # The tension of the column stretches whichever muscle it is.
        alike = np.repeat(tension[:, i : i + 1], robot.muscle_count, axis=1)
        errors[i] = (length[:, i : i + 1] - robot.muscle_lengths(theta, alike)).std(axis=0)
    _, best = linear_sum_assignment(errors)
    return [
        (robot.muscles[i], robot.muscles[j])
        for i, j in enumerate(best)
        if moved[i] and errors[i, i] > _DOUBT * errors[i, j]
    ]


def _contents(bag: Bag, check: BagCheck) -> None:
    timing = {name: _Timing() for name in bag.topics}
    for message in bag.messages():
        timing[message.topic].add(message.log_time)
        if not bag.topics[message.topic].refused:
            bag.decode(message)
    begin = datetime.fromtimestamp(bag.start / 1e9, timezone.utc)
    length = f'{(bag.end - bag.start) / 1e9:.3f} s from {begin:%Y-%m-%d %H:%M:%S} UTC'
    summarised = all(file.summarised for file in bag.files)
    checked = all(file.checked for file in bag.files)
    backward = sum(file.backward for file in bag.files)
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
        line = f'{name:<44} {timed.count:>9} {timed.rate:>9} {timed.gap / 1e9:8.3f}  {topic.type}'
        check.lines.append(f'{line}; ignored: {topic.refused}' if topic.refused else line)
        if timed.count != topic.message_count:
            check.faults.append(f'{name}: {timed.count} of {topic.message_count} messages read')
    check.lines.append('')


@dataclass
class _Timing:
    """Number of messages of a topic, times of the first and last, and longest gap [ns]."""

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
        return f'{(self.count - 1) / span:.2f}' if span else ''


def _misfits(streams: Streams, name: str) -> Iterator[str]:
    if not len(streams.muscles.time) and not len(streams.joints.time):
        yield f'nothing says whether it fits {name}: no joint_states or muscle_states is in it'
    for column, other in misplaced_muscles(streams.pairs(), Robot.load(name)):
        yield f'the order of muscles is not that of {name}: {column} behaves like {other}'
