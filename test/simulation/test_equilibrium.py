# SPDX-License-Identifier: Apache-2.0

from types import SimpleNamespace

import numpy as np

from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.equilibrium import Slopes, add_slopes, arms_last, follow


class Cubic:
    """A body whose lengths are polynomials of degree 3 in θ, which the simulator fits exactly."""

    def lengths(self, theta, tension):  # noqa: ARG002
        a, b = theta.T
        return np.stack([a**3 - a * b + 2.0 * b, a * b * b, 1.0 + a, b**2, a * a * b, b], axis=1)


def evaluated(slopes, theta, tension):
    """Return the derivatives that `add_slopes` computes from fitted slopes.

    Returns:
        The muscle Jacobian G [m/rad] (N, M, D), and Σ T_i ∂²l_i/∂θ² [N·m/rad] (N, D, D).
    """
    theta, tension = arms_last(theta), arms_last(tension)
    jacobian, curvature = (np.zeros((len(part), *theta.shape)) for part in (tension, theta))
    add_slopes(slopes.limbs, theta, tension, jacobian, curvature)
    half = np.tril(curvature.transpose(2, 0, 1))
    return jacobian.transpose(2, 0, 1), half + np.tril(half, -1).swapaxes(1, 2)


def test_slopes_are_the_derivatives_of_the_cubic_they_fit():
    robot = Robot.load('arm26')
    theta = robot.random_postures(7, np.random.default_rng(0))
    tension = np.random.default_rng(1).uniform(30.0, 200.0, (7, 6))
    slopes = Slopes(robot)
    slopes.fit(Cubic())
    jacobian, curvature = evaluated(slopes, theta, tension)
    a, b = theta.T
    np.testing.assert_allclose(jacobian[:, 0], np.stack([3 * a * a - b, 2.0 - a], 1), atol=1e-8)
    np.testing.assert_allclose(jacobian[:, 1], np.stack([b * b, 2.0 * a * b], 1), atol=1e-8)
    expected = tension[:, 0] * 6.0 * a + tension[:, 4] * 2.0 * b
    np.testing.assert_allclose(curvature[:, 0, 0], expected, rtol=1e-6, atol=1e-6)
    mixed = tension[:, 4] * 2.0 * a + tension[:, 1] * 2.0 * b - tension[:, 0]
    np.testing.assert_allclose(curvature[:, 0, 1], mixed, rtol=1e-6, atol=1e-6)


def test_each_limb_of_a_body_has_slopes_of_its_own():
    robot = Robot.load('musashi_upper_body')
    assert len(robot.groups) == 3
    theta = robot.random_postures(5, np.random.default_rng(0))
    tension = np.random.default_rng(1).uniform(30.0, 200.0, (5, robot.muscle_count))
    slopes = Slopes(robot)
    slopes.fit(SimpleNamespace(lengths=robot.muscle_lengths))
    jacobian, curvature = evaluated(slopes, theta, tension)
    truth = robot.routes.muscle_jacobian(theta)
    off = np.sqrt(np.square(jacobian - truth).mean())
    assert off < 0.1 * np.sqrt(np.square(truth).mean())
    for limb in robot.groups:
        others = np.setdiff1d(np.arange(robot.joint_count), limb.joints)
        assert not jacobian[:, limb.muscles][..., others].any()
    step = 1e-6
    for j in range(robot.joint_count):
        after, _ = evaluated(slopes, theta + step * np.eye(robot.joint_count)[j], tension)
        turned = ((after - jacobian) / step * tension[..., None]).sum(axis=1)
        np.testing.assert_allclose(curvature[:, j], turned, rtol=1e-4, atol=1e-5)


def test_modules_wind_at_a_limited_speed_and_by_a_bounded_length():
    for command, once, at_last in ((0.5, 0.01, 0.01), (-0.5, -0.01, -0.05), (1e-4, 1e-4, 1e-4)):
        followed = follow(command, 0.0, 0.0, 0.05, 0.0, 0.01)
        assert followed == once
        for _ in range(100):
            followed = follow(command, followed, 0.0, 0.05, 0.0, 0.01)
        assert followed == at_last
