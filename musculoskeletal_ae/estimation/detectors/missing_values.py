# SPDX-License-Identifier: Apache-2.0
"""Detects a muscle whose sensors report NaN for some time.

Messages with NaN are rejected, so nothing is estimated while they arrive. If only one muscle has
NaN, its sensor is certainly faulty. The fault need not be verified by winding in the muscle.
"""

import math

import numpy as np

from musculoskeletal_ae.arrays import Bools
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.finding import Detector, Finding
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_states import MuscleReadings

SILENT = 0.15  # report a muscle once it alone has reported NaN for this long [s]


class MissingValues(Detector):
    """Reports a muscle that alone has reported NaN for 0.15 s (SILENT)."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._muscle: int | None = None
        #: time since which `_muscle` has been the only muscle with NaN, and time of the last
        #: message [s]
        self._since = self._last = -math.inf

    def read(self, readings: MuscleReadings, usable: Bools, now: float) -> Finding | None:
        """Report the only muscle with NaN in a message, if it has reported NaN for 0.15 s.

        The result is None if there is nothing to report.
        """
        has_no_tension = ~np.isfinite(readings.tension) & self._robot.tension_source.is_known
        is_missing = (~np.isfinite(readings.length) | has_no_tension) & usable
        muscle = int(is_missing.argmax()) if np.count_nonzero(is_missing) == 1 else None
        if muscle != self._muscle or now - self._last > SILENT:
            self._since = now
        self._muscle, self._last = muscle, now
        if muscle is None or now - self._since < SILENT:
            return None
        return Finding(
            muscle, ConditionKind.VALUES_MISSING, 'a sensor reports NaN instead of a number'
        )
