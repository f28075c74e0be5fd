# SPDX-License-Identifier: Apache-2.0
"""Gentle motion that provides data for the length calibration."""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Setup
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.motion.activities import (
    LENGTH,
    ActivityControl,
    Command,
    Inputs,
    msc_compensation,
)
from musculoskeletal_ae.motion.ramps import Ramp
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import TensionProgramme

#: change length commands no faster than this [m/s]; the estimate is uncertain, so the arm moves
#: slowly
SPEED = 0.05
DURATION = 1.5  # take this time for a step, or longer if SPEED requires it [s]
REST = 0.25  # rest for this time after each step, so that the calibration gets a rest sample [s]
REACH = 0.7  # move no joint further than this in one step [rad]
INSIDE = 0.1  # keep goals away from the joint limits by this fraction of the joint range
GOALS = 20  # try this many random goals in search of a holdable one
#: use no more than this fraction of the tension range from T_bias to T_limit, because unknown
#: length offsets cause tension errors
SHARE = 0.6


def gentle_limit(robot: Robot) -> Array:
    """Return the tension limit [N], (M,), that applies while the length offsets are unknown."""
    return robot.tension.bias + SHARE * (robot.tension.limit - robot.tension.bias)


class Calibrating(ActivityControl):
    """The activity that moves the arm gently while its length offsets are unknown.

        l_target = l + ①(θ_goal, T_goal) − ①(θ_est, T) + l_comp(T_goal)

    ① is the network's prediction of the muscle lengths from a posture and tensions, and l_comp(T)
    is −(T − T_bias)/K_stiff, which makes the modules exert T. The command uses only the difference
    of two predictions, so that unknown length offsets cancel. The estimated posture θ_est and the
    muscle Jacobian G may be wrong. Muscle stiffness control turns these errors into tension errors,
    which are limited.

    Each small, slow step ends at θ_goal, on the way from θ_est to a random posture in the joint
    range. There, the arm rests for a moment with T_goal: of the tensions that hold it there, those
    nearest to random ones. The calibration needs varied postures and tensions, because it infers
    the posture from the torques that the tensions exert through G.
    """

    def __init__(self, setup: Setup, seed: int = 0) -> None:
        self._setup = setup
        self._rng = np.random.default_rng([seed, 0x6E])
        self._ramp: Ramp | None = None
        self._rested = 0.0  # time since the end of the step [s]

    def enter(self, _: Inputs) -> None:
        """Begin the activity in the present posture."""
        self._ramp, self._rested = None, 0.0

    def step(self, inputs: Inputs) -> Command | None:
        """Advance by one control step and return the next length command."""
        if self._ramp is None or (self._ramp.done and self._rested >= REST):
            rate = min(SPEED, self._setup.settings.rate_limit)
            speed = float(self._setup.robot.actuation.fastest(rate).min())
            self._ramp = Ramp(inputs.length, self._goal(inputs), DURATION, speed)
            self._rested = 0.0
        if self._ramp.done:
            self._rested += inputs.dt
        return Command(LENGTH, self._ramp.step(inputs.dt))

    def leave(self) -> None:
        """Leave the activity, and discard its motion."""
        self._ramp = None

    def _goal(self, inputs: Inputs) -> Array:
        """Return the length command [m], (M,), for the end of a step towards a random goal.

        Up to GOALS random goals are tried, until a step towards one of them ends in a holdable
        posture. If none does, the step whose end misses the least holding torque is chosen.
        """
        robot, mae, theta = self._setup.robot, inputs.mae, inputs.theta
        tension = inputs.motor_tension
        limits = robot.tension.bias, gentle_limit(robot)
        best, best_tension, least_missing = theta, tension, np.inf
        for goal in robot.random_postures(GOALS, self._rng, -INSIDE):
            near = theta + np.clip(goal - theta, -REACH, REACH)
            jacobian = mae.muscle_jacobian(near, tension)
            programme = TensionProgramme(jacobian, robot.kinematics.holding_torque(near), *limits)
            try:
                random_tension = self._rng.uniform(*limits, robot.muscle_count)
                best_tension = programme.nearest(random_tension)
                best = near
                break
            except InfeasibleError:
                exertion = programme.compromise()
                missing = float(np.abs(exertion.missing_torque).max())
                if missing < least_missing:
                    best, best_tension, least_missing = near, exertion.tension, missing
        offset = inputs.sample.length - mae.lengths(theta, tension)
        return offset + mae.lengths(best, best_tension) + msc_compensation(robot, best_tension)
