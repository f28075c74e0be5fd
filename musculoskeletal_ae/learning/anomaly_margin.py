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
    """Holds messages back until `DETECTION_DELAY` has passed without an anomaly.

    Attributes:
        is_anomaly: Whether an anomaly is present.
    """

    def __init__(self) -> None:
        self.is_anomaly = False
        self._waiting: deque[Waiting] = deque(maxlen=MOST_WAITING)
        self._time = self._closed_until = 0.0

    @property
    def is_closed(self) -> bool:
        """Whether messages are ignored: during an anomaly and shortly after it."""
        return self.is_anomaly or self._time < self._closed_until

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

    def set_anomaly(self, is_anomaly: bool) -> int:
        """Set whether an anomaly is present; return the number of rest samples it discards.

        When an anomaly begins, all messages held back are discarded.
        """
        lost = 0
        if is_anomaly and not self.is_anomaly:
            lost = sum(waiting.rest is not None for waiting in self._waiting)
            self._waiting.clear()
        if self.is_anomaly and not is_anomaly:
            self._closed_until = self._time + DETECTION_DELAY
        self.is_anomaly = is_anomaly
        return lost

    def reset(self) -> None:
        """Reset the margin: discard messages held back, for example after a clock jumped back."""
        self._waiting.clear()
