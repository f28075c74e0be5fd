# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from musculoskeletal_ae.robot.stiffness import joint_stiffness, muscle_stiffness


def test_joint_stiffness_is_the_slope_of_restoring_torque_with_the_motors_held(robot):
    """K_θ = −∂τ/∂θ of τ = −Gᵀ T, when T follows T(θ) of MSC and the elastic unit in series."""
    rng = np.random.default_rng(0)
    theta = robot.random_postures(1, rng)[0]
    tension = rng.uniform(50.0, 150.0, robot.muscle_count)
    k = muscle_stiffness(robot, theta, tension)
    length = robot.routes.absolute_lengths(theta)

    def torque(moved):
        pull = tension + k * (robot.routes.absolute_lengths(moved) - length)
        return -robot.routes.muscle_jacobian(moved).T @ pull

    step = 1e-5
    slope = np.stack(
        [(torque(theta + d) - torque(theta - d)) / (2 * step) for d in step * np.eye(len(theta))],
        axis=-1,
    )
    np.testing.assert_allclose(joint_stiffness(robot, theta, tension), -slope, rtol=1e-4, atol=1e-3)


def test_a_muscle_is_softer_than_either_of_its_two_springs(robot):
    theta = robot.random_postures(1, np.random.default_rng(1))[0]
    tension = np.full(robot.muscle_count, 60.0)
    elastic = 1.0 / robot.series_elastic.compliance(robot.routes.absolute_lengths(theta), tension)
    k = muscle_stiffness(robot, theta, tension)
    assert (k < robot.stiffness).all()
    assert (k < elastic).all()


def test_slack_muscles_only_take_stiffness_away(robot):
    rng = np.random.default_rng(2)
    theta = robot.random_postures(1, rng)[0]
    tension = np.full(robot.muscle_count, 60.0)
    slack = rng.random(robot.muscle_count) < 0.5
    lost = joint_stiffness(robot, theta, tension) - joint_stiffness(robot, theta, tension, slack)
    assert np.linalg.eigvalsh(lost).min() > -1e-9
