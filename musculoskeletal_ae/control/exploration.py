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
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.activities import Inputs
from musculoskeletal_ae.control.command import Command
from musculoskeletal_ae.control.ramps import Goal, LengthRamps
from musculoskeletal_ae.exceptions import InfeasibleError, RobotDescriptionError
from musculoskeletal_ae.robot.description import shown
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension

DURATIONS = (5.0, 2.0, 3.0)  # [s]
TRIES = 1000
SMALL = 1e-9  # [N·m]
PRESSES = 10  # T_const, of which the one is taken that presses most towards limits


class Step(NamedTuple):
    """One step of the exploration."""

    method: str  # 'first' or 'second'
    theta: Array  # θ_target [rad], (D,)
    # T_const [N] of `first`, (M,); of `second`, which takes the tension of the moment, what the
    # geometric model expects that to be
    tension: Array
    duration: float  # [s]


class Exploration:
    """A reproducible stream of steps; iterating again goes on with it at a new posture."""

    def __init__(self, robot: Robot, seed: int, to_limits: float = 0.0) -> None:
        """Explore with `robot`; `to_limits` is the share of targets at a limit, of each joint."""
        self._robot, self._rng = robot, np.random.default_rng([seed, 0xE8])
        self.to_limits = to_limits

    def use(self, robot: Robot, to_limits: float) -> None:
        """Draw targets that this robot can hold without its isolated muscles."""
        self._robot, self.to_limits = robot, to_limits

    def __iter__(self) -> Iterator[Step]:
        while True:
            robot = self._robot
            bias = np.full(robot.muscle_count, robot.tension.bias)
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


class Exploring:
    """The activity of exploring: one random step after the other, by ramps of lengths."""

    def __init__(self, exploration: Exploration, ramps: LengthRamps) -> None:
        self.stream, self.ramps = exploration, ramps
        self._steps: Iterator[Step] | None = None
        self.theta: Array | None = None  # the target of the moment [rad], (D,)

    def enter(self, inputs: Inputs) -> None:
        """Begin with a new posture, or go on after a pause, from how the muscles pull now."""
        self.ramps.start_from(inputs.length)
        self._steps = self._steps or iter(self.stream)

    def step(self, inputs: Inputs) -> Command | None:
        """Return the next command; a RobotDescriptionError says that too little can be held."""
        assert self._steps is not None
        if self.ramps.is_over_after(inputs.dt):
            step = next(self._steps)
            self.theta = step.theta
            constant = step.tension if step.method == 'first' else None
            effort = np.zeros_like(step.theta)
            self.ramps.pursue([Goal(step.method, step.theta, effort, step.duration, constant)])
        return self.ramps.step(inputs)

    def leave(self) -> None:
        """End; the next time begins with another posture."""
        self._steps = self.theta = None
