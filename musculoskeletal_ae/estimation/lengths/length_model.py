# SPDX-License-Identifier: Apache-2.0
"""Model of the readings of moments, to which length offsets and postures are fitted.

    l_read = l(θ, T) + o                       M equations for each moment, with D unknown angles
    0 = g(θ) + K θ − b + G(θ, T)ᵀ T            D more equations while the arm moves slowly

A moment is the mean of the readings over a short window. l_read are the lengths as read, o the
offsets, T the tensions, and θ the joint angles. g is the torque of the weight, and K and b describe
the springs of the joints. The network computes the lengths l and G = ∂l/∂θ.

The constants of the model are the offsets, the friction of every tendon, the offset of every
tension sensor, and the Coulomb friction torque of every joint. Residuals are divided by their
standard deviations. `MomentFit` is the fit of constants and postures by maximum likelihood, with
noise of Student's distribution for lengths and torques.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.lengths.length_moments import Moments
from musculoskeletal_ae.gauss_newton import Equations, RightSides, SolvedStep, student, student_cost
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

#: assume that the lengths of the network have errors of this standard deviation [m]
LENGTH_NOISE = 0.0004
#: assume that the joint torques of the network have errors of this standard deviation [N·m], apart
#: from friction
TORQUE_NOISE = 0.4
LIMIT_NOISE = 0.05  # let joint angles exceed their limits by this much (standard deviation) [rad]
NOISE_FACTORS = 0.3, 5.0  # multiply LENGTH_NOISE of a single muscle by a factor within these limits
#: weigh the length of an isolated muscle by this, relative to that of a used muscle, so that it has
#: no influence
ISOLATED_WEIGHT = 1e-6
#: let a known offset differ by this standard deviation from its value [m]
KNOWN_OFFSET = 0.001
#: expect that a stop may carry torque within this distance from the joint limit [rad]
AT_STOP = 0.03

# Prior of the constants; the mean is 0 except for FRICTION.
OFFSET = 0.1  # expect length offsets with this standard deviation [m]
FRICTION = 0.05  # expect tendon friction μ with this mean and this standard deviation
#: expect offsets of the tension sensors with this standard deviation [N], which also covers errors
#: of their gains
TENSION_OFFSET = 1.5
#: expect Coulomb friction torques of the joints with this standard deviation, relative to the
#: largest torque of the arm's weight
JOINT_FRICTION = 0.03

#: after a reversal, let the friction of a joint change its sign over this motion [rad]
STICKING = 0.003
#: relate joint friction to at least this share of the torque of the muscles at T_bias, because a
#: joint with a vertical axis carries no weight
LEAST_WEIGHT = 0.1

STEP = 1e-3  # compute numerical derivatives with steps of this size, of θ [rad] and of μ
LARGEST_STEP = 0.3  # change an angle by at most this in a Gauss–Newton step [rad]
#: add this to the diagonals of the normal matrices, so that these are positive definite
SMALL = 1e-6


class LengthModel:
    """Lengths and torques that one network predicts for moments, with their noise and prior.

    Attributes:
        used: Whether each muscle is used, that is, not isolated, (M,).
        prior_mean: Prior mean of the constants, (3M + D,).
        prior_spread: Prior standard deviation of the constants, (3M + D,).
        noise: Standard deviations of the residuals, (M + 2D,): of the lengths [m], then of the
            torques [N·m], then of the excess over the joint limits [rad].
    """

    def __init__(self, robot: Robot, mae: Mae, known: Array, rng: np.random.Generator) -> None:
        """Create the model.

        Args:
            robot: The robot.
            mae: The network.
            known: Known length offsets [m], (M,); NaN for those that are to be fitted.
            rng: Draws the postures over which the torques are compared.
        """
        self.robot, self._mae = robot, mae
        muscle_count, joint_count = robot.muscle_count, robot.joint_count
        postures = robot.random_postures(64, rng)
        weight = np.abs(robot.kinematics.weight_torque(postures)).max()
        moment_arms = np.abs(robot.routes.muscle_jacobian(postures))
        # Relate friction also to the muscles: a joint with a vertical axis carries no weight.
        by_bias = (robot.description.tension.bias @ moment_arms).max()
        weight = max(weight, LEAST_WEIGHT * by_bias)
        counts = muscle_count, muscle_count, muscle_count, joint_count
        self.prior_mean: Array = np.repeat([0.0, FRICTION, 0.0, 0.0], counts)
        spread = OFFSET, FRICTION, TENSION_OFFSET, JOINT_FRICTION * weight
        self.prior_spread: Array = np.repeat(spread, counts)
        is_known = np.flatnonzero(np.isfinite(known))
        self.prior_mean[is_known], self.prior_spread[is_known] = known[is_known], KNOWN_OFFSET
        self.used = ~np.isin(np.arange(muscle_count), mae.isolated)
        length_weight = np.where(self.used, 1.0, ISOLATED_WEIGHT)
        length_noise = LENGTH_NOISE * _noise_factors(mae) / length_weight
        of_joints = np.repeat([TORQUE_NOISE, LIMIT_NOISE], joint_count)
        self.noise: Array = np.concatenate((length_noise, of_joints))

    def outside(self, theta: Array) -> Array:
        """Return the excess of postures over the joint limits [rad], (..., D)."""
        return theta - np.clip(theta, self.robot.lower, self.robot.upper)

    def torque(self, theta: Array, tension: Array) -> tuple[Array, Array]:
        """Return the unbalanced joint torque and the muscle Jacobian in K postures.

        Args:
            theta: Postures [rad], (K, D).
            tension: Tensions [N], (K, M).

        Returns:
            The torque of weight, springs and muscles together [N·m], (K, D), and the muscle
            Jacobian ∂l/∂θ [m/rad], (K, M, D).
        """
        jacobian = self._mae.muscle_jacobian(theta, tension)
        by_muscles = np.einsum('kmd,km->kd', jacobian, tension)
        return self.robot.kinematics.holding_torque(theta) + by_muscles, jacobian

    def residuals(
        self,
        constants: Array,
        theta: Array,
        moments: Moments,
        turning: Array,
        derivatives: bool = False,
    ) -> tuple[Array, ...]:
        """Return the residuals of lengths, torques and joint limits, in standard deviations.

        Args:
            constants: The constants, (3M + D,).
            theta: Postures [rad], (K, D).
            moments: The readings.
            turning: Direction in which each joint moved last, (K, D).
            derivatives: Whether to return the derivatives as well.

        Returns:
            The residuals, (K, M + 2D), and, if requested, their derivatives with respect to θ,
            (K, M + 2D, D), and to the constants, (K, M + 2D, 3M + D).
        """
        muscles, joints = self.robot.muscle_count, self.robot.joint_count
        ends = [muscles, 2 * muscles, 3 * muscles]
        offset, friction, tension_offset, joint_friction = np.split(constants, ends)
        passed = np.exp(-friction * moments.sliding)  # T_end / T
        end, pull = moments.tension * passed, (moments.tension - tension_offset) * passed
        length, outside = self._mae.lengths(theta, end), self.outside(theta)
        unbalanced, jacobian = self.torque(theta, pull)
        torque = unbalanced + joint_friction * turning
        # A stop can carry any torque, so the residual of a joint at its stop means nothing. It is
        # replaced by a typical residual, so that the fit neither seeks nor avoids stops.
        low, high = self.robot.lower + AT_STOP, self.robot.upper - AT_STOP
        is_free = (low < theta) & (theta < high)
        torque = np.where(is_free, torque, TORQUE_NOISE)
        residuals = [moments.length - offset - length, torque, outside]
        value = np.concatenate(residuals, axis=1) / self.noise
        if not derivatives:
            return (value,)
        shifted = [self.torque(theta + STEP * row, pull)[0] for row in np.eye(joints)]
        torque_slope = (np.stack(shifted, axis=-1) - unbalanced[..., None]) / STEP
        torque_slope = torque_slope * is_free[..., None]
        outside_slope = (outside != 0.0)[..., None] * np.eye(joints)
        by_theta = np.concatenate([-jacobian, torque_slope, outside_slope], axis=1)
        by_constants = np.zeros((*value.shape, len(constants)))
        m, j = np.arange(muscles), np.arange(joints)
        by_constants[:, m, m] = -1.0
        with_more_friction = self._mae.lengths(theta, end * np.exp(-STEP * moments.sliding))
        by_constants[:, m, muscles + m] = (length - with_more_friction) / STEP
        moment_arm = -np.swapaxes(jacobian, 1, 2) * is_free[..., None]
        by_friction = moment_arm * (pull * moments.sliding)[:, None]
        by_constants[:, muscles:-joints, muscles + m] = by_friction
        by_constants[:, muscles:-joints, 2 * muscles + m] = moment_arm * passed[:, None]
        by_constants[:, muscles + j, 3 * muscles + j] = turning * is_free
        return value, by_theta / self.noise[:, None], by_constants / self.noise[:, None]


class LengthPoint(NamedTuple):
    """A point of the fit: values of the unknowns, and the residuals at these values."""

    #: length offset, friction and tension offset of each muscle, then friction of each joint,
    #: (3M + D,)
    constants: Array
    theta: Array  # postures of K moments [rad], (K, D)
    residual: Array  # residuals [standard deviations], (K, M + 2D)


class MomentFit:
    """Fit of the constants, and of the postures of K moments, as a `gauss_newton.Problem`."""

    def __init__(self, model: LengthModel, moments: Moments, theta: Array) -> None:
        """Prepare the fit; it starts with postures `theta` (K, D), which show how joints turn."""
        self._model, self._moments = model, moments
        self._turning = _turning(theta)
        self._largest_step = np.full(model.robot.joint_count, LARGEST_STEP)
        self._precision = model.prior_spread**-2
        self.usual = self._largest_step**-2, self._precision
        self._by_theta: Array  # ∂residual/∂θ, (K, M + 2D, D)
        self._by_constants: Array  # ∂residual/∂constants, (K, M + 2D, 3M + D)

    def point(self, constants: Array, theta: Array) -> LengthPoint:
        """Return the point of the fit with these values of constants and postures."""
        (value,) = self._model.residuals(constants, theta, self._moments, self._turning)
        return LengthPoint(constants, theta, value)

    def weigh(self, point: LengthPoint) -> None:
        """Compute the robust weights of length and torque residuals; joint limits weigh 1."""
        self._weight = student(point.residual)
        self._weight[:, -point.theta.shape[1] :] = 1.0

    def cost(self, point: LengthPoint) -> float:
        """Return the cost of a point with the present weights."""
        return float((self._weight * point.residual**2).sum()) + self._by_prior(point)

    def log_cost(self, point: LengthPoint) -> float:
        """Return −2 times the logarithm of the posterior at a point, up to a constant."""
        noisy, outside = np.split(point.residual, [-point.theta.shape[1]], axis=1)
        return student_cost(noisy) + float(np.square(outside).sum()) + self._by_prior(point)

    def _by_prior(self, point: LengthPoint) -> float:
        deviation = point.constants - self._model.prior_mean
        return float(self._precision @ deviation**2)

    def equations(self, point: LengthPoint) -> Equations:
        """Return the normal equations of a Gauss–Newton step from a point."""
        _, self._by_theta, self._by_constants = self._model.residuals(
            point.constants, point.theta, self._moments, self._turning, derivatives=True
        )
        weighted = self._weight[..., None] * self._by_constants
        mixed = self._by_theta.swapaxes(1, 2) @ weighted
        by_theta = self._by_theta.swapaxes(1, 2) @ (self._weight[..., None] * self._by_theta)
        tall = self._by_constants.reshape(-1, weighted.shape[-1])
        common = tall.T @ weighted.reshape(tall.shape) + np.diag(self._precision)
        return Equations(by_theta + SMALL * np.eye(by_theta.shape[-1]), mixed, common)

    def right_sides(self, point: LengthPoint) -> RightSides:
        """Return the right sides of the normal equations of a Gauss–Newton step from a point."""
        weighted = self._weight * point.residual
        by_prior = self._precision * (self._model.prior_mean - point.constants)
        return RightSides(
            -np.einsum('krd,kr->kd', self._by_theta, weighted),
            by_prior - np.tensordot(weighted, self._by_constants, 2),
        )

    def moved(self, point: LengthPoint, step: SolvedStep) -> LengthPoint:
        """Return the point to which a step leads; each angle changes by at most LARGEST_STEP."""
        turned = np.clip(step.samples, -self._largest_step, self._largest_step)
        return self.point(point.constants + step.common, point.theta + turned)


def _turning(theta: Array) -> Array:
    """Return the direction in which each joint moved last, in [−1, 1], (K, D).

    After a reversal, the direction changes its sign over a motion of STICKING. `theta` are K
    consecutive postures [rad], (K, D).
    """
    result, reference = np.zeros_like(theta), theta[0].copy()
    for k, posture in enumerate(theta):
        reference = np.clip(reference, posture - STICKING, posture + STICKING)
        result[k] = (posture - reference) / STICKING
    return result


def _noise_factors(mae: Mae) -> Array:
    """Return the assumed length error of each muscle, relative to that of a typical muscle, (M,).

    The factor is the variance of the muscle's length residual, divided by the median variance. For
    independent errors, the ratio of standard deviations would be correct. But the errors of a
    network in neighbouring postures are correlated, so with standard deviations, a muscle with
    large errors would bias the offsets of all other muscles. The ratio of variances gives such a
    muscle less weight.
    """
    if mae.anomaly is None:
        return np.ones(len(mae.muscles))
    variance = np.diag(mae.anomaly.covariance)[len(mae.muscles) :]
    return np.clip(variance / np.median(variance), *NOISE_FACTORS)
