# SPDX-License-Identifier: Apache-2.0
"""Measures how late messages arrive, so that a rate is not computed from times of reception alone.

On a busy computer, messages are lost, and others wait and arrive together. The pause between two
receptions is then much shorter than the time in which the values have changed. The middleware
states when each message was sent, by the clock of the publisher. With the time of reception r by
the steady clock of the receiver, and the time of sending s, a message is late by

    d = r − s − min(r − s)

The minimum is over all messages so far, so d compares a message with the fastest one. Only changes
of s count, so the two clocks need not agree. r − d is the time of sending by the receiver's clock,
except for a constant. What happens if the clock of the publisher is wrong:

    it is set forward                  the message counts as the fastest one: d = 0
    it is set back, or stands still    the minimum begins anew: d = 0
    it drifts                          the minimum rises by DRIFT

Hence d grows no faster than r does. Whatever times a publisher states, the pauses between its
messages add up to at most twice the time in which the messages were received.
"""

from __future__ import annotations

import math

#: rate at which the minimum rises; clocks drift by up to 1e-4, and NTP slews them by up to 5e-4
DRIFT = 1e-3
#: longest delay [s]; a node that makes no progress for this time ends (`nodes/progress.py`)
LONGEST_DELAY = 10.0


def longer_pause(elapsed: float, delay_before: float, delay: float) -> float:
    """Return the time between two receptions or between two sendings, whichever is longer [s].

    Args:
        elapsed: Time between the receptions [s].
        delay_before: Delay of the first message [s].
        delay: Delay of the second message [s].
    """
    return elapsed + max(delay_before - delay, 0.0)


class MessageDelay:
    """Measures the delays of the messages of one publisher."""

    def __init__(self) -> None:
        self._least = math.inf  # least r − s, which rises by DRIFT [s]
        self._source_time = 0  # s of the last message [ns]
        self._now = math.inf  # r of the last message [s]

    def step(self, now: float, source_time: int) -> float:
        """Return the delay d of the next message [s], which is at least 0.

        Args:
            now: Time of reception r by a steady clock [s].
            source_time: Time of sending s by the clock of the publisher [ns]; 0 if it is unknown.
        """
        offset = now - 1e-9 * source_time
        least = self._least + DRIFT * max(now - self._now, 0.0)
        is_comparable = source_time > max(self._source_time, 0)
        self._least = min(least, offset) if is_comparable else offset
        self._source_time, self._now = source_time, now
        return min(offset - self._least, LONGEST_DELAY)
