# SPDX-License-Identifier: Apache-2.0
"""Playing a recording: what comes in one lap, and recorded time against the steady clock.

recorded(t) = anchor_recorded + rate · (t − anchor_steady),  standing still while paused

Or what a hand showed an arm, as a trajectory that the arm can follow: smoothed, evenly spaced.
"""

import math
from collections import defaultdict
from collections.abc import Collection, Iterator
from contextlib import suppress
from itertools import chain
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.bags.mcap_file import BagMessage
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.topics import latched_topics
from musculoskeletal_ae.exceptions import BagError, MessageError
from musculoskeletal_ae.validity import MOST_ENTRIES, read_target

# A player that was suspended goes on instead of catching up on more than this.
LONGEST_LAG = 1.0  # [s]

SHOWN = 'estimated_joint_states'
SMOOTHING = 0.15  # [s] standard deviation: a hand is slower, noise of the estimate is faster
SPACING = 0.1  # [s] between points
LEAD = 3.0  # [s] to go to where it was begun
LEAST = 0.5  # [s]
LONGEST_HOLE = 1.0  # [s] between two messages, over which nobody knows the motion


def window(bag: Bag, start: float, duration: float | None) -> tuple[int, int]:
    """Return from when to when [ns, recorded] a bag is played: `duration` [s] from `start` [s]."""
    length = (bag.end - bag.start) / 1e9
    if start > length:
        raise BagError(bag.path, f'is {length:.3f} s long', 'give a smaller --start')
    first = bag.start + round(start * 1e9)
    if duration is None or duration > length:
        return first, bag.end
    return first, min(bag.end, first + round(duration * 1e9))


def lap(bag: Bag, topics: Collection[str], start: int, stop: int) -> Iterator[BagMessage]:
    """Yield what is published from start to stop [ns, recorded].

    What was latched before the start comes first, as it would reach a late joiner. A message that
    cannot be decoded ends the replay with a BagError: it does not reach the nodes.
    """
    held: dict[str, BagMessage] = {}
    if start > bag.start:
        for message in bag.messages(latched_topics(bag) & set(topics), stop=start - 1):
            held[message.topic] = message._replace(log_time=start - 1)
    for message in chain(held.values(), bag.messages(topics, start, stop)):
        bag.decode(message)
        yield message


class Timeline:
    """Which recorded time it is, `rate` recorded seconds in one second; may stand still."""

    def __init__(self, start: int, rate: float, now: float) -> None:
        """Begin at `start` [ns, recorded] when the steady clock says `now` [s]."""
        self.paused = False
        self._rate, self._recorded, self._steady = rate, start, now

    def recorded(self, now: float) -> int:
        """Return the recorded time [ns]."""
        passed = 0.0 if self.paused else now - self._steady
        return self._recorded + int(passed * self._rate * 1e9)

    def wait(self, recorded: int, now: float) -> float:
        """Return the seconds until a recorded time [ns] is due, infinite if paused before it.

        It is negative for what should have been published before.
        """
        if self.paused:
            return math.inf if recorded > self._recorded else 0.0
        return (recorded - self._recorded) / (self._rate * 1e9) - (now - self._steady)

    def jump(self, recorded: int, now: float) -> None:
        """Make it this recorded time [ns] now; paused, everything up to it is due."""
        self._recorded, self._steady = recorded, now

    def hold(self, paused: bool, now: float) -> None:
        """Stand still, or go on from where it stands."""
        self.jump(self.recorded(now), now)
        self.paused = paused

    def catch_up(self, recorded: int, now: float) -> None:
        """Go on from `recorded` if it should have been published long ago."""
        if self.wait(recorded, now) < -LONGEST_LAG:
            self.jump(recorded, now)


class Shown(NamedTuple):
    """N points of a trajectory."""

    joints: tuple[str, ...]
    time: Array  # from the start of the motion that leads there [s], (N,)
    theta: Array  # [rad], (N, D)
    velocity: Array  # [rad/s], at rest at both ends, (N, D)


def shown(bag: Bag, topic: str, start: int, stop: int) -> Shown:
    """Return the motion on a recorded topic of JointState, from start to stop [ns, recorded].

    It is of the joints that most messages name. A BagError says that there is none, or none that a
    controller could follow.
    """
    found = defaultdict[tuple[str, ...], list[tuple[float, Array]]](list)
    for message in bag.messages([topic], start, stop):
        said = bag.decode(message)
        with suppress(MessageError):  # left out, as a node would
            values = read_target(said, names := sorted(said.name))
            theta = np.array([values[name][0] for name in names])
            found[tuple(names)].append(((message.log_time - start) / 1e9, theta))
    joints = max(found, key=lambda names: len(found[names]), default=())
    seen, theta = map(np.array, zip(*found[joints])) if joints else (np.zeros(1), np.zeros(1))
    if (span := float(seen[-1] - seen[0])) < LEAST:
        problem = f'{topic} holds no motion of at least {LEAST:g} s'
        raise BagError(bag.path, problem, 'record it while the arm is shown one')
    if (hole := float((gaps := np.diff(seen)).max())) > LONGEST_HOLE:
        problem = f'{topic} says nothing for {hole:.1f} s after {seen[gaps.argmax()]:.1f} s'
        raise BagError(bag.path, problem, 'choose a part without holes by --start and --duration')
    if span > (longest := SPACING * (MOST_ENTRIES // len(joints) - 2)):
        problem = f'{topic} goes on for {span:.0f} s, and a trajectory for {longest:.0f} s at most'
        raise BagError(bag.path, problem, 'choose a part by --start and --duration')
    time = np.linspace(seen[0], seen[-1], max(2, round((seen[-1] - seen[0]) / SPACING)) + 1)
    # What lies further off than the longest hole weighs nothing.
    ends = np.searchsorted(seen, [time - LONGEST_HOLE, time + LONGEST_HOLE]).T
    smooth: Array = np.empty((len(time), len(joints)))
    for n, (first, last) in enumerate(ends):
        weight = np.exp(-0.5 * ((time[n] - seen[first:last]) / SMOOTHING) ** 2)
        smooth[n] = weight @ theta[first:last] / weight.sum()
    velocity = np.gradient(smooth, time, axis=0)
    velocity[[0, -1]] = 0.0
    return Shown(joints, LEAD + time - time[0], smooth, velocity)
