# SPDX-License-Identifier: Apache-2.0
"""Detect a sensor that reads exactly the same while the other muscles show that its muscle moves.

Such a sensor is broken, however little that disturbs the estimate. A sensor that works is noisy.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.finding import Detector, Finding, Kind, Observation
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.limits import LIMITS

FROZEN_TIME = 1.0  # [s] of identical readings
MOVED = 0.006  # [m] that the muscle moves by meanwhile, according to the others


class FrozenSensor(Detector):
    """Compares the length that the other muscles make likely with a sensor that does not change."""

    def __init__(self, robot: Robot) -> None:
        self._robot = self._complete_robot = robot
        self._mae: Mae | None = None
        self._last: Array | None = None  # l and T as they were read last, (2, M)
        self._unchanged_time: Array = np.zeros((2, robot.muscle_count))  # [s] of l and of T
        self._reduced_mae: Mae | None = None  # without the muscle that is watched
        self._shortest, self._longest = np.inf, -np.inf  # likely lengths of that muscle [m]

    def use(self, mae: Mae) -> None:
        """Use this network."""
        self._mae, self._robot = mae, self._complete_robot.without(mae.isolated)
        self._watch_nobody()

    def reset(self) -> None:
        """Begin to measure times again."""
        self._last = None
        self._unchanged_time[:] = 0.0
        self._watch_nobody()

    def step(self, observation: Observation) -> Finding | None:
        """Take a message."""
        sample, robot = observation.sample, self._robot
        tension, mae = sample.motor_tension, self._mae
        readings = np.array([sample.length_read, tension])
        is_same = readings == self._last if self._last is not None else np.zeros_like(readings)
        self._last = readings
        self._unchanged_time = (self._unchanged_time + observation.dt) * is_same
        is_calibrated = mae is not None and mae.anomaly is not None and mae.anomaly.calibrated
        if self._unchanged_time.max() < FROZEN_TIME or not is_calibrated:
            self._watch_nobody()
            return None
        assert mae is not None
        # Slack tendons have a rule of their own. A module that is paid out may report T_bias
        # exactly.
        slack = LIMITS.slack_share * robot.tension.bias
        by_length, by_tension = self._unchanged_time
        differs_from_bias = np.abs(tension - robot.tension.bias) > slack
        time = np.maximum(by_length, by_tension * differs_from_bias)
        time = time * (robot.used & (tension > slack))
        muscle = int(time.argmax())
        if time[muscle] < FROZEN_TIME or not observation.lengths_known:
            self._watch_nobody()
            return None
        isolated = tuple(sorted((*robot.isolated, muscle)))
        if self._reduced_mae is None or self._reduced_mae.isolated != isolated:
            self._watch_nobody()
            self._reduced_mae = mae.without(isolated)
        theta = self._reduced_mae.estimate(sample.bone_tension, sample.length).theta
        pull = np.minimum(sample.bone_tension, robot.tension.limit)
        likely = float(self._reduced_mae.lengths(theta, pull)[muscle])
        self._shortest, self._longest = min(likely, self._shortest), max(likely, self._longest)
        if self._longest - self._shortest <= MOVED:
            return None
        return Finding(muscle, Kind.SENSOR_FROZEN, 'a sensor is frozen while the arm moves')

    def _watch_nobody(self) -> None:
        self._reduced_mae = None
        self._shortest, self._longest = np.inf, -np.inf
