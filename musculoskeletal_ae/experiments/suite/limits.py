# SPDX-License-Identifier: Apache-2.0
"""What limits an estimate: sensors, friction, samples or the network, each measured apart.

- `sensor_rad`: least squares on the true body, on messages made anew without friction: noise and
  bias of the sensors alone;
- `oracle_rad`: the same on the messages as they came: the difference is hysteresis;
- `body_rad`: least squares on the body that the learner fitted: the difference is what the samples
  leave open;
- `after_rad` of the network: the difference is the network's own.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.arm import LENGTH_NOISE
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.experiments.least_squares import LeastSquares, mean_error, oracle
from musculoskeletal_ae.experiments.recording import Recording
from musculoskeletal_ae.learning.body import CorrectedBody
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.robot.robot import Robot

STRIDE = 10  # of messages; least squares is slow
DIFFERENCE = 1e-4  # [rad]


class LearntLeastSquares(LeastSquares):
    """Least squares on a corrected body, which has more in it than routes and elastic units."""

    def __init__(self, robot: Robot, body: CorrectedBody) -> None:
        """Use a fitted body, wires in the mean of both directions of sliding."""
        self._body, self._muscles = body, robot.muscle_count
        at_zero = robot.routes.length_at_zero
        super().__init__(
            robot,
            lambda theta: at_zero + self._lengths(theta, np.zeros((len(theta), self._muscles))),
            self.muscle_jacobian,
            robot.series_elastic,
        )

    def _lengths(self, theta: Array, tension: Array) -> Array:
        return self._body.lengths(theta, tension, np.zeros_like(tension))[0]

    def muscle_jacobian(self, theta: Array) -> Array:
        """Return G [m/rad] of the fitted body, θ (N, D) gives (N, M, D)."""
        none = np.zeros((len(theta), self._muscles))
        columns = []
        for offset in DIFFERENCE * np.eye(theta.shape[1]):
            ahead, behind = self._lengths(theta + offset, none), self._lengths(theta - offset, none)
            columns.append((ahead - behind) / (2.0 * DIFFERENCE))
        return np.stack(columns, axis=-1)

    def _residual(self, theta: Array, tension: Array, length: Array) -> Array:
        return length - self._lengths(theta, tension)


def oracle_errors(robot: Robot, seed: int, recording: Recording) -> dict[str, float]:
    """Return the errors of least squares on the true body, with and without friction [rad]."""
    individual = Individual(robot, seed)
    theta, tension = recording.theta[::STRIDE], recording.tension[::STRIDE]
    estimator = oracle(robot, individual)
    rng = np.random.default_rng([seed, 0x11])
    true = np.maximum(tension - individual.tension_bias, 0.0) / individual.tension_gain
    frictionless = individual.muscle_lengths(theta, true) + individual.length_bias
    frictionless = frictionless + rng.normal(0.0, LENGTH_NOISE, frictionless.shape)
    return {
        'oracle_rad': mean_error(estimator.estimate(tension, recording.length[::STRIDE]), theta),
        'sensor_rad': mean_error(estimator.estimate(tension, frictionless), theta),
    }


def body_error(robot: Robot, learner: Learner, recording: Recording) -> float:
    """Return the error of least squares on the body that a learner of preset default fitted."""
    if learner.training.body is None:
        raise TypeError('only preset default fits a body')
    theta, tension = recording.theta[::STRIDE], recording.tension[::STRIDE]
    estimate = LearntLeastSquares(robot, learner.training.body).estimate(
        tension, recording.length[::STRIDE]
    )
    return mean_error(estimate, theta)
