# SPDX-License-Identifier: Apache-2.0
"""Geometric model, nonlinear least squares: the estimator without any learning.

    min_θ Σ_m (l_m − f_geo,m(θ) + L_e,m(f_geo,abs(θ), T_m))²,   within the joint limits

started at the estimate before, as a robot would that runs it message by message.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot

# In the paper's scaled units (mm/100) lengths and their tolerances are of the size of one.
SCALE = 10.0
EVALUATIONS = 30
STARTS = 20  # for the first message, whose estimate before is not known


class GeometricLeastSquares:
    """Tracks θ on the geometric model."""

    name = 'geometric model, least squares'
    stride = 10

    def __init__(self, robot: Robot) -> None:
        """Use the model of `robot`."""
        self._robot = robot

    def learn(self, theta: Array, tension: Array, length: Array) -> None:
        """Learn nothing: a model has nothing to learn."""

    def estimate(self, tension: Array, length: Array, dt: float) -> Array:  # noqa: ARG002 (no rates)
        """Return θ [rad] (N, D); see `Baseline`."""
        robot = self._robot
        starts = robot.random_postures(STARTS, np.random.default_rng(0))
        found = [self._solve(start, tension[0], length[0]) for start in starts]
        theta = min(found, key=lambda pair: pair[1])[0]
        estimates = []
        for pull, measured in zip(tension, length, strict=True):
            theta, _ = self._solve(theta, pull, measured)
            estimates.append(theta)
        return np.array(estimates)

    def _solve(self, start: Array, tension: Array, length: Array) -> tuple[Array, float]:
        robot = self._robot

        def residual(theta: Array) -> Array:
            off: Array = SCALE * (robot.muscle_lengths(theta[None], tension[None])[0] - length)
            return off

        def jacobian(theta: Array) -> Array:
            slope = 1.0 - robot.series_elastic.length_slope(tension)
            change: Array = SCALE * slope[:, None] * robot.routes.muscle_jacobian(theta[None])[0]
            return change

        solved = least_squares(
            residual, start, jacobian, (robot.lower, robot.upper), max_nfev=EVALUATIONS
        )
        return solved.x, float(solved.cost)
