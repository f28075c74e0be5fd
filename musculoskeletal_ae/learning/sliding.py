# SPDX-License-Identifier: Apache-2.0
"""Which way each wire slid last, from muscle lengths alone.

    r ← clip(r, l − b, l + b),   s = (r − l)/b

(the stop operator of hysteresis theory). Friction along a wire acts against its last sliding, so
that T at the motor is T at the elastic unit times e^{μ s}: more when it was wound in (s = 1).
"""

from __future__ import annotations

import math

import numpy as np

from musculoskeletal_ae.arrays import Array

REVERSAL = 0.0005  # [m] b, of sliding that turn friction round
SMOOTHING = 0.05  # [s], so that the sensor's noise does not slide the wire


class SlidingTracker:
    """Follows s of M wires."""

    def __init__(self, muscles: int) -> None:
        """Know nothing yet: s = 0."""
        self.sliding = np.zeros(muscles)
        self._length: Array | None = None
        self._reference = np.zeros(muscles)

    def step(self, length: Array, dt: float) -> Array:
        """Take l [m] (M,), `dt` [s] after the one before; return s (M,)."""
        if self._length is None:
            self._length, self._reference = length.copy(), length.copy()
        share = 1.0 - math.exp(-dt / SMOOTHING)
        self._length = self._length + share * (length - self._length)
        low, high = self._length - REVERSAL, self._length + REVERSAL
        self._reference = np.minimum(np.maximum(self._reference, low), high)
        self.sliding = (self._reference - self._length) / REVERSAL
        return self.sliding

    def reset(self) -> None:
        """Forget, as after a jump of the clock."""
        self._length = None
        self.sliding = np.zeros(len(self._reference))
