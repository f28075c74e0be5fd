# SPDX-License-Identifier: Apache-2.0
"""Which θ belongs to which (T, l): the nearest in time, within half a period."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from musculoskeletal_ae.arrays import Array

KEPT = 16  # joint angles that wait for their muscle message


class Paired(NamedTuple):
    """One message of the muscle modules, with the θ of the same time if there is one.

    Attributes:
        tension: T [N], shape (M,).
        length: l [m], shape (M,).
        dt: Time since the message before [s].
        theta: θ [rad], shape (D,), or None.
    """

    tension: Array
    length: Array
    dt: float
    theta: Array | None


class Pairing:
    """Joins two streams; gives out a muscle message when the next one has come."""

    def __init__(self, period: float) -> None:
        """Pair within half a `period` [s] of the muscle messages."""
        self._half = 0.5 * period
        self._angles: deque[tuple[float, Array]] = deque(maxlen=KEPT)
        self._pending: tuple[float, Array, Array] | None = None
        self._before: float | None = None

    def reset(self) -> None:
        """Forget, as after a backward jump of the clock."""
        self._angles.clear()
        self._pending = self._before = None

    def joints(self, time: float, theta: Array) -> None:
        """Take a θ [rad] (D,) that came at `time` [s]."""
        if self._angles and time < self._angles[-1][0]:
            self.reset()
        self._angles.append((time, theta))

    def muscles(self, time: float, tension: Array, length: Array) -> Paired | None:
        """Take T [N] and l [m] that came at `time` [s]; return the message before, paired."""
        # The clock went back, or became another one.
        if self._pending is not None and time < self._pending[0]:
            self.reset()
        pending, self._pending = self._pending, (time, tension, length)
        if pending is None:
            return None
        came, tension, length = pending
        dt = 0.0 if self._before is None else came - self._before
        self._before = came
        theta = None
        if self._angles:
            nearest = min(self._angles, key=lambda entry: abs(entry[0] - came))
            # A θ nearer to the message that follows is left for that one.
            mine = abs(nearest[0] - came) <= abs(nearest[0] - time)
            if mine and abs(nearest[0] - came) <= self._half + 1e-9:
                theta = nearest[1]
        while self._angles and self._angles[0][0] <= came:
            self._angles.popleft()
        return Paired(tension, length, dt, theta)
