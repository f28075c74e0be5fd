# SPDX-License-Identifier: Apache-2.0
"""Detects a winch that does not move although its tension is far from the commanded one.

    |T − T_ref| > max(JAM, JAM_SHARE · T_ref) and |Δl| < STANDS for JAM_TIME

T is the measured and T_ref the commanded tension; Δl is the change of the muscle length since the
winch moved last. The names in capitals are constants of this file.

A position-controlled module has no T_ref. It is jammed if it neither reaches its target length
l_target nor moves, although it could pull harder:

    |l − l_target| > BEHIND, T ≤ FULL · T_max and |Δl| < STANDS for JAM_TIME

The readings of a jammed module may be consistent with a posture. The residuals of the network then
do not reveal the fault.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.finding import Detector, Finding, Observation
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

STANDS = 0.001  # motion below which the winch counts as stationary [m]
JAM_TIME = 1.0  # time after which a stationary winch is reported [s]
BEHIND = 0.005  # difference from l_target above which a module has to move [m]
FULL = 0.9  # fraction of T_max above which a module need not move, because it cannot pull harder
JAM = 50.0  # difference from T_ref above which a winch has to move [N]
#: difference from T_ref, relative to T_ref, above which a winch has to move; it covers errors of
#: the sensors' gains
JAM_SHARE = 0.3


class JammedModule(Detector):
    """Reports a winch that has been stationary for some time although it should move."""

    def __init__(self, robot: Robot) -> None:
        self._robot = self._complete_robot = robot
        #: time for which the winch has been stationary although it should move [s]
        self._time: Array = np.zeros(robot.muscle_count)
        self._length: Array = np.zeros(robot.muscle_count)  # l when the winch moved last [m]

    def use(self, mae: Mae) -> None:
        """Monitor the muscles that are not isolated in this network."""
        self._robot = self._complete_robot.without(mae.isolated)

    def reset(self) -> None:
        """Restart the measurement of how long winches have been stationary."""
        self._time[:] = 0.0

    def step(self, observation: Observation) -> Finding | None:
        """Report the winch that has been stationary longest although it should move.

        The result is None if no winch has been stationary for 1 s.
        """
        is_far, length = self._is_far(observation), observation.sample.length
        if is_far is None:
            self._time[:] = 0.0
            return None
        has_to_move = is_far & self._robot.used
        if not np.count_nonzero(has_to_move):
            self._length = length
            self._time[:] = 0.0
            return None
        stands = has_to_move & (np.abs(length - self._length) < STANDS)
        self._length = np.where(stands, self._length, length)
        self._time = np.where(stands, self._time + observation.dt, 0.0)
        if self._time.max() < JAM_TIME or not observation.lengths_known:
            return None
        muscle = int(self._time.argmax())
        return Finding(
            muscle,
            ConditionKind.MODULE_STANDS,
            'its winch is jammed, or its tension reading is wrong',
        )

    def _is_far(self, observation: Observation) -> Bools | None:
        """Return which modules are far from the commanded tension, (M,); None without a command."""
        tension, most = observation.sample.motor_tension, self._robot.tension.max
        if observation.demand is None:
            return None
        demand = np.minimum(observation.demand, most)
        is_far: Bools = np.abs(tension - demand) > np.maximum(JAM, JAM_SHARE * demand)
        return is_far


class JammedPosition(JammedModule):
    """Reports a position-controlled winch that has been stationary away from its target length."""

    def _is_far(self, observation: Observation) -> Bools | None:
        """Return which modules are far from their target length and could pull harder, (M,).

        The result is None without a command.
        """
        if observation.command is None:
            return None
        tension, most = observation.sample.motor_tension, self._robot.tension.max
        behind = np.abs(observation.sample.length - observation.command) > BEHIND
        is_far: Bools = behind & ~(tension > FULL * most)
        return is_far
