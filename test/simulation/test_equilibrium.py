# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

import numpy as np
import pytest

from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.equilibrium import Slopes, add_slopes, follow, solve


class Cubic:
    """A body whose lengths are cubic in θ, so that the fit can be exact."""

    def lengths(self, theta, tension):  # noqa: ARG002
        a, b = theta.T
        return np.stack([a**3 - a * b + 2.0 * b, a * b * b, 1.0 + a, b**2, a * a * b, b], axis=1)


def test_slopes_are_the_derivatives_of_the_cubic_they_fit():
    robot = Robot.load('arm26')
    theta = robot.random_postures(7, np.random.default_rng(0))
    tension = np.random.default_rng(1).uniform(30.0, 200.0, (7, 6))
    slopes = Slopes.of(robot, Cubic())
    jacobian, curvature = np.empty((7, 6, 2)), np.zeros((7, 2, 2))
    for n in range(7):
        add_slopes(slopes, theta[n], tension[n], jacobian[n], curvature[n])
    a, b = theta.T
    np.testing.assert_allclose(jacobian[:, 0], np.stack([3 * a * a - b, 2.0 - a], 1), atol=1e-8)
    np.testing.assert_allclose(jacobian[:, 1], np.stack([b * b, 2.0 * a * b], 1), atol=1e-8)
    expected = tension[:, 0] * 6.0 * a + tension[:, 4] * 2.0 * b
    np.testing.assert_allclose(curvature[:, 0, 0], expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(curvature, curvature.swapaxes(1, 2), atol=1e-6)


def test_modules_wind_at_a_limited_speed_and_never_far_beyond_what_counts():
    command, followed = (0.5, -0.5, 1e-4), (0.0, 0.0, 0.0)
    for steps, expected in ((1, (0.01, -0.01, 1e-4)), (99, (0.01, -0.05, 1e-4))):
        for _ in range(steps):
            followed = tuple(map(follow, command, followed, [0.0] * 3, [0.05] * 3, [0.01] * 3))
        assert followed == pytest.approx(expected)


def test_the_elimination_is_numpy_s_and_refuses_what_has_no_solution():
    rng = np.random.default_rng(0)
    matrix, vector = rng.normal(size=(5, 5)), rng.normal(size=5)
    matrix[0, 0] = 0.0  # rows must change places
    expected = np.linalg.solve(matrix, vector)
    solve(matrix, vector)
    np.testing.assert_allclose(vector, expected, rtol=1e-9)
    with pytest.raises(FloatingPointError):
        solve(np.ones((2, 2)), np.ones(2))
