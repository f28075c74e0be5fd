# SPDX-License-Identifier: Apache-2.0
"""The margin round anomalies: what comes shortly before or after one is not learned.

An anomaly is noticed late: what came within `MARGIN` before that was already wrong. Every message
therefore waits that long before it counts. After the anomaly has been reset, nothing counts for
another `MARGIN`.
"""

from collections import deque
from typing import NamedTuple

from musculoskeletal_ae.learning.samples import Sample

MARGIN = 2.0  # [s] before a detection and after its reset
#: messages that wait at most: more than MARGIN at 1 kHz, and an end where the clock stands still
MOST_WAITING = 5000


class Waiting(NamedTuple):
    """A message, and the rest that ended with it, if one did.

    Attributes:
        time: When it came, as the sum of all `dt` [s].
        dt: Time since the message before [s].
        reading: What was measured.
        rest: Mean of the rest.
    """

    time: float
    dt: float
    reading: Sample
    rest: Sample | None


class AnomalyMargin:
    """Holds messages back until it is known that no anomaly followed.

    Attributes:
        is_anomaly: Whether an anomaly is present.
    """

    def __init__(self) -> None:
        self.is_anomaly = False
        self._waiting: deque[Waiting] = deque(maxlen=MOST_WAITING)
        self._time = self._closed_until = 0.0

    @property
    def is_closed(self) -> bool:
        """Whether messages do not count: during an anomaly and shortly after it."""
        return self.is_anomaly or self._time < self._closed_until

    def pass_time(self, dt: float) -> None:
        """Let `dt` [s] pass, up to the message that comes next."""
        self._time += dt

    def hold(self, dt: float, reading: Sample, rest: Sample | None) -> list[Waiting]:
        """Hold a message back; return those that count from now on."""
        self._waiting.append(Waiting(self._time, dt, reading, rest))
        released = []
        while self._waiting and self._time - self._waiting[0].time >= MARGIN:
            released.append(self._waiting.popleft())
        return released

    def set_anomaly(self, is_anomaly: bool) -> int:
        """Note that an anomaly was detected or reset; return how many rests are lost by that."""
        lost = 0
        if is_anomaly and not self.is_anomaly:
            lost = sum(waiting.rest is not None for waiting in self._waiting)
            self._waiting.clear()
        if self.is_anomaly and not is_anomaly:
            self._closed_until = self._time + MARGIN
        self.is_anomaly = is_anomaly
        return lost

    def reset(self) -> None:
        """Forget the messages that wait, as after a backward jump of the clock."""
        self._waiting.clear()
