# SPDX-License-Identifier: Apache-2.0
"""Joint angles from one message (T, l) by weighted least squares on a body model.

    min_θ Σ_m (l_m − l_m(θ, T))² / (σ_l² + (∂L_e/∂T)² σ_T²)

With the true routes and elastic constants this is the oracle that no estimator can be expected to
beat: friction is taken as zero and the sensors' bias is unknown. With the geometric model it is the
classical estimator without any learning, and with the body that a learner fitted it tells what the
samples leave open from what the network adds.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.arm import LENGTH_NOISE, TENSION_NOISE
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.experiments.recording import Recording, mean_error
from musculoskeletal_ae.learning.body import CorrectedBody
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.series_elastic import SeriesElastic

ITERATIONS = 30
DAMPING = 1e-3  # of the normal matrix's diagonal
STRIDE = 10  # of a recording's messages; least squares is slow
DIFFERENCE = 1e-4  # [rad]


class LeastSquares:
    """Levenberg–Marquardt over many samples at once, within the joint limits.

    Attributes:
        muscle_jacobian: Of the body model, θ (N, D) to G [m/rad] (N, M, D).
    """

    def __init__(
        self,
        robot: Robot,
        lengths: Callable[[Array, Array], Array],
        muscle_jacobian: Callable[[Array], Array],
        length_at_zero: Array,
        elastic: SeriesElastic,
        tension_noise: float = TENSION_NOISE,
    ) -> None:
        """Take the body model: l [m] (N, M) of θ (N, D) and T [N] (N, M), G, l_abs(0) and L_e.

        Without noise of the tension sensors [N] all muscles have one weight.
        """
        self._lower, self._upper, self._lengths = robot.lower, robot.upper, lengths
        self.muscle_jacobian = muscle_jacobian
        self._at_zero, self._elastic, self._noise = length_at_zero, elastic, tension_noise

    def estimate(self, tension: Array, length: Array) -> Array:
        """Return θ [rad] (N, D) for T [N] (N, M), l [m] (N, M), started at mid-range."""
        theta = np.tile(0.5 * (self._lower + self._upper), (len(tension), 1))
        absolute = self._at_zero + self._lengths(theta, np.zeros_like(tension))
        compliance = self._elastic.compliance(absolute, tension)
        weight = 1.0 / (LENGTH_NOISE**2 + (compliance * self._noise) ** 2)
        damping = np.full(len(tension), DAMPING)
        residual = length - self._lengths(theta, tension)
        cost = np.sum(weight * residual**2, axis=1)
        for _ in range(ITERATIONS):
            jacobian = self.muscle_jacobian(theta)
            weighted = jacobian * weight[:, :, None]
            normal = np.einsum('nmi,nmj->nij', weighted, jacobian)
            diagonal = np.einsum('nii->ni', normal) * damping[:, None]
            normal += np.einsum('ni,ij->nij', diagonal, np.eye(theta.shape[1]))
            gradient = np.einsum('nmi,nm->ni', weighted, residual)
            step = np.linalg.solve(normal, gradient[..., None])[..., 0]
            tried = np.clip(theta + step, self._lower, self._upper)
            tried_residual = length - self._lengths(tried, tension)
            tried_cost = np.sum(weight * tried_residual**2, axis=1)
            better = tried_cost < cost
            theta[better], residual[better] = tried[better], tried_residual[better]
            cost[better] = tried_cost[better]
            damping = np.clip(np.where(better, damping * 0.3, damping * 10.0), 1e-6, 1e6)
        return theta

    def error(self, recording: Recording, length: Array | None = None) -> float:
        """Return the mean error on every `STRIDE`-th message [rad].

        Args:
            recording: Messages and truth.
            length: Of those messages [m], in place of the recorded one.
        """
        theta, tension = recording.theta[::STRIDE], recording.tension[::STRIDE]
        length = recording.length[::STRIDE] if length is None else length
        return mean_error(self.estimate(tension, length), theta)


def oracle(robot: Robot, true: Individual) -> LeastSquares:
    """Return least squares on the true body."""
    model = true.muscle_lengths, true.muscle_jacobian, true.length_at_zero, true.elastic
    return LeastSquares(robot, *model)


def nominal(robot: Robot, tension_noise: float = TENSION_NOISE) -> LeastSquares:
    """Return least squares on the geometric model."""
    routes = robot.routes
    model = robot.muscle_lengths, routes.muscle_jacobian, routes.length_at_zero
    return LeastSquares(robot, *model, robot.series_elastic, tension_noise)


def learned(robot: Robot, body: CorrectedBody) -> LeastSquares:
    """Return least squares on a body that was fitted, wires in the mean of both directions."""

    def lengths(theta: Array, tension: Array) -> Array:
        return body.lengths(theta, tension, np.zeros_like(tension))[0]

    def jacobian(theta: Array) -> Array:
        none = np.zeros((len(theta), robot.muscle_count))
        steps = DIFFERENCE * np.eye(robot.joint_count)
        columns = [lengths(theta + step, none) - lengths(theta - step, none) for step in steps]
        return np.stack(columns, axis=-1) / (2.0 * DIFFERENCE)

    at_zero, elastic = robot.routes.length_at_zero, robot.series_elastic
    return LeastSquares(robot, lengths, jacobian, at_zero, elastic)


def oracle_errors(robot: Robot, seed: int, recording: Recording) -> dict[str, float]:
    """Return the errors of least squares on the true body, with and without friction [rad].

    `oracle_rad` is on the messages as they came; `sensor_rad` on messages made anew without
    friction, so that noise and bias of the sensors act alone.
    """
    individual = Individual(robot, seed)
    estimator = oracle(robot, individual)
    theta, tension = recording.theta[::STRIDE], recording.tension[::STRIDE]
    rng = np.random.default_rng([seed, 0x11])
    true = np.maximum(tension - individual.tension_bias, 0.0) / individual.tension_gain
    frictionless = individual.muscle_lengths(theta, true) + individual.length_bias
    frictionless = frictionless + rng.normal(0.0, LENGTH_NOISE, frictionless.shape)
    return {
        'oracle_rad': estimator.error(recording),
        'sensor_rad': estimator.error(recording, frictionless),
    }
