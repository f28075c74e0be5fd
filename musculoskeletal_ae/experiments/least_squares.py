# SPDX-License-Identifier: Apache-2.0
"""Joint angles from one message (T, l) by weighted least squares on a body model.

    min_θ Σ_m (l_m − l_m(θ, T))² / (σ_l² + (∂L_e/∂T)² σ_T²)

With the true routes and elastic constants this is the oracle that no estimator can be expected to
beat: friction is taken as zero and the sensors' bias is unknown. With the geometric model it is the
classical estimator without any learning.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.arm import LENGTH_NOISE, TENSION_NOISE
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.series_elastic import SeriesElastic

ITERATIONS = 30
DAMPING = 1e-3  # of the normal matrix's diagonal


class LeastSquares:
    """Levenberg–Marquardt over many samples at once, within the joint limits."""

    def __init__(
        self,
        robot: Robot,
        absolute_lengths: Callable[[Array], Array],
        muscle_jacobian: Callable[[Array], Array],
        elastic: SeriesElastic,
    ) -> None:
        """Take the body model: θ (N, D) to lengths [m] (N, M) and G [m/rad] (N, M, D)."""
        self._lower, self._upper = robot.lower, robot.upper
        self._absolute, self._jacobian = absolute_lengths, muscle_jacobian
        self._at_zero = absolute_lengths(np.zeros((1, robot.joint_count)))[0]
        self._elastic = elastic

    def estimate(self, tension: Array, length: Array) -> Array:
        """Return θ [rad] (N, D) for T [N] (N, M), l [m] (N, M), started at mid-range."""
        theta = np.tile(0.5 * (self._lower + self._upper), (len(tension), 1))
        compliance = self._elastic.compliance(self._absolute(theta), tension)
        weight = 1.0 / (LENGTH_NOISE**2 + (compliance * TENSION_NOISE) ** 2)
        damping = np.full(len(tension), DAMPING)
        residual = self._residual(theta, tension, length)
        cost = np.sum(weight * residual**2, axis=1)
        for _ in range(ITERATIONS):
            jacobian = self._jacobian(theta)
            weighted = jacobian * weight[:, :, None]
            normal = np.einsum('nmi,nmj->nij', weighted, jacobian)
            diagonal = np.einsum('nii->ni', normal) * damping[:, None]
            normal += np.einsum('ni,ij->nij', diagonal, np.eye(theta.shape[1]))
            gradient = np.einsum('nmi,nm->ni', weighted, residual)
            step = np.linalg.solve(normal, gradient[..., None])[..., 0]
            tried = np.clip(theta + step, self._lower, self._upper)
            tried_residual = self._residual(tried, tension, length)
            tried_cost = np.sum(weight * tried_residual**2, axis=1)
            better = tried_cost < cost
            theta[better], residual[better] = tried[better], tried_residual[better]
            cost[better] = tried_cost[better]
            damping = np.clip(np.where(better, damping * 0.3, damping * 10.0), 1e-6, 1e6)
        return theta

    def _residual(self, theta: Array, tension: Array, length: Array) -> Array:
        absolute = self._absolute(theta)
        predicted = absolute - self._at_zero - self._elastic.elongation(absolute, tension)
        residual: Array = length - predicted
        return residual


def oracle(robot: Robot, individual: Individual) -> LeastSquares:
    """Return least squares on the true body."""
    return LeastSquares(
        robot, individual.absolute_lengths, individual.muscle_jacobian, individual.elastic
    )


def nominal(robot: Robot) -> LeastSquares:
    """Return least squares on the geometric model."""
    routes = robot.routes
    return LeastSquares(
        robot, routes.absolute_lengths, routes.muscle_jacobian, robot.series_elastic
    )


def mean_error(estimate: Array, truth: Array) -> float:
    """Return the mean over samples of ‖θ_est − θ_true‖₂ [rad]."""
    return float(np.linalg.norm(estimate - truth, axis=1).mean())
