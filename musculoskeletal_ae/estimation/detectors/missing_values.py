# SPDX-License-Identifier: Apache-2.0
"""Detect a muscle whose sensors report no number (NaN) for a while.

Messages with NaN are rejected, and nothing is estimated meanwhile. If all of the NaN are those of
one muscle, its sensor is broken, and there is nothing to verify.
"""

import math

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.estimation.finding import Detector, Finding, Kind

SILENT = 0.15  # [s] that all messages have to lack a number of the same muscle


class MissingValues(Detector):
    """Measures for how long the same muscle has had no number."""

    def __init__(self) -> None:
        self._muscle: int | None = None
        self._since = self._last = -math.inf  # when it began, and the last message [s]

    def read(self, states: Array, usable: Bools, now: float) -> Finding | None:
        """Take the readings of every message; see `Detector`."""
        is_missing = ~np.isfinite(states[:2]).all(axis=0) & usable
        muscle = int(is_missing.argmax()) if np.count_nonzero(is_missing) == 1 else None
        if muscle != self._muscle or now - self._last > SILENT:
            self._since = now
        self._muscle, self._last = muscle, now
        if muscle is None or now - self._since < SILENT:
            return None
        return Finding(muscle, Kind.VALUES_MISSING, 'a sensor does not report a number')
