# SPDX-License-Identifier: Apache-2.0
"""Gentle motion while the length offsets are unknown, so that they can be found."""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.activities import Inputs
from musculoskeletal_ae.control.command import LENGTH, Command, msc_compensation
from musculoskeletal_ae.control.ramps import Ramp
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import TensionProgramme

SPEED = 0.05  # [m/s] of a command, at most
DURATION, REST = 1.5, 0.25  # [s] of a step and after it
REACH = 0.7  # [rad] of a step, each joint; times RACK [m] of what slides
INSIDE = 0.1  # of the joint range that goals keep from its ends
GOALS = 20  # goals, of which the first is taken that can be held
SHARE = 0.6  # of the way from T_bias to T_limit: the highest tension


def gentle_limit(robot: Robot) -> Array:
    """Return the tension [N] (M,) that no muscle exceeds while the offsets are unknown."""
    return robot.tension.bias + SHARE * (robot.tension.limit - robot.tension.bias)


class Calibrating:
    """The activity of moving gently: slow, near, and by differences of lengths only.

        l_target = l + ①(θ_goal, T_goal) − ①(θ_est, T) + l_comp(T_goal)

    It uses lengths only relative to those of the moment, so that the offsets cancel. θ_est may be
    off, and G with it, which muscle stiffness control takes as some more or less tension, below the
    limit. Goals lie all over the joint range, but each is approached by a short step and held by
    random tensions: the muscles see many postures and tensions, from different sides. That is what
    finding the offsets needs, because how G turns tension into torque tells the posture.
    """

    def __init__(self, robot: Robot, settings: Settings, seed: int = 0) -> None:
        self._rng = np.random.default_rng([seed, 0x6E])
        self._ramp: Ramp | None = None
        self._rested = 0.0  # [s]
        self.use(robot, settings)

    def use(self, robot: Robot, _: Settings) -> None:
        """Move this robot, whose isolated muscles pull nothing."""
        self._robot = robot

    def enter(self, _: Inputs) -> None:
        """Begin anew, from wherever the arm is."""
        self._ramp, self._rested = None, 0.0

    def step(self, inputs: Inputs) -> Command | None:
        """Return the next length command."""
        if self._ramp is None or (self._ramp.done and self._rested >= REST):
            self._ramp = Ramp(inputs.length, self._goal(inputs), DURATION, SPEED)
            self._rested = 0.0
        if self._ramp.done:
            self._rested += inputs.dt
        return Command(LENGTH, self._ramp.step(inputs.dt))

    def leave(self) -> None:
        """End."""
        self._ramp = None

    def _goal(self, inputs: Inputs) -> Array:
        """Return the lengths [m] (M,) of the first goal that can be held, or of the nearest."""
        robot, mae, theta = self._robot, inputs.mae, inputs.theta
        tension = inputs.sample.motor_tension * inputs.sample.usable
        limits = robot.tension.bias, gentle_limit(robot)
        best, pull, least_missing = theta, tension, np.inf
        radian = robot.kinematics.radian
        for goal in robot.random_postures(GOALS, self._rng, -INSIDE):
            near = theta + np.clip(goal - theta, -REACH * radian, REACH * radian)
            jacobian = mae.muscle_jacobian(near, tension)
            programme = TensionProgramme(jacobian, robot.kinematics.holding_torque(near), *limits)
            try:
                pull = programme.nearest(self._rng.uniform(*limits, robot.muscle_count))
                best = near
                break
            except InfeasibleError:
                exertion = programme.compromise()
                missing = float(np.abs(radian * exertion.missing_torque).max())
                if missing < least_missing:
                    best, pull, least_missing = near, exertion.tension, missing
        now = inputs.sample.length - mae.lengths(theta, tension)
        return now + mae.lengths(best, pull) + msc_compensation(robot, pull)
