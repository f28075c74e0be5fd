# SPDX-License-Identifier: Apache-2.0
"""Friction along the wires: which way each slid last decides what it takes of the tension.

    T = T_end e^{μ s},   s ← clip(s − Δl/b, −1, 1)

T is the motor's, T_end the elastic unit's; s = 1 if the wire was wound in last: T is more then (the
stop operator of hysteresis theory). The network is that of the body without friction: what it takes
for T is T_end, so that everybody who asks it about what sensors read turns one into the other.
"""

from __future__ import annotations

import math

import numpy as np

from musculoskeletal_ae.arrays import Array

REVERSAL = 0.0005  # [m] b, of sliding that turn friction round
SMOOTHING = 0.05  # [s], so that the sensor's noise does not slide the wire


def slid(direction: Array, moved: Array) -> Array:
    """Return s (..., M) after lengths have changed by `moved` [m] (..., M)."""
    after: Array = np.minimum(np.maximum(direction - moved / REVERSAL, -1.0), 1.0)
    return after


def end_tension(friction: Array | float, tension: Array, direction: Array) -> Array:
    """Return T_end [N] (..., M) of T [N], by μ (M,) and s (..., M)."""
    end: Array = tension * np.exp(-friction * direction)
    return end


class FrictionDirection:
    """Which way each wire slid last, from muscle lengths alone."""

    def __init__(self) -> None:
        self._length: Array | None = None

    def step(self, length: Array, dt: float) -> Array:
        """Take l [m] (M,), `dt` [s] after the one before; return s (M,)."""
        if self._length is None:
            self._length, self._direction = length.copy(), np.zeros_like(length)
        moved = (1.0 - math.exp(-dt / SMOOTHING)) * (length - self._length)
        self._length = self._length + moved
        self._direction = slid(self._direction, moved)
        return self._direction

    def end_tension(self, friction: Array, tension: Array, length: Array, dt: float) -> Array:
        """Take T [N] and l [m] (M,), `dt` [s] after those before; return T_end (M,), by μ (M,)."""
        return end_tension(friction, tension, self.step(length, dt))

    def reset(self) -> None:
        """Forget, as after a jump of the clock."""
        self._length = None


def directions(length: Array, dt: Array | float) -> Array:
    """Return s (N, M) of l [m] (N, M), each `dt` [s] after the one before: one for all, or (N,)."""
    step = FrictionDirection().step
    seen = zip(length, np.broadcast_to(dt, len(length)), strict=True)
    return np.array([step(*each) for each in seen]).reshape(length.shape)
