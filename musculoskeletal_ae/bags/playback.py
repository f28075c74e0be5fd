# SPDX-License-Identifier: Apache-2.0
"""Playing a recording: what comes in one lap, and recorded time against the steady clock.

recorded(t) = anchor_recorded + rate · (t − anchor_steady),  standing still while paused
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from itertools import chain

from musculoskeletal_ae.bags.mcap_file import BagMessage
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.topics import latched_topics
from musculoskeletal_ae.exceptions import BagError

# A player that was suspended goes on instead of catching up on more than this.
LONGEST_LAG = 1.0  # [s]


def window(bag: Bag, start: float, duration: float | None) -> tuple[int, int]:
    """Return from when to when [ns, recorded] a bag is played: `duration` [s] from `start` [s]."""
    length = (bag.end - bag.start) / 1e9
    if start > length:
        raise BagError(bag.path, f'is {length:.3f} s long', 'give a smaller --start')
    first = bag.start + round(start * 1e9)
    return first, bag.end if duration is None else min(bag.end, first + round(duration * 1e9))


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
