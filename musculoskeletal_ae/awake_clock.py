# SPDX-License-Identifier: Apache-2.0
"""A clock that excludes the pauses of this process.

A process pauses while it is suspended, or while a busy computer gives it no time. Messages that
arrive during a pause wait unread, so their absence proves nothing about their sender. Code that
decides by the age of messages therefore measures the age on an `AwakeClock`. Of the time between
two ticks of such a clock, at most `longest` counts:

    user                           calls `tick`                 longest
    controller (`DataAge`)         in every step of control     0.3 s
    any node (`Shell`)             ten times a second           0.3 s
    status line (`Situation`)      about once a second          1.0 s
    check_driver (`Pace`)          every 0.02 s                 0.07 s

In a process that is always late, this clock advances by only `longest` for each tick. The process
still notices a silent sender, but later.
"""

import math


class AwakeClock:
    """Steady time without the pauses of this process.

    The clock follows the steady clock until its first tick.
    """

    def __init__(self, longest: float) -> None:
        """Count at most `longest` [s] of the time between two ticks.

        Args:
            longest: Longer than the usual time between two ticks [s].
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
