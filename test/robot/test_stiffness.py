# SPDX-License-Identifier: Apache-2.0
import numpy as np
from differences import slopes

from musculoskeletal_ae.robot.stiffness import joint_stiffness, muscle_hessian


def nominal(robot, theta, tension, stiffness):
    jacobian = robot.routes.muscle_jacobian
    hessian = muscle_hessian(jacobian, theta)
    return joint_stiffness(jacobian(theta), hessian, stiffness, tension)


def test_joint_stiffness_is_the_slope_of_restoring_torque_with_the_motors_held(robot):
    """K_θ = −∂τ/∂θ of the torque τ = −Gᵀ T, which pulls the joints back.

    T(θ) is the tension of muscle stiffness control and the series elastic element in series.
    """
    rng = np.random.default_rng(0)
    theta = robot.random_postures(1, rng)[0]
    tension = rng.uniform(50.0, 150.0, robot.muscle_count)
    k = robot.muscle_stiffness(theta, tension)
    length = robot.routes.absolute_lengths(theta)

    def torque(moved):
        pull = tension + k * (robot.routes.absolute_lengths(moved) - length)
        return -robot.routes.muscle_jacobian(moved).T @ pull

    slope = slopes(torque, theta, 1e-5)
    np.testing.assert_allclose(nominal(robot, theta, tension, k), -slope, rtol=1e-4, atol=1e-3)


def test_a_muscle_is_softer_than_either_of_its_two_springs(robot):
    theta = robot.random_postures(1, np.random.default_rng(1))[0]
    tension = np.full(robot.muscle_count, 60.0)
    elastic = 1.0 / robot.series_elastic.compliance(robot.routes.absolute_lengths(theta), tension)
    k = robot.muscle_stiffness(theta, tension)
    assert (k < robot.stiffness).all()
    assert (k < elastic).all()


def test_slack_muscles_only_reduce_joint_stiffness(robot):
    rng = np.random.default_rng(2)
    theta = robot.random_postures(1, rng)[0]
    tension = np.full(robot.muscle_count, 60.0)
    k = robot.muscle_stiffness(theta, tension)
    taut = np.where(rng.random(robot.muscle_count) < 0.5, 0.0, k)
    lost = nominal(robot, theta, tension, k) - nominal(robot, theta, tension, taut)
    assert np.linalg.eigvalsh(lost).min() > -1e-9


def test_muscle_hessian_is_symmetric_and_the_second_derivative_of_length(robot):
    for theta in robot.random_postures(3, np.random.default_rng(1)):
        hessian = muscle_hessian(robot.routes.muscle_jacobian, theta)
        np.testing.assert_array_equal(hessian, hessian.transpose(0, 2, 1))
        curvature = [
            (
                robot.routes.absolute_lengths(theta + d)
                - 2 * robot.routes.absolute_lengths(theta)
                + robot.routes.absolute_lengths(theta - d)
            )
            / 1e-8
            for d in 1e-4 * np.eye(robot.joint_count)
        ]
        diagonal = np.einsum('mii->im', hessian)
        np.testing.assert_allclose(diagonal, curvature, atol=1e-4)
