# SPDX-License-Identifier: Apache-2.0
"""Friction along the wires: which way each slid last decides what it takes of the tension.

    T = T_end e^{μ s},   s ← clip(s − Δl/b, −1, 1)

T is the motor's, T_end the elastic unit's; s = 1 if the wire was wound in last: T is more then (the
stop operator of hysteresis theory). The network is that of the body without friction: what it takes
for T is T_end, so that everybody who asks it about what sensors read turns one into the other.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array

REVERSAL = 0.0005  # [m] b, of sliding that turn friction round
#: [m] by which a length is off, in the mean of about 1/LATEST messages, that is as likely the
#: sensor's noise as sliding
NOISE = 0.0001
LATEST = 0.15
SPIKE = 2.0 * NOISE  # [m] by which a reading may lie beyond the last two


def slid(direction: Array, moved: Array) -> Array:
    """Return s (..., M) after lengths have changed by `moved` [m] (..., M)."""
    after: Array = np.minimum(np.maximum(direction - moved / REVERSAL, -1.0), 1.0)
    return after


def end_tension(friction: Array | float, tension: Array, direction: Array) -> Array:
    """Return T_end [N] (..., M) of T [N], by μ (M,) and s (..., M)."""
    end: Array = tension * np.exp(-friction * direction)
    return end


class FrictionDirection:
    """Which way each wire slid last, from muscle lengths alone.

        L ← L + e ē²/(ē² + NOISE²),   e = l − L

    with ē the mean of the latest e. So noise slides a wire that rests only a little (that of twice
    NOISE turns s away from ±1), and one that slides is not followed late, as it would be by a low
    pass. Of l counts what lies at most SPIKE beyond the last two: one that is off slides little.
    """

    def __init__(self) -> None:
        self._length: Array | None = None

    def step(self, length: Array) -> Array:
        """Take l [m] (M,); return s (M,)."""
        if self._length is None:
            self._length, self._read = length, (length, length)
            self._off, self._direction = np.zeros_like(length), np.zeros_like(length)
        least, most = np.minimum(*self._read) - SPIKE, np.maximum(*self._read) + SPIKE
        self._read = self._read[1], length
        off = np.minimum(np.maximum(length, least), most) - self._length
        self._off = self._off + LATEST * (off - self._off)
        moved = off * self._off**2 / (self._off**2 + NOISE**2)
        self._length = self._length + moved
        self._direction = slid(self._direction, moved)
        return self._direction

    def end_tension(self, friction: Array | float, tension: Array, length: Array) -> Array:
        """Take T [N] and l [m] (M,); return T_end (M,), by μ (M,)."""
        return end_tension(friction, tension, self.step(length))

    def reset(self) -> None:
        """Forget, as after a jump of the clock."""
        self._length = None


def directions(length: Array) -> Array:
    """Return s (N, M) of l [m] (N, M), one message after the other."""
    step = FrictionDirection().step
    return np.array([step(each) for each in length]).reshape(length.shape)
