# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.equilibrium import Slopes, follow


class Cubic:
    """A body whose lengths are cubic in θ, so that the fit can be exact."""

    def lengths(self, theta, tension):  # noqa: ARG002
        a, b = theta.T
        return np.stack([a**3 - a * b + 2.0 * b, a * b * b, 1.0 + a, b**2, a * a * b, b], axis=1)


def test_slopes_are_the_derivatives_of_the_cubic_they_fit():
    robot = Robot.load('arm26')
    theta = robot.random_postures(7, np.random.default_rng(0))
    tension = np.random.default_rng(1).uniform(30.0, 200.0, (7, 6))
    jacobian, curvature = Slopes(robot, Cubic())(theta, tension)
    a, b = theta.T
    np.testing.assert_allclose(jacobian[:, 0], np.stack([3 * a * a - b, 2.0 - a], 1), atol=1e-8)
    np.testing.assert_allclose(jacobian[:, 1], np.stack([b * b, 2.0 * a * b], 1), atol=1e-8)
    expected = tension[:, 0] * 6.0 * a + tension[:, 4] * 2.0 * b
    np.testing.assert_allclose(curvature[:, 0, 0], expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(curvature, curvature.swapaxes(1, 2), atol=1e-6)


def test_modules_wind_at_a_limited_speed_and_never_far_beyond_what_counts():
    followed = np.array([[0.0, 0.0, 0.0]])
    command = np.array([[0.5, -0.5, 1e-4]])
    length = np.zeros((1, 3))
    np.testing.assert_allclose(follow(command, followed, length, 0.05, 0.01), [[0.01, -0.01, 1e-4]])
    for _ in range(100):
        followed = follow(command, followed, length, 0.05, 0.01)
    np.testing.assert_allclose(followed, [[0.01, -0.05, 1e-4]])
