# SPDX-License-Identifier: Apache-2.0
"""Random motion that collects data: a stream of steps, and the activity that takes them.

The preset draws the steps (`Preset.exploration`). Preset `default` draws some joints' targets at
one of their limits, since only their stops tell the zeros of their sensors (`learning.stops`), and
of several random T_const takes the one that presses them there most.
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
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.robot.description import shown
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension

TRIES = 1000
AT_LIMITS = 0.25  # share of the targets of each joint that are at one of its limits
SMALL = 1e-9  # [N·m]
PRESSES = 10  # T_const, of which the one is taken that presses most towards limits


class Step(NamedTuple):
    """One step of the exploration."""

    method: str  # 'first' or 'second', of the preset's length methods
    theta: Array  # θ_target [rad], (D,)
    # T_const [N] of `first`, (M,); of `second`, which takes the tension of the moment, what the
    # geometric model expects that to be
    tension: Array
    duration: float  # [s]


class Exploration:
    """A reproducible stream of steps; iterating again goes on with it at a new posture."""

    def __init__(self, robot: Robot, seed: int, preset: str = 'default') -> None:
        """Explore with `robot` as a preset does."""
        self._rng = np.random.default_rng([seed, 0xE8])
        self.use(robot, preset)

    def use(self, robot: Robot, preset: str) -> None:
        """Draw targets that this robot can hold without its isolated muscles."""
        self._robot, self._draw = robot, preset_named(preset).exploration()

    def __iter__(self) -> Iterator[Step]:
        while True:
            yield from self._draw(self._robot, self._rng)


def posture_at_limits(robot: Robot, rng: np.random.Generator, share: float = AT_LIMITS) -> Array:
    """Return a random θ [rad] (D,), each joint of which is at a limit in a share of the cases."""
    theta = robot.random_postures(1, rng)[0]
    chosen, upper = rng.uniform(size=(2, robot.joint_count))
    limit = np.where(upper < 0.5, robot.upper, robot.lower)
    return np.where(chosen < share, limit, theta)


def pressing_tension(robot: Robot, theta: Array, rng: np.random.Generator) -> Array:
    """Return random T [N] (M,) that press the joints of θ [rad] (D,) at their limits there."""
    limits = robot.tension
    way = (theta == robot.upper).astype(float) - (theta == robot.lower)
    count = PRESSES if way.any() else 1
    tension = rng.uniform(limits.bias, limits.limit, (count, robot.muscle_count))
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
