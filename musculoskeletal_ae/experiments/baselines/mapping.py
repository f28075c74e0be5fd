# SPDX-License-Identifier: Apache-2.0
"""Joint-muscle mapping by polynomials, and an extended Kalman filter (Ookubo 2015).

    l_m + L_e,m(T_m) = Σ_k c_mk x^k + a_m T_m,   x = θ scaled to [−1, 1],  total degree ≤ 3

The mapping starts as a fit to the geometric model. Learning fits it to the samples; the
regression pulls towards the coefficients before, which decides what the samples leave open. The
filter takes θ for a random walk and the mapping for its measurement, H = ∂l/∂θ.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.experiments.baselines.estimator import unstretched
from musculoskeletal_ae.robot.robot import Robot

DEGREE = 3
MODEL_SAMPLES = 20_000
#: samples that the coefficients before are worth
PRIOR_ROWS = 20.0
TENSION_SCALE = 1.0 / 200.0  # so that a_m is of the size of the other coefficients
#: random walk of a joint [rad/√s]; 0.2 gives the same to a per cent
WALK = 0.5
LEAST_NOISE = 5e-4  # [m]


class PolynomialFilter:
    """The mapping of all muscles and the filter on it."""

    name = 'polynomial mapping, EKF'
    stride = 1

    def __init__(self, robot: Robot) -> None:
        """Fit the mapping to the geometric model."""
        self._robot = robot
        joints = robot.joint_count
        powers = [p for p in product(range(DEGREE + 1), repeat=joints) if sum(p) <= DEGREE]
        self._powers = np.array(powers)
        theta = robot.random_postures(MODEL_SAMPLES, np.random.default_rng(0))
        design = self._design(theta, np.zeros((MODEL_SAMPLES, robot.muscle_count)))[0]
        target = robot.routes.relative_lengths(theta)
        found = np.linalg.lstsq(design, target, rcond=None)[0]
        self._noise = (design @ found - target).std(axis=0)
        self._coefficients = np.vstack([found, np.zeros(robot.muscle_count)])

    def _scaled(self, theta: Array) -> Array:
        low, high = self._robot.lower, self._robot.upper
        scaled: Array = (2.0 * theta - low - high) / (high - low)
        return scaled

    def _design(self, theta: Array, tension: Array) -> tuple[Array, Array]:
        """Return the monomials of θ (N, K) and the scaled tensions (N, M)."""
        table = self._scaled(theta)[:, :, None] ** np.arange(DEGREE + 1)  # (N, D, DEGREE+1)
        columns = np.arange(theta.shape[1])
        return table[:, columns, self._powers].prod(axis=-1), TENSION_SCALE * tension

    def learn(self, theta: Array, tension: Array, length: Array) -> None:
        """Fit the mapping to samples, its own coefficients being the prior."""
        design, pull = self._design(theta, tension)
        target = unstretched(self._robot, tension, length)
        for m in range(self._robot.muscle_count):
            rows = np.column_stack([design, pull[:, m]])
            before = self._coefficients[:, m]
            normal = rows.T @ rows + PRIOR_ROWS / len(before) * np.eye(len(before))
            change = np.linalg.solve(normal, rows.T @ (target[:, m] - rows @ before))
            self._coefficients[:, m] = before + change
            self._noise[m] = (target[:, m] - rows @ self._coefficients[:, m]).std()

    def _measurement(self, theta: Array, tension: Array) -> tuple[Array, Array]:
        """Return the mapping's l + L_e [m] (M,) at one (θ, T) and H [m/rad] (M, D)."""
        x = self._scaled(theta)
        table = x[:, None] ** np.arange(DEGREE + 1)  # (D, DEGREE+1)
        joints = np.arange(len(x))
        factors = table[joints, self._powers]  # (K, D)
        lower = table[joints, np.maximum(self._powers - 1, 0)]
        slope = np.empty_like(factors)
        for d in joints:
            others = np.delete(factors, d, axis=1).prod(axis=1)
            slope[:, d] = self._powers[:, d] * lower[:, d] * others
        coefficients, elastic = self._coefficients[:-1], self._coefficients[-1]
        predicted = factors.prod(axis=1) @ coefficients + elastic * TENSION_SCALE * tension
        turn = 2.0 / (self._robot.upper - self._robot.lower)
        return predicted, (coefficients.T @ slope) * turn

    def estimate(self, tension: Array, length: Array, dt: float) -> Array:
        """Return θ [rad] (N, D); see `Baseline`."""
        robot = self._robot
        measured = unstretched(robot, tension, length)
        noise = np.diag(np.maximum(self._noise, LEAST_NOISE) ** 2)
        theta = 0.5 * (robot.lower + robot.upper)
        spread = np.diag(((robot.upper - robot.lower) / np.sqrt(12.0)) ** 2)
        walk = WALK**2 * dt * np.eye(robot.joint_count)
        estimates = np.empty((len(length), robot.joint_count))
        for n in range(len(length)):
            spread = spread + walk
            # Iterated, because the first message is far from where the mapping is linearised.
            prior = theta
            for _ in range(10 if n == 0 else 1):
                predicted, slope = self._measurement(theta, tension[n])
                gain = np.linalg.solve(slope @ spread @ slope.T + noise, slope @ spread).T
                off = measured[n] - predicted - slope @ (prior - theta)
                theta = np.clip(prior + gain @ off, robot.lower, robot.upper)
            spread = spread - gain @ slope @ spread
            estimates[n] = theta
        return estimates
