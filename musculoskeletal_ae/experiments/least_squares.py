# SPDX-License-Identifier: Apache-2.0
"""Joint angles from one message (T, l) by weighted least squares on a body model.

    min_θ Σ_m (l_m − l_m(θ, T))² / (σ_l² + (∂L_e/∂T)² (σ_T² + (μ_m T_m)²))

Here l_m(θ, T) is the length of muscle m by the body model. σ_l and σ_T are the standard deviations
of the measured lengths and tensions, ∂L_e/∂T is the compliance of the series elastic element, and
μ_m is the tendon friction. The body model determines the purpose of the estimator:

- With the true routes and elastic constants, it is the oracle: a reference that estimators without
  further knowledge can hardly beat. The oracle assumes zero friction and does not know the offsets
  and gains of the sensors.
- With the geometric model, it is the classical estimator without learning.
- With the calibrated body of a learner, its error shows which part of the network's error is due to
  the body.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.emulator.kin.individual import Individual
from musculoskeletal_ae.emulator.modules import LENGTH_NOISE, TENSION_NOISE, Arm
from musculoskeletal_ae.experiments.recording import Recording, mean_error
from musculoskeletal_ae.gauss_newton import minimise_each
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.series_elastic import SeriesElastic

ROUNDS = 30  # end the search after this many Gauss–Newton steps
#: damp the Gauss–Newton steps so that a typical one has this size, as a share of the joint's range
USUAL_STEP = 0.1
EVERY = np.s_[::10]  # evaluate every tenth message only, because least squares is slow
DIFFERENCE = 1e-4  # compute finite differences with this step [rad]


@dataclass(frozen=True)
class LeastSquares:
    """Estimates θ from many messages at once by Gauss–Newton, within the joint limits."""

    robot: Robot
    lengths: Callable[[Array, Array], Array]  # maps θ (N, D) and T [N] (N, M) to l [m] (N, M)
    muscle_jacobian: Callable[[Array], Array]  # maps θ (N, D) to G [m/rad] (N, M, D)
    length_at_zero: Array  # lengths of the routes at θ = 0, l_abs(0) [m], (M,)
    elastic: SeriesElastic
    #: standard deviation of a measured tension [N]; with 0, all muscles have the same weight
    tension_noise: float = TENSION_NOISE
    friction: Array | float = 0.0  # tendon friction μ (M,); 0 if it is unknown

    def estimate(self, tension: Array, length: Array) -> Array:
        """Return θ [rad] (N, D) for T [N] (N, M) and l [m] (N, M).

        The iterations start in the middle of the joint ranges.
        """
        lower, upper = self.robot.lower, self.robot.upper
        theta = np.tile(0.5 * (lower + upper), (len(tension), 1))
        absolute = self.length_at_zero + self.lengths(theta, np.zeros_like(tension))
        compliance = self.elastic.compliance(absolute, tension)
        variance = self.tension_noise**2 + (self.friction * tension) ** 2
        root = 1.0 / np.sqrt(LENGTH_NOISE**2 + compliance**2 * variance)

        def residuals(theta: Array) -> tuple[Array, Array]:
            error = self.lengths(theta, tension) - length
            return root * error, root[:, :, None] * self.muscle_jacobian(theta)

        usual = (USUAL_STEP * (upper - lower)) ** -2
        return minimise_each(residuals, theta, usual, ROUNDS, bounds=(lower, upper))

    def error(self, recording: Recording, rows: slice = EVERY) -> float:
        """Return the mean error [rad] over `rows` of a recording, by default every tenth row."""
        part = recording.part(rows)
        return mean_error(self.estimate(part.tension, part.length), part.theta)


def oracle(robot: Robot, true: Individual) -> LeastSquares:
    """Return the estimator that uses the true body of an individual."""
    model = true.muscle_lengths, true.muscle_jacobian, true.length_at_zero, true.elastic
    return LeastSquares(robot, *model)


def nominal(robot: Robot, tension_noise: float = TENSION_NOISE) -> LeastSquares:
    """Return the estimator that uses the geometric model, and tensions with this noise [N]."""
    routes = robot.routes
    model = robot.muscle_lengths, routes.muscle_jacobian, routes.length_at_zero
    return LeastSquares(robot, *model, robot.series_elastic, tension_noise)


def on_calibrated_body(robot: Robot, body: CalibratedBody) -> LeastSquares:
    """Return the estimator that uses the calibrated body of a learner.

    One message does not show the direction of tendon friction. The lengths of the body are
    therefore those midway between winding in and paying out.
    """

    def lengths(theta: Array, tension: Array) -> Array:
        return body.lengths(theta, tension, np.zeros_like(tension))[0]

    def jacobian(theta: Array) -> Array:
        zero = np.zeros((len(theta), robot.muscle_count))
        steps = DIFFERENCE * np.eye(robot.joint_count)
        change = [lengths(theta + step, zero) - lengths(theta - step, zero) for step in steps]
        return np.stack(change, axis=-1) / (2.0 * DIFFERENCE)

    at_zero, elastic = robot.routes.length_at_zero, robot.series_elastic
    return LeastSquares(robot, lengths, jacobian, at_zero, elastic)


def oracle_errors(arm: Arm, seed: int, recording: Recording) -> dict[str, float]:
    """Return the mean errors [rad] of the oracle on the messages of an arm.

    `oracle_rad` is the error on the recorded messages. `sensor_rad` is the error on messages that
    are recomputed without friction. They contain sensor errors only: noise, offsets, and gain
    errors of the tension sensors.
    """
    body, part = arm.individual, recording.part(EVERY)
    estimator = oracle(arm.robot, body)
    rng = np.random.default_rng([seed, 0x11])
    tension = np.maximum(part.tension - body.tension_bias, 0.0) / body.tension_gain
    length = body.muscle_lengths(part.theta, tension) + body.length_bias
    length = length + rng.normal(0.0, LENGTH_NOISE, length.shape)
    return {
        'oracle_rad': estimator.error(recording),
        'sensor_rad': mean_error(estimator.estimate(part.tension, length), part.theta),
    }
