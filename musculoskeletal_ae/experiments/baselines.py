# SPDX-License-Identifier: Apache-2.0
"""Earlier estimators of joint angles, evaluated on the same data as the autoencoder.

The polynomial filter and the table search learn from the same rest samples as the autoencoder.
Rest samples cover too few postures for a table search. Both estimators are therefore evaluated a
second time, after learning from all messages of the exploration, thinned to 10 Hz.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.experiments.least_squares import nominal
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, Recording, mean_error
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.robot.robot import Robot

STREAM_STRIDE = 10


def baseline_errors(
    robot: Robot, rests: State, stream: Recording, held_out: Recording
) -> dict[str, dict[str, float]]:
    """Return each estimator's error [rad] on the held-out motion, before and after learning.

    Each estimator's name is mapped to the keys `before_rad` and `after_rad`. Before learning, all
    estimators use the geometric model. The unweighted least squares estimate does not learn, so its
    two errors are equal.
    """
    part = stream.part(np.s_[::STREAM_STRIDE])
    moving = State(part.theta_sensor, part.tension, part.length)
    error = nominal(robot, tension_noise=0.0).error(held_out)
    errors = {'geometric model, least squares': {'before_rad': error, 'after_rad': error}}
    for kind in (PolynomialFilter, TableSearch):
        before = _error(kind(robot), held_out)
        for data, name in ((rests, kind.name), (moving, f'{kind.name}, whole stream')):
            estimator = kind(robot)
            if len(data.theta):
                estimator.learn(*data)
            errors[name] = {'before_rad': before, 'after_rad': _error(estimator, held_out)}
    return errors


def _error(baseline: PolynomialFilter | TableSearch, held_out: Recording) -> float:
    estimate = baseline.estimate(held_out.tension, held_out.length)
    return mean_error(estimate, held_out.theta)


def without_elongation(robot: Robot, tension: Array, length: Array) -> Array:
    """Return the lengths [m] that would be measured if no series elastic element were stretched.

    The stretch L_e shortens the measured length l, so the result is l + L_e(l_abs, T). L_e depends
    on the absolute length l_abs without stretch, which is not measured. L_e is therefore evaluated
    twice: first at the measured length, and then at the length corrected by this first L_e.
    """
    absolute = robot.routes.length_at_zero + length
    elongation = robot.series_elastic.elongation(absolute, tension)
    return length + robot.series_elastic.elongation(absolute + elongation, tension)


class PolynomialFilter:
    """Extended Kalman filter that measures lengths through a polynomial mapping (Ookubo 2015).

        l_m + L_e,m(T_m) = Σ_k c_mk x^k + a_m T_m,   x = θ scaled to [−1, 1],  total degree ≤ 3

    The left side is the length of muscle m without the stretch of its series elastic element. The
    terms x^k are the monomials of x. At first, the coefficients c_mk are a fit to the geometric
    model, and a_m is 0. `learn` refits all coefficients to samples, with their previous values as
    the prior. Coefficients that the samples do not determine therefore stay as they were. The
    filter models θ as a random walk, and its measurement is the left side, with H = ∂l/∂θ.
    """

    name = 'polynomial mapping, EKF'
    DEGREE = 3
    MODEL_SAMPLES = 20_000
    #: in a fit of new coefficients, let the previous ones weigh as much as this many samples
    PRIOR_ROWS = 20.0
    #: scale tensions by this factor [1/N], so that a_m is about as large as c_mk
    TENSION_SCALE = 1.0 / 200.0
    #: standard deviation of a joint's random walk [rad/√s]; with 0.2 instead, the error differs by
    #: about 1 %
    WALK = 0.5
    LEAST_NOISE = 5e-4  # assume at least this standard deviation of a length [m]

    def __init__(self, robot: Robot) -> None:
        """Fit the mapping to the geometric model, before anything is learned."""
        self._robot = robot
        every = product(range(self.DEGREE + 1), repeat=robot.joint_count)
        self._powers = np.array([powers for powers in every if sum(powers) <= self.DEGREE])
        # Derivatives of the monomials in terms of monomials: k x^(k−1) for each joint, (D, K, K).
        units = np.eye(robot.joint_count, dtype=int)
        lower = [(self._powers[:, None] - unit == self._powers).all(axis=-1) for unit in units]
        self._slopes = np.array(lower) * self._powers.T[:, :, None]
        theta = robot.random_postures(self.MODEL_SAMPLES, np.random.default_rng(0))
        design, target = self._monomials(theta), robot.routes.relative_lengths(theta)
        fit = np.linalg.lstsq(design, target, rcond=None)[0]
        self._noise = (design @ fit - target).std(axis=0)
        self._coefficients = np.vstack([fit, np.zeros(robot.muscle_count)])

    def _monomials(self, theta: Array) -> Array:
        """Return the K monomials (N, K) of the joint angles θ (N, D)."""
        low, high = self._robot.lower, self._robot.upper
        x = (2.0 * theta - low - high) / (high - low)
        table = x[:, :, None] ** np.arange(self.DEGREE + 1)  # (N, D, DEGREE+1)
        return table[:, np.arange(theta.shape[1]), self._powers].prod(axis=-1)

    def learn(self, theta: Array, tension: Array, length: Array) -> None:
        """Learn the mapping from samples θ [rad] (N, D), T [N] (N, M) and l [m] (N, M)."""
        design = self._monomials(theta)
        target = without_elongation(self._robot, tension, length)
        for m in range(self._robot.muscle_count):
            rows = np.column_stack([design, self.TENSION_SCALE * tension[:, m]])
            before = self._coefficients[:, m]
            normal = rows.T @ rows + self.PRIOR_ROWS / len(before) * np.eye(len(before))
            change = np.linalg.solve(normal, rows.T @ (target[:, m] - rows @ before))
            self._coefficients[:, m] = before + change
            self._noise[m] = (target[:, m] - rows @ self._coefficients[:, m]).std()

    def _measurement(self, theta: Array, tension: Array) -> tuple[Array, Array]:
        """Return the lengths that the mapping predicts at one (θ, T), and their derivatives.

        The lengths l + L_e [m] have the shape (M,). Their derivatives H = ∂l/∂θ [m/rad] have the
        shape (M, D).
        """
        monomials = self._monomials(theta[None])[0]
        coefficients, elastic = self._coefficients[:-1], self._coefficients[-1]
        predicted = monomials @ coefficients + elastic * self.TENSION_SCALE * tension
        scale = 2.0 / (self._robot.upper - self._robot.lower)
        return predicted, coefficients.T @ (self._slopes @ monomials).T * scale

    def estimate(self, tension: Array, length: Array) -> Array:
        """Return θ [rad] (N, D) for N successive messages with T [N] and l [m], (N, M) each."""
        robot = self._robot
        measured = without_elongation(robot, tension, length)
        noise = np.diag(np.maximum(self._noise, self.LEAST_NOISE) ** 2)
        theta = 0.5 * (robot.lower + robot.upper)
        spread = np.diag(((robot.upper - robot.lower) / np.sqrt(12.0)) ** 2)
        walk = self.WALK**2 * SAMPLE_TIME * np.eye(robot.joint_count)
        estimates = np.empty((len(length), robot.joint_count))
        for n in range(len(length)):
            spread = spread + walk
            # The first message is far from the point of linearisation and needs iterations.
            prior = theta
            for _ in range(10 if n == 0 else 1):
                predicted, jacobian = self._measurement(theta, tension[n])
                gain = np.linalg.solve(jacobian @ spread @ jacobian.T + noise, jacobian @ spread).T
                innovation = measured[n] - predicted - jacobian @ (prior - theta)
                theta = np.clip(prior + gain @ innovation, robot.lower, robot.upper)
            spread = spread - gain @ jacobian @ spread
            estimates[n] = theta
        return estimates


class TableSearch:
    """Table search (Nakanishi 2010): the posture whose lengths are nearest to the measured lengths.

        θ_est = θ_k,   k = argmin_k ‖l_k − (l + L_e(l_abs, T))‖₂

    Row k of the table holds the joint angles θ_k, and the lengths l_k without the stretch L_e of
    the series elastic elements. Before learning, the rows are random postures of the geometric
    model. `learn` replaces all rows with samples.
    """

    name = 'table search'
    ROWS = 100_000

    def __init__(self, robot: Robot) -> None:
        """Fill the table with random postures of the geometric model."""
        self._robot = robot
        self._theta = robot.random_postures(self.ROWS, np.random.default_rng(0))
        self._lengths = cKDTree(robot.routes.relative_lengths(self._theta))

    def learn(self, theta: Array, tension: Array, length: Array) -> None:
        """Learn by replacing the table with samples θ [rad] (N, D), T [N] (N, M), l [m] (N, M)."""
        self._theta = theta
        self._lengths = cKDTree(without_elongation(self._robot, tension, length))

    def estimate(self, tension: Array, length: Array) -> Array:
        """Return θ [rad] (N, D) for N messages with T [N] and l [m], (N, M) each."""
        row = self._lengths.query(without_elongation(self._robot, tension, length))[1]
        return self._theta[row]
