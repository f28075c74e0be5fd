# SPDX-License-Identifier: Apache-2.0
"""Parts from which the presets compose the steps of the exploration (`Preset.exploration`)."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import InfeasibleError, RobotDescriptionError
from musculoskeletal_ae.robot.description import shown
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension

TRIES = 1000  # search at most this many random postures for holdable ones
AT_LIMITS = 0.25  # place this fraction of each joint's random angles at one of its limits
SMALL = 1e-9  # divide torques by at least this, to avoid a division by zero [N·m]
PRESSES = 10  # draw this many random T_const, and use the one that presses most strongly


class ExplorationStep(NamedTuple):
    """One step of the exploration."""

    method: str  # length method of the preset: 'first' or 'second'
    theta: Array  # θ_target [rad], (D,)
    #: T_const of the method `first` [N], (M,). For the method `second`, which uses the present
    #: tension instead, this is the tension that the geometric model expects.
    tension: Array
    duration: float  # duration of the step [s]


def posture_at_limits(robot: Robot, rng: np.random.Generator, share: float = AT_LIMITS) -> Array:
    """Return a random posture [rad], (D,); each joint is at a limit with probability `share`."""
    theta = robot.random_postures(1, rng)[0]
    chosen, upper = rng.uniform(size=(2, robot.joint_count))
    limit = np.where(upper < 0.5, robot.upper, robot.lower)
    return np.where(chosen < share, limit, theta)


def pressing_tension(robot: Robot, theta: Array, rng: np.random.Generator) -> Array:
    """Return random tensions that press the joints at their limits strongly against the stops.

    PRESSES random sets of tensions are compared, and the one that presses most strongly is
    returned. If no joint is at a limit, only one set is drawn.

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
    """Return the first `count` holdable postures, each with the least tensions that hold it.

    A posture has the shape (D,), and its tensions [N] have the shape (M,).

    Args:
        robot: The robot.
        postures: Random postures.
        count: Number of postures to return.
        others: Further functions that return G (N, M, D) for postures (N, D). A posture has to be
            holdable with the nominal G and with the G of each of these functions. T is computed
            with the G of the last function, or with the nominal G if there is none.

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
