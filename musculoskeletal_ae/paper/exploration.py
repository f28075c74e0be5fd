# SPDX-License-Identifier: Apache-2.0
"""Random motion that collects data (§IV-A): three steps, repeated.

1. For 5 s, `first` (7) with a random θ_target and T_const = T_bias.
2. For 2 s, `second` (8) with the same θ_target and the current tension.
3. For 3 s, `first` (7) with the same θ_target and a random T_const in [T_bias, T_limit].

The paper does not state the following, which we chose. Targets are drawn from the postures that the
arm can hold with tensions in [T_bias, T_limit]; if there are hardly any, joint stops may help. Each
step ramps the command and then holds it, because the body is learned from rest samples
(`motion/ramps.py`).
"""

from collections.abc import Callable

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.motion.explored_postures import explored_posture
from musculoskeletal_ae.motion.methods import FIRST, SECOND, Goal
from musculoskeletal_ae.paper.constants import DURATIONS
from musculoskeletal_ae.robot.robot import Robot


def random_posture(robot: Robot, rng: np.random.Generator) -> Array:
    """Return a random θ_target [rad] (D,) within the joint limits."""
    return robot.random_postures(1, rng)[0]


def random_tension(robot: Robot, theta: Array, rng: np.random.Generator) -> Array:  # noqa: ARG001
    """Return a random T_const [N] (M,) in [T_bias, T_limit]."""
    return rng.uniform(robot.tension.bias, robot.tension.limit, robot.muscle_count)


def three_steps(
    robot: Robot,
    rng: np.random.Generator,
    posture: Callable[[Robot, np.random.Generator], Array] = random_posture,
    constant_tension: Callable[[Robot, Array, np.random.Generator], Array] = random_tension,
) -> tuple[Goal, Goal, Goal]:
    """Draw a random holdable posture, and return the three steps of exploration at this posture.

    Args:
        robot: The body; its isolated muscles carry no tension.
        rng: Random number generator of all draws.
        posture: Draws θ_target.
        constant_tension: Draws T_const of the third step [N], (M,), for θ_target.

    Raises:
        RobotDescriptionError: If the arm can hold too few postures.
    """
    bias = np.full(robot.muscle_count, robot.tension.bias)
    theta, holding = explored_posture(robot, lambda: posture(robot, rng))
    constant, no_effort = constant_tension(robot, theta, rng), np.zeros_like(theta)
    return (
        Goal(FIRST, theta, no_effort, DURATIONS[0], bias),
        Goal(SECOND, theta, no_effort, DURATIONS[1], holding),
        Goal(FIRST, theta, no_effort, DURATIONS[2], constant),
    )
