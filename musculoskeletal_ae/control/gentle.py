# SPDX-License-Identifier: Apache-2.0
"""Gentle motion while the zeros of the lengths are unknown: slow, near, and planned on differences.

    l_target = l + ①(θ_goal, T_goal) − ①(θ_est, T) + l_comp(T_goal)

uses lengths only relative to those of the moment, so that zeros cancel; θ_est may be off, and G
with it, which muscle stiffness control takes as some more or less tension, below the limit. Goals
lie all over the joint range, but each is approached by a short step and held by random tensions:
the muscles see many postures and tensions, from different sides, as finding the zeros needs, since
how G turns tension into torque tells the posture.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.methods import msc_compensation
from musculoskeletal_ae.control.posture import Ramp
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import TensionProgramme

SPEED = 0.05  # [m/s] of a command, at most
DURATION, REST = 1.5, 0.25  # [s] of a step and after it
REACH = 0.7  # [rad] of a step, each joint
INSIDE = 0.1  # of the joint range that goals keep from its ends
TRIES = 20  # goals, of which the first is taken that can be held
SHARE = 0.6  # of the way from T_bias to T_limit: the highest tension


def gentle_limit(robot: Robot) -> Array:
    """Return the tension [N] (M,) that no muscle exceeds while zeros are unknown."""
    return robot.tension.bias + SHARE * (robot.tension.limit - robot.tension.bias)


class GentleMotion:
    """Commands lengths [m] (M,) for a slow wander."""

    def __init__(self, robot: Robot, seed: int = 0) -> None:
        self._robot, self._rng = robot, np.random.default_rng([seed, 0x6E])
        self.start()

    def start(self) -> None:
        """Begin anew, from wherever the arm is."""
        self._ramp: Ramp | None = None
        self._rest = 0.0

    def step(
        self, mae: Mae, tension: Array, length: Array, theta: Array, command: Array, dt: float
    ) -> Array:
        """Return the next command, after the last one; T [N], l [m] (M,), estimated θ (D,)."""
        if self._ramp is None or (self._ramp.done and self._rest >= REST):
            goal = self._goal(mae, tension, length, theta)
            self._ramp, self._rest = Ramp(command, goal, DURATION, SPEED), 0.0
        if self._ramp.done:
            self._rest += dt
        return self._ramp.step(dt)

    def _goal(self, mae: Mae, tension: Array, length: Array, theta: Array) -> Array:
        robot, limits = self._robot, (self._robot.tension.bias, gentle_limit(self._robot))
        best, pull, least = theta, tension, np.inf
        for goal in robot.random_postures(TRIES, self._rng, -INSIDE):
            near = theta + np.clip(goal - theta, -REACH, REACH)
            programme = TensionProgramme(
                mae.muscle_jacobian(near, tension), robot.kinematics.holding_torque(near), *limits
            )
            try:
                pull = programme.nearest(self._rng.uniform(*limits, robot.muscle_count))
                best = near
                break
            except InfeasibleError:
                exertion = programme.compromise()
                if (missing := float(np.abs(exertion.missing_torque).max())) < least:
                    best, pull, least = near, exertion.tension, missing
        now = length - mae.lengths(theta, tension)
        return now + mae.lengths(best, pull) + msc_compensation(robot, pull)
