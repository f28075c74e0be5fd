# SPDX-License-Identifier: Apache-2.0
"""Postures that an arm can hold, and the least tension that holds them: the QP bound."""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.exceptions import InfeasibleError, MusculoskeletalError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension

TRIES = 1000


def least_holding_tension(robot: Robot, jacobian: Array, theta: Array) -> Array:
    """Return the least T [N] (M,) that holds θ with G of shape (M, D); see `holding_tension`."""
    torque = robot.kinematics.holding_torque(theta)
    return holding_tension(jacobian, torque, robot.tension.bias, robot.tension.limit, 0.0)


def holdable_postures(
    robot: Robot, individual: Individual, count: int, rng: np.random.Generator
) -> list[tuple[Array, Array]]:
    """Return random (θ, least T) that both the model and the true body can hold.

    Raises:
        MusculoskeletalError: If hardly any posture can be held.
    """
    found: list[tuple[Array, Array]] = []
    for theta in robot.random_postures(TRIES, rng):
        try:
            least_holding_tension(robot, robot.routes.muscle_jacobian(theta), theta)
            true = individual.muscle_jacobian(theta[None])[0]
            found.append((theta, least_holding_tension(robot, true, theta)))
        except InfeasibleError:
            continue
        if len(found) == count:
            return found
    raise MusculoskeletalError(f'only {len(found)} of {TRIES} postures can be held')
