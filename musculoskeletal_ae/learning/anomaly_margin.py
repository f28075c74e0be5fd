# SPDX-License-Identifier: Apache-2.0
"""Excludes messages shortly before and after an anomaly from learning.

An anomaly is detected late, so messages of the last `DETECTION_DELAY` seconds before the detection
may already be wrong. Every message is therefore held back for this time. After the reset of an
anomaly, messages are ignored for the same time.
"""

from collections import deque
from typing import NamedTuple

from musculoskeletal_ae.body_model.observations import Sample
from musculoskeletal_ae.estimation.finding import DETECTION_DELAY

#: Hold back at most this many messages, which bounds the memory if the clock stands still. Even at
#: 1 kHz, fewer messages than this arrive within DETECTION_DELAY.
MOST_WAITING = 5000


class Waiting(NamedTuple):
    """A message that waits until it is certain that no anomaly was near.

    Attributes:
        time: Time of the message as the sum of all `dt` [s].
        dt: Time since the previous message [s].
        reading: The measurements of this message.
        rest: Rest sample that was completed with this message; None if none was.
    """

    time: float
    dt: float
    reading: Sample
    rest: Sample | None


class AnomalyMargin:
    """Holds messages back until `DETECTION_DELAY` has passed without an anomaly."""

    def __init__(self) -> None:
        self._waiting: deque[Waiting] = deque(maxlen=MOST_WAITING)
        self._time = self._closed_until = 0.0

    @property
    def is_closed(self) -> bool:
        """Whether messages are ignored, because an anomaly has ended shortly before (`close`)."""
        return self._time < self._closed_until

    def pass_time(self, dt: float) -> None:
        """Pass the time `dt` [s], until the next message."""
        self._time += dt

    def hold(self, dt: float, reading: Sample, rest: Sample | None) -> list[Waiting]:
        """Hold a message back; return the messages that have been held back for `DETECTION_DELAY`.

        Args:
            dt: Time since the previous message [s].
            reading: The measurements of this message.
            rest: Rest sample that was completed with this message, or None.
        """
        self._waiting.append(Waiting(self._time, dt, reading, rest))
        released = []
        while self._waiting and self._time - self._waiting[0].time >= DETECTION_DELAY:
            released.append(self._waiting.popleft())
        return released

    def discard(self) -> int:
        """Discard all messages that are held back; return the number of rest samples among them."""
        lost = sum(waiting.rest is not None for waiting in self._waiting)
        self._waiting.clear()
        return lost

    def close(self) -> None:
        """Ignore messages for `DETECTION_DELAY` from now on, because an anomaly has ended."""
        self._closed_until = self._time + DETECTION_DELAY
