# SPDX-License-Identifier: Apache-2.0
"""Errors of the lengths that a network predicts, and whether they explain a measured length.

The lengths l(θ, T) that a network computes have errors with the covariance Σ. A posture θ is fitted
to the measured lengths l_o of some muscles, which the index o denotes (generalised least squares
with a prior of θ). The network then predicts the length of every muscle in this posture. d is the
predicted minus the measured length:

    θ = argmin eᵀ W e + (θ − θ̄)ᵀ P (θ − θ̄),   e = l_o − l_o(θ, T),   W = (Σ + N)_oo⁻¹
    d = l(θ, T) − l,   covariance of d = A (Σ + N) Aᵀ + G H P H Gᵀ
    A = I − G H G_oᵀ W,   H = (G_oᵀ W G_o + P)⁻¹

N is the variance of the elongation and of the sensor noise. θ̄ and P are mean and precision of θ in
the training data, and G = ∂l/∂θ. If few tendons are taut, θ is uncertain and so is d.

Errors of a network vary smoothly with the posture, and errors of an elastic constant persist. If d
had the value d₀ at an earlier moment, when the tendon was taut (index 0), a part of the present
error of d is therefore known:

    d | d₀ has the mean c d₀ / s₀² and the variance s² − c² / s₀²
    c = ρ aᵀ Σ a₀ + Σ_j a_j a₀_j ε_j ε₀_j,   ρ = exp(−‖(θ − θ₀) / range‖² / (2 SMOOTHNESS²))

s² is the variance of d, a the row of A that belongs to the muscle, and ε_j the standard deviation
of the elongation of muscle j. `range` is the range of each joint.

Before learning, Σ is the variance of the geometric model (`robot/model_errors.py`). After learning,
Σ is the second moment of the residuals on the healthy arm, plus the variance by which the error of
θ displaces each length: g C gᵀ on average over random postures, where g is the muscle's row of G
and C the covariance of the estimated θ. The residuals alone would be too small, because the network
has learned from the same messages.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.gauss_newton import whitening
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import LENGTH_SCALE
from musculoskeletal_ae.robot.model_errors import ELASTIC, length_variances
from musculoskeletal_ae.robot.robot import Robot

POSTURES = 300  # average the variances of length errors over this many random postures
SENSOR_NOISE = 0.0003  # assume this noise of a length (standard deviation) [m]
#: Correlate errors over this share of the joint ranges (width of ρ). The learner finds similar
#: widths for tendons that wrap round bones (b in `body_model/remainder.py`).
SMOOTHNESS = 0.35


class Prediction(NamedTuple):
    """Lengths of all muscles, predicted from the measured lengths of some muscles."""

    theta: Array  # the fitted posture [rad], (D,)
    excess: Array  # d, predicted minus measured length [m], (M,)
    variance: Array  # s², variance of d [m²], (M,)
    shares: Array  # A, derivative of d with respect to errors of all lengths, (M, M)
    elastic: Array  # ε, standard deviation of each muscle's elongation [m], (M,)

    def limit(self, muscle: int, sigmas: float) -> float:
        """Return the limit of one muscle's `excess` [m]: `sigmas` times its standard deviation."""
        return sigmas * math.sqrt(self.variance[muscle])


class LengthErrors:
    """Predicts lengths with a network, and states how uncertain each prediction is.

    Attributes:
        covariance: Covariance of the network's length errors [m²], (M, M).
    """

    def __init__(self, robot: Robot, mae: Mae) -> None:
        """Compute the covariance of one network's errors.

        Args:
            robot: The nominal body.
            mae: The network.
        """
        self._robot, self._mae = robot, mae
        self._range = robot.upper - robot.lower
        muscles = robot.muscle_count
        _, spread = mae.usual_posture
        self._precision: Array = np.diag(spread**-2)
        theta = robot.random_postures(POSTURES, np.random.default_rng(0))
        if mae.covariance is None:
            self.covariance: Array = np.diag(length_variances(robot, theta).mean(axis=0))
            return
        tension = np.broadcast_to(robot.description.tension.bias, (POSTURES, muscles))
        slopes = mae.muscle_jacobian(theta, tension)
        by_posture = np.einsum('nij,jk,nik->ni', slopes, mae.covariance, slopes)
        self.covariance = np.diag(by_posture.mean(axis=0))
        if mae.anomaly is not None:
            mean = mae.anomaly.mean[muscles:]
            moment = mae.anomaly.covariance[muscles:, muscles:] + np.outer(mean, mean)
            self.covariance = self.covariance + moment / LENGTH_SCALE**2

    def predict(
        self, length: Array, tension: Array, spread: Array | float, used: Bools, start: Array
    ) -> Prediction:
        """Predict the lengths of all muscles in a posture that is fitted to the lengths of some.

        Args:
            length: Measured lengths [m], (M,).
            tension: Bone-side tensions at which the lengths are predicted [N], (M,).
            spread: Standard deviation of these tensions [N], (M,) or scalar.
            used: The muscles to whose lengths the posture is fitted, (M,).
            start: Posture with which the fit starts [rad], (D,).
        """
        robot, tension = self._robot, np.maximum(tension, 0.0)
        compliance = robot.series_elastic.compliance(robot.routes.length_at_zero, tension)
        elastic = ELASTIC * robot.elongation(tension)
        noise = np.square(elastic) + np.square(compliance * spread) + SENSOR_NOISE**2
        total = self.covariance + np.diag(noise)
        rows: Ints = np.flatnonzero(used)
        root = np.zeros((len(rows), len(total)))
        root[:, rows] = whitening(total[np.ix_(rows, rows)])
        weight = root.T @ root
        theta = self._mae.fit_posture(tension, length, root, start)
        slope = self._mae.muscle_jacobian(theta, tension)
        excess: Array = self._mae.lengths(theta, tension) - length
        spread_of_theta = np.linalg.inv(slope.T @ weight @ slope + self._precision)
        moves = slope @ spread_of_theta
        shares = np.eye(len(length)) - moves @ slope.T @ weight
        variance = np.einsum('ij,jk,ik->i', shares, total, shares)
        variance += np.einsum('ij,jk,ik->i', moves, self._precision, moves)
        return Prediction(theta, excess, variance, shares, elastic)

    def given(self, now: Prediction, taut: Prediction, muscle: int) -> Prediction:
        """Correct the prediction for one muscle by the error that it had while it was taut.

        The correction also reduces the variance of the prediction. The farther the arm has moved
        since then, the smaller are the correction and the reduction.

        Args:
            now: The present prediction, which is corrected.
            taut: The prediction from the same muscles at the time when this muscle was taut.
            muscle: Index of the muscle. The values of other muscles do not change.
        """
        distance = np.square((now.theta - taut.theta) / self._range).sum()
        correlation = math.exp(-0.5 * distance / SMOOTHNESS**2)
        own, own_taut = now.shares[muscle], taut.shares[muscle]
        common = correlation * (own @ self.covariance @ own_taut)
        common += (own * now.elastic) @ (own_taut * taut.elastic)
        gain = common / taut.variance[muscle]
        excess, variance = now.excess.copy(), now.variance.copy()
        excess[muscle] -= gain * taut.excess[muscle]
        variance[muscle] -= gain * common
        return now._replace(excess=excess, variance=variance)
