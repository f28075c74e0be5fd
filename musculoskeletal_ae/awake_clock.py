# SPDX-License-Identifier: Apache-2.0
"""A clock that excludes the pauses of this process.

A process pauses while it is suspended, or while a busy computer gives it no time. Messages that
arrive meanwhile wait unread, so their absence proves nothing about their sender. Whoever decides
from the age of messages measures it on an `AwakeClock`. All of them follow one rule: of the time
between two ticks, only the first `longest` counts. They differ in how often they tick:

    user                           ticks                        longest
    controller (`DataAge`)         in every step of control     0.3 s
    any node (`Shell`)             ten times a second           0.3 s
    status line (`Situation`)      about once a second          1.0 s
    check_driver (`Pace`)          every 0.02 s                 0.07 s

A process that is always late still notices a silent sender, but `longest` a tick only.
"""

import math


class AwakeClock:
    """Steady time without the pauses of this process.

    The clock follows the steady clock until its first tick.
    """

    def __init__(self, longest: float) -> None:
        """Count at most `longest` [s] between two ticks; it must exceed their usual distance."""
        self._longest = longest
        self._ticked_at = math.inf  # steady time of the last tick [s]
        self._paused = 0.0  # total duration of the pauses until then [s]

    def tick(self, now: float) -> None:
        """Record that this process runs at `now` on the steady clock [s]."""
        self._paused += self._pause(now)
        self._ticked_at = now

    def at(self, now: float) -> float:
        """Return the awake time [s] at `now` on the steady clock [s], at or after the last tick."""
        return now - self._paused - self._pause(now)

    def _pause(self, now: float) -> float:
        """Return the pause since the last tick, which the next tick will record [s]."""
        return max(now - self._ticked_at - self._longest, 0.0)
