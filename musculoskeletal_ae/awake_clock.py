# SPDX-License-Identifier: Apache-2.0
"""A clock that excludes the pauses of this process.

A process pauses while it is suspended, or while a busy computer gives it no time. Messages that
arrive during a pause wait unread, so their absence proves nothing about their sender. Whether a
sender is silent is therefore decided by the age of its messages on an `AwakeClock`
(`messages/arrival.py`).

Each node has one such clock. It ticks ten times a second (`nodes/shell.py`), and in each step of
the controller; that of `view` ticks in its loop, and that of `check_driver` every 0.02 s. Of the
time between two ticks, at most `longest` counts. In a process that is always late, the clock
advances by only `longest` for each tick. The process still notices a silent sender, but later.

The arm moves on during a pause of this process. How far it can have moved since the last message
therefore depends on the time of the steady clock, not on the time of this clock.
"""

import math

PAUSE = 0.3  # treat the part of the time between two ticks that exceeds this as a pause [s]


class AwakeClock:
    """Steady time without the pauses of this process.

    The clock follows the steady clock until its first tick.
    """

    def __init__(self, longest: float = PAUSE) -> None:
        """Count at most `longest` [s] of the time between two ticks.

        Args:
            longest: Longest time that counts in full [s]; must exceed the usual time between ticks.
        """
        self._longest = longest
        self._ticked_at = math.inf  # steady time of the last tick [s]
        self._paused = 0.0  # total duration of the pauses until the last tick [s]

    def tick(self, now: float) -> None:
        """Record that this process runs at `now` on the steady clock [s]."""
        self._paused += self._pause(now)
        self._ticked_at = now

    def at(self, now: float) -> float:
        """Return the awake time [s] at `now` on the steady clock [s], at or after the last tick."""
        return now - self._paused - self._pause(now)

    def _pause(self, now: float) -> float:
        """Return the part of the time since the last tick that exceeds `longest` [s]."""
        return max(now - self._ticked_at - self._longest, 0.0)
