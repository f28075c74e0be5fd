# SPDX-License-Identifier: Apache-2.0
"""Exploration: random motion that collects training data.

The preset draws the steps (`Preset.exploration`). Preset `default` puts the targets of some joints
at their limits, because the learner identifies joint-sensor offsets from joints at their stops
(`learning.stops`). Of several random T_const, this preset uses the one that presses these joints
most strongly against their stops.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.activities import ActivityControl, Inputs
from musculoskeletal_ae.control.command import Command
from musculoskeletal_ae.control.ramps import Goal, LengthRamps
from musculoskeletal_ae.exceptions import InfeasibleError, RobotDescriptionError
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.robot.description import shown
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension

TRIES = 1000  # largest number of random postures in which holdable ones are sought
AT_LIMITS = 0.25  # fraction of each joint's targets that are at one of its limits
SMALL = 1e-9  # lower bound of the divisor by which torques are scaled [N·m]
PRESSES = 10  # number of random T_const from which the most strongly pressing one is chosen


class Step(NamedTuple):
    """One step of the exploration."""

    method: str  # length method of the preset: 'first' or 'second'
    theta: Array  # θ_target [rad], (D,)
    #: T_const of the method `first` [N], (M,). For the method `second`, which uses the present
    #: tension instead, this is the tension that the geometric model expects.
    tension: Array
    duration: float  # duration of the step [s]


class Exploration:
    """A reproducible stream of steps; a new iterator continues the stream at a new posture."""

    def __init__(self, robot: Robot, seed: int, preset: str = 'default') -> None:
        """Draw the steps of a preset for `robot`."""
        self._rng = np.random.default_rng([seed, 0xE8])
        self.use(robot, preset)

    def use(self, robot: Robot, preset: str) -> None:
        """Draw the next steps for another preset, or for a robot with other isolated muscles."""
        self._robot, self._draw = robot, preset_named(preset).exploration()

    def __iter__(self) -> Iterator[Step]:
        while True:
            yield from self._draw(self._robot, self._rng)


def posture_at_limits(robot: Robot, rng: np.random.Generator, share: float = AT_LIMITS) -> Array:
    """Return a random θ [rad], (D,); each joint is at a limit with probability `share`."""
    theta = robot.random_postures(1, rng)[0]
    chosen, upper = rng.uniform(size=(2, robot.joint_count))
    limit = np.where(upper < 0.5, robot.upper, robot.lower)
    return np.where(chosen < share, limit, theta)


def pressing_tension(robot: Robot, theta: Array, rng: np.random.Generator) -> Array:
    """Return random tensions that press the joints that are at a limit against their stops.

    Args:
        robot: The robot.
        theta: θ [rad], (D,).
        rng: Generator of the random tensions.

    Returns:
        T [N], (M,).
    """
    limits = robot.tension
    side = (theta == robot.upper).astype(float) - (theta == robot.lower)
    count = PRESSES if side.any() else 1
    tension = rng.uniform(limits.bias, limits.limit, (count, robot.muscle_count))
    torque = -tension @ robot.routes.muscle_jacobian(theta)
    pressure = torque / np.maximum(np.abs(torque).max(axis=0), SMALL) @ side
    most_pressing: Array = tension[np.argmax(pressure)]
    return most_pressing


def holdable_postures(
    robot: Robot, postures: Iterable[Array], count: int, *others: Callable[[Array], Array]
) -> list[tuple[Array, Array]]:
    """Return the first `count` holdable postures θ (D,), each with its least T [N], (M,).

    Args:
        robot: The robot.
        postures: Random postures.
        count: Number of postures to return.
        others: Further functions that return G (N, M, D) for postures (N, D). A posture has to be
            holdable with the nominal G and with the G of each of these functions. T is computed
            with the G of the last function.

    Raises:
        RobotDescriptionError: If fewer than `count` of the postures are holdable.
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
        f'{robot.description.directory}: only {len(held)} of {TRIES} random postures are holdable '
        f'with tensions in [{shown(robot.tension.bias)}, {shown(robot.tension.limit)}] N; '
        'run check_robot, which suggests changes'
    )


class Exploring(ActivityControl):
    """The activity of exploring, which executes random steps with ramps of muscle lengths."""

    def __init__(self, exploration: Exploration, ramps: LengthRamps) -> None:
        self.stream, self.ramps = exploration, ramps
        self._steps: Iterator[Step] | None = None
        self._theta: Array | None = None  # present target [rad], (D,)

    def enter(self, inputs: Inputs) -> None:
        """Start with a new posture, or continue after a pause, from the present tensions."""
        self.ramps.start_from(inputs.length)
        self._steps = self._steps or iter(self.stream)

    def step(self, inputs: Inputs) -> Command | None:
        """Return the next command.

        Raises:
            RobotDescriptionError: If too few postures are holdable.
        """
        assert self._steps is not None
        if self.ramps.is_over_after(inputs.dt):
            step = next(self._steps)
            self._theta = step.theta
            constant = step.tension if step.method == 'first' else None
            effort = np.zeros_like(step.theta)
            self.ramps.pursue([Goal(step.method, step.theta, effort, step.duration, constant)])
        return self.ramps.step(inputs)

    def leave(self) -> None:
        """End the exploration; the next one starts with another posture."""
        self._steps = self._theta = None

    @property
    def missing_torque(self) -> Array | None:
        """Torque that the muscles cannot exert at the present goal [N·m], (D,)."""
        return self.ramps.missing_torque

    @property
    def theta(self) -> Array | None:
        """The posture to which the arm moves [rad], (D,); None before the first step.

        This is not a target of the user, and does not replace `Controller.target_state`.
        """
        return self._theta
