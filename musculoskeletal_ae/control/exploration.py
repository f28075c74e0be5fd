# SPDX-License-Identifier: Apache-2.0
"""Random motion that collects data: the paper's three steps, repeated.

1. 5 s: `first` with a random θ_target and T_const = T_bias,
2. 2 s: `second`, the same θ_target with the tension of the moment,
3. 3 s: `first` again with a random T_const in [T_bias, T_limit]

(paper, section "Online Learning of Musculoskeletal AutoEncoder"). Each step ramps the command and
then rests, since the body is learned at rest. Targets are drawn among the postures that the arm can
hold with tensions in [T_bias, T_limit].

Our preset draws some joints' targets at one of their limits, since only their stops tell the zeros
of their sensors (`learning.stops`), and of several random T_const takes the one that presses them
there most.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.methods import msc_compensation
from musculoskeletal_ae.control.posture import Ramp, Step
from musculoskeletal_ae.exceptions import InfeasibleError, RobotDescriptionError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.description import shown
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import TensionProgramme, holding_tension

DURATIONS = (5.0, 2.0, 3.0)  # [s]
TRIES = 1000
SMALL = 1e-9  # [N·m]
PRESSES = 10  # T_const, of which the one is taken that presses most towards limits

# of gentle motion
SPEED = 0.05  # [m/s] of a command, at most
DURATION, REST = 1.5, 0.25  # [s] of a step and after it
REACH = 0.7  # [rad] of a step, each joint; times RACK [m] of what slides
INSIDE = 0.1  # of the joint range that goals keep from its ends
GOALS = 20  # goals, of which the first is taken that can be held
SHARE = 0.6  # of the way from T_bias to T_limit: the highest tension


class Exploration:
    """A reproducible stream of steps; iterating again goes on with it at a new posture."""

    def __init__(self, robot: Robot, seed: int, to_limits: float = 0.0) -> None:
        """Explore with `robot`; `to_limits` is the share of targets at a limit, of each joint."""
        self._robot, self._rng = robot, np.random.default_rng([seed, 0xE8])
        self.to_limits = to_limits

    def __iter__(self) -> Iterator[Step]:
        robot = self._robot
        bias = np.full(robot.muscle_count, robot.tension.bias)
        while True:
            postures = (self._posture() for _ in range(TRIES))
            ((theta, holding),) = holdable_postures(robot, postures, 1)
            constant = self._constant_tension(theta)
            yield Step('first', theta, bias, DURATIONS[0])
            yield Step('second', theta, holding, DURATIONS[1])
            yield Step('first', theta, constant, DURATIONS[2])

    def _posture(self) -> Array:
        robot, rng = self._robot, self._rng
        theta = robot.random_postures(1, rng)[0]
        if self.to_limits:
            chosen, upper = rng.uniform(size=(2, robot.joint_count))
            limit = np.where(upper < 0.5, robot.upper, robot.lower)
            theta = np.where(chosen < self.to_limits, limit, theta)
        return theta

    def _constant_tension(self, theta: Array) -> Array:
        robot, limits = self._robot, self._robot.tension
        way = (theta == robot.upper).astype(float) - (theta == robot.lower)
        count = PRESSES if way.any() else 1
        tension = self._rng.uniform(limits.bias, limits.limit, (count, robot.muscle_count))
        torque = -tension @ robot.routes.muscle_jacobian(theta)
        pressed = torque / np.maximum(np.abs(torque).max(axis=0), SMALL) @ way
        most: Array = tension[np.argmax(pressed)]
        return most


def holdable_postures(
    robot: Robot, postures: Iterable[Array], count: int, *others: Callable[[Array], Array]
) -> list[tuple[Array, Array]]:
    """Return the first of random θ (D,) that can be held, each with the least T [N] (M,).

    They can be held with the nominal G and with every other, given as for `muscle_hessian`; T is
    that of the last one. A RobotDescriptionError says that there are not so many.
    """
    held: list[tuple[Array, Array]] = []
    for theta in postures:
        with suppress(InfeasibleError):
            for muscle_jacobian in (robot.routes.muscle_jacobian, *others):
                tension = holding_tension(robot, theta, jacobian=muscle_jacobian(theta[None])[0])
            held.append((theta, tension))
        if len(held) == count:
            return held
    raise RobotDescriptionError(
        f'{robot.description.directory}: only {len(held)} of {TRIES} random postures can be held '
        f'with tensions in [{shown(robot.tension.bias)}, {shown(robot.tension.limit)}] N; '
        'run check_robot'
    )


def gentle_limit(robot: Robot) -> Array:
    """Return the tension [N] (M,) that no muscle exceeds while zeros are unknown."""
    return robot.tension.bias + SHARE * (robot.tension.limit - robot.tension.bias)


class GentleMotion:
    """Gentle motion while the zeros of the lengths are unknown: slow, near, on differences only.

        l_target = l + ①(θ_goal, T_goal) − ①(θ_est, T) + l_comp(T_goal)

    uses lengths only relative to those of the moment, so that zeros cancel; θ_est may be off, and G
    with it, which muscle stiffness control takes as some more or less tension, below the limit.
    Goals lie all over the joint range, but each is approached by a short step and held by random
    tensions: the muscles see many postures and tensions, from different sides, as finding the zeros
    needs, since how G turns tension into torque tells the posture.
    """

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
        radian = robot.kinematics.radian
        for goal in robot.random_postures(GOALS, self._rng, -INSIDE):
            near = theta + np.clip(goal - theta, -REACH * radian, REACH * radian)
            programme = TensionProgramme(
                mae.muscle_jacobian(near, tension), robot.kinematics.holding_torque(near), *limits
            )
            try:
                pull = programme.nearest(self._rng.uniform(*limits, robot.muscle_count))
                best = near
                break
            except InfeasibleError:
                exertion = programme.compromise()
                if (missing := float(np.abs(radian * exertion.missing_torque).max())) < least:
                    best, pull, least = near, exertion.tension, missing
        now = length - mae.lengths(theta, tension)
        return now + mae.lengths(best, pull) + msc_compensation(robot, pull)
