# SPDX-License-Identifier: Apache-2.0
"""Fits the length offsets, and the postures of all moments, to readings of length and tension.

    l_read = l(θ, T) + o                       M equations for each moment, with D unknown angles
    0 = g(θ) + K θ − b + G(θ, T)ᵀ T            D more equations while the arm moves slowly

A moment is the mean of the readings over a short window. l_read are the lengths as read, o the
offsets, T the tensions, and θ the joint angles. g is the torque of the weight, and K and b describe
the springs of the joints. The network computes the lengths l and G = ∂l/∂θ.

If the joint angles were measured, o is the mean residual of the first line. Otherwise the offsets
and the postures of all moments are estimated together, by maximum likelihood with noise of
Student's distribution. Because muscles outnumber joints and G changes with the posture, only one
set of offsets explains all moments of a moving arm. The second line already restricts the posture
at the first moment, when the lengths alone do not.

The fit is a damped Gauss–Newton method that eliminates the postures. It starts from the best of
many random postures of the first moment. Besides the offsets it estimates the friction of every
tendon, the offset of every tension sensor, and the Coulomb friction torque of every joint.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.estimation.length_moments import Moments
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.wiring import Judgement, Wiring, decide, single_faults

# Constants in rad and N·m are for revolute joints. For a prismatic joint, angles are multiplied by
# `kinematics.RACK` and become [m], and torques are divided by it and become [N].

LENGTH_NOISE = 0.0004  # standard deviation of the network's error of a length [m]
#: standard deviation of the network's error of a joint torque, apart from friction [N·m]
TORQUE_NOISE = 0.4
LIMIT_NOISE = 0.05  # standard deviation of the excess of a joint angle over its limits [rad]
NOISE_FACTORS = 0.3, 5.0  # smallest and largest factor of LENGTH_NOISE for a single muscle
ISOLATED_WEIGHT = 1e-6  # weight of an isolated muscle's length relative to a used muscle's
FREEDOM = 4.0  # degrees of freedom of Student's distribution
AT_STOP = 0.03  # distance from a joint limit below which the stop may carry torque [rad]

# Prior of the constants; the mean is 0 except for FRICTION.
OFFSET = 0.1  # prior standard deviation of a length offset [m]
FRICTION = 0.05  # prior mean and standard deviation of the friction coefficient μ of a tendon
#: prior standard deviation of a tension sensor's offset [N]; it covers the error of the gain
TENSION_OFFSET = 1.5
#: prior standard deviation of the Coulomb torque of a joint, relative to the largest torque of the
#: weight
JOINT_FRICTION = 0.03

STICKING = 0.003  # motion after a reversal over which the friction of a joint changes sign [rad]
#: lower limit of the largest torque of the weight, relative to the largest torque of the muscles at
#: T_bias
LEAST_WEIGHT = 0.1

# Constants of the search for initial values.
DRAWN_POSTURES = 3200  # number of random postures whose torques at the first moment are compared
FITTED_POSTURES = 400  # number of the best drawn postures, which are fitted coarsely to the lengths
COMPARED_FITS = 30  # number of the best coarse fits, which are then also compared by torque
REFINED_FITS = 6  # number of the best coarse fits, which are refined
FEW_MOMENTS = 24  # number of moments that the search uses
BATCH = 20  # number of postures that are fitted during one message
COARSE_LENGTH = 0.01  # standard deviation of a length in coarse fits [m]
COARSE_TORQUE = 2.0  # standard deviation of a torque in coarse fits [N·m]
COARSE_ANGLE = 0.1  # standard deviation of the excess over joint limits in coarse fits [rad]

# Constants of the judgement of the wiring.
LIKELY = 3  # number of the likeliest wirings that are fitted to all moments
MOST_FAULTS = 3  # largest number of exchanges and reversed signs that are searched for

FARTHEST = 0.3  # largest offset [m], and largest change of an angle in a Gauss–Newton step [rad]
ROUNDS = 20  # largest number of Gauss–Newton steps
FIRST_ROUNDS = 6  # largest number of Gauss–Newton steps in the search for initial values
STEP = 1e-3  # step of numerical derivatives, of θ [rad] and of μ
LARGEST_DAMPING = 1e4  # damping at which the fit ends, because no step lowers the cost


class Fit(NamedTuple):
    """Length offsets and other constants that were fitted to the readings of K moments.

    Attributes:
        cost: −2 times the logarithm of the posterior, up to a constant; 0 if the joint angles were
            measured.
        constants: Length offsets [m], friction coefficients of the tendons, offsets of the tension
            sensors [N], and Coulomb friction torques of the joints [N·m], (3M + D,).
        theta: Postures [rad], (K, D).
    """

    cost: float
    constants: Array
    theta: Array


Steps = Generator[None, None, Fit]  # yields after each short piece of work, and returns a fit


class LengthFit:
    """Fits length offsets with one network.

    Attributes:
        used: Whether each muscle is used, that is, not isolated, (M,).
    """

    def __init__(self, robot: Robot, mae: Mae) -> None:
        robot = robot.with_elasticity(mae.elasticity)
        self._robot, self._mae = robot, mae
        self._rng = np.random.default_rng([0, 0x2E])
        muscle_count, joint_count = robot.muscle_count, robot.joint_count
        self._radian = radian = robot.kinematics.radian
        postures = robot.random_postures(64, self._rng)
        weight = np.abs(radian * robot.kinematics.weight_torque(postures)).max()
        moment_arms = np.abs(radian * robot.routes.muscle_jacobian(postures))
        # Joints with a vertical axis have friction although they carry no weight.
        by_bias = (robot.description.tension.bias @ moment_arms).max()
        weight = max(weight, LEAST_WEIGHT * by_bias)
        counts = muscle_count, muscle_count, muscle_count, joint_count
        self._prior_mean = np.repeat([0.0, FRICTION, 0.0, 0.0], counts)
        spread = OFFSET, FRICTION, TENSION_OFFSET, JOINT_FRICTION * weight
        self._prior_spread = np.repeat(spread, counts)
        self._prior_spread[-joint_count:] /= radian
        self._torque_noise = TORQUE_NOISE / radian
        self.used = ~np.isin(np.arange(muscle_count), mae.isolated)
        length_weight = np.where(self.used, 1.0, ISOLATED_WEIGHT)
        length_noise = LENGTH_NOISE * _noise_factors(mae) / length_weight
        #: standard deviations of the residuals, (M + 2D,)
        self._noise = np.concatenate((length_noise, self._torque_noise, LIMIT_NOISE * radian))

    def known_angles(self, moments: Moments) -> Fit:
        """Fit the offsets to moments whose joint angles were measured.

        A moment is the mean of the readings over a short window.
        """
        residual = moments.length - self._mae.lengths(moments.theta, moments.tension)
        muscle_count = self._robot.muscle_count
        constants = np.concatenate([residual.mean(axis=0), self._prior_mean[muscle_count:]])
        return Fit(0.0, constants, moments.theta)

    def unknown_angles(self, moments: Moments, before: Fit | None) -> Steps:
        """Fit the offsets to moments whose joint angles were not measured.

        The generator yields after each short piece of work, and returns the fit at the end.

        Args:
            moments: The moments.
            before: An earlier fit, from whose constants the fit starts a second time, or None.
        """
        few = moments.rows(_few(moments))
        guesses = yield from self._guesses(moments, few)
        likeliest = yield from self._best(guesses, few, FIRST_ROUNDS)
        # A few moments may mislead. All moments decide between the new start and the earlier fit.
        candidates = [likeliest.constants]
        if before is not None:
            candidates.append(before.constants)
        return (yield from self._best(candidates, moments, ROUNDS))

    def wiring(self, fit: Fit, moments: Moments) -> Generator[None, None, Judgement]:
        """Judge whether columns are exchanged or have a wrong sign.

        Each wiring that differs by one fault is fitted to a few moments. The fit begins with the
        postures of `fit`, which are roughly right although some columns are wrong. All moments
        decide among the likeliest wirings. If a fault is found, another one is searched for. The
        generator yields after each short piece of work.

        Args:
            fit: The fit to the readings as they are.
            moments: The moments to which it was fitted.
        """
        wiring = Wiring.straight(self._robot.muscle_count)
        judgement, columns = Judgement(wiring, (wiring,), (), fit.cost), np.flatnonzero(self.used)
        rows = _few(moments)
        for _ in range(MOST_FAULTS):
            wiring, coarse = judgement.wiring, list[tuple[float, Wiring]]()
            for other in single_faults(wiring, columns.tolist()):
                start = self._start(fit, moments, wiring, other, rows)
                few = _rewired(moments.rows(rows), other)
                coarse.append(((yield from self._refine(start, few, FIRST_ROUNDS)).cost, other))
            likely, fits = sorted(coarse, key=lambda each: each[0])[:LIKELY], dict[Wiring, Fit]()
            for _, other in likely:
                start = self._start(fit, moments, wiring, other, np.arange(len(moments.length)))
                fits[other] = yield from self._refine(start, _rewired(moments, other), ROUNDS)
            costs = [(other, max(other_fit.cost, 0.0)) for other, other_fit in fits.items()]
            newest = decide(wiring, fit.cost, costs)
            if newest.wiring == wiring:
                break
            judgement, fit = newest, fits[newest.wiring]
        return judgement

    def _start(self, fit: Fit, moments: Moments, before: Wiring, after: Wiring, rows: Ints) -> Fit:
        """Return an initial fit of one wiring, from a fit of another one.

        The postures are kept, and so are all constants except the length offsets of the muscles
        whose columns change.

        Args:
            fit: The fit to all moments with the wiring `before`.
            moments: The moments.
            before: The wiring of `fit`.
            after: The wiring of the result.
            rows: Indices of the moments to which the result applies.
        """
        few, theta, constants = _rewired(moments.rows(rows), after), fit.theta[rows], fit.constants
        constants = constants.copy()
        changed = [
            muscle
            for now, then in zip(zip(*before), zip(*after))
            for muscle in (now[0], then[0])
            if now != then
        ]
        error = few.length - self._mae.lengths(theta, few.tension)
        constants[changed] = np.median(error[:, changed], axis=0)
        return Fit(np.inf, constants, theta)

    def cost_per_residual(self, fit: Fit) -> float:
        """Return the cost of a fit, divided by the number of its length and torque residuals."""
        return fit.cost / (len(fit.theta) * (len(self._noise) - self._robot.joint_count))

    # -- search for a start ---------------------------------------------------------------------

    def _best(self, guesses: list[Array], moments: Moments, rounds: int) -> Steps:
        """Refine each guess of the constants, and return the best fit."""
        fits = list[Fit]()
        for constants in guesses:
            length = moments.length - constants[: self._robot.muscle_count]
            theta = self._mae.estimate(moments.tension, length).theta
            theta = np.clip(theta, self._robot.lower, self._robot.upper)
            fits.append((yield from self._refine(Fit(np.inf, constants, theta), moments, rounds)))
        return min(fits, key=lambda fit: fit.cost)

    def _guesses(self, moments: Moments, few: Moments) -> Generator[None, None, list[Array]]:
        """Search for initial values of the constants by drawing postures of the first moment.

        Each posture of the first moment implies offsets. The search compares how well the offsets
        explain the other moments. It yields after each short piece of work.

        Args:
            moments: All moments.
            few: The moments on which the search compares postures.

        Returns:
            The best initial values, each an array of all constants, (3M + D,).
        """
        mae = self._mae
        tension = np.tile(moments.tension[0], (FITTED_POSTURES, 1))
        # The balance of torques excludes most postures before any offset is known.
        drawn, unbalanced = list[Array](), list[Array]()
        for _ in range(DRAWN_POSTURES // FITTED_POSTURES):
            drawn.append(self._robot.random_postures(FITTED_POSTURES, self._rng))
            torque = self._radian * self._torque(drawn[-1], tension)[0]
            unbalanced.append(np.linalg.norm(torque, axis=1))
            yield
        first = np.concatenate(drawn)[np.argsort(np.concatenate(unbalanced))[:FITTED_POSTURES]]
        offset = moments.length[0] - mae.lengths(first, tension)
        largest = np.abs(offset * self.used).max(axis=1)
        plausible = max(REFINED_FITS, int((largest < FARTHEST).sum()))
        offset = offset[np.argsort(largest)[:plausible]]
        cost, postures = np.empty(len(offset)), list[Array]()
        for n in range(0, len(offset), BATCH):
            length = few.length - offset[n : n + BATCH, None]
            tension = np.broadcast_to(few.tension, length.shape)
            theta = mae.estimate(tension, length).theta
            residual = self.used * (length - mae.lengths(theta, tension))
            parts = residual / COARSE_LENGTH, self._outside(theta) / (COARSE_ANGLE * self._radian)
            costs = [np.log1p(each**2).sum(axis=(1, 2)) for each in parts]
            cost[n : n + BATCH] = np.sum(costs, axis=0)
            postures.extend(theta)
            yield
        order = np.argsort(cost)[:COMPARED_FITS]
        for n in order:
            torque = self._radian * self._torque(postures[n], few.tension)[0] / COARSE_TORQUE
            cost[n] += np.log1p(torque**2).sum()
            yield
        best = order[np.argsort(cost[order])][:REFINED_FITS]
        others = self._prior_mean[self._robot.muscle_count :]
        return [np.concatenate([offset[n], others]) for n in best]

    # -- residuals ------------------------------------------------------------------------------

    def _outside(self, theta: Array) -> Array:
        return theta - np.clip(theta, self._robot.lower, self._robot.upper)

    def _torque(self, theta: Array, tension: Array) -> tuple[Array, Array]:
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
        return self._robot.kinematics.holding_torque(theta) + by_muscles, jacobian

    def _residuals(
        self, fit: Fit, moments: Moments, turning: Array, derivatives: bool = False
    ) -> tuple[Array, ...]:
        """Return the residuals of lengths, torques and joint limits, in standard deviations.

        Args:
            fit: Constants and postures.
            moments: The readings.
            turning: Direction in which each joint moved last, (K, D).
            derivatives: Whether to return the derivatives as well.

        Returns:
            The residuals, (K, M + 2D), and, if requested, their derivatives with respect to θ,
            (K, M + 2D, D), and to the constants, (K, M + 2D, 3M + D).
        """
        theta, muscles, joints = fit.theta, self._robot.muscle_count, self._robot.joint_count
        ends = [muscles, 2 * muscles, 3 * muscles]
        offset, friction, tension_offset, joint_friction = np.split(fit.constants, ends)
        passed = np.exp(-friction * moments.sliding)  # T_end / T
        end, pull = moments.tension * passed, (moments.tension - tension_offset) * passed
        length, outside = self._mae.lengths(theta, end), self._outside(theta)
        unbalanced, jacobian = self._torque(theta, pull)
        torque = unbalanced + joint_friction * turning
        # A stop can carry any torque, so the residual of a joint at its stop means nothing. It is
        # replaced by a typical one, so that the fit neither seeks nor avoids stops.
        at_stop = AT_STOP * self._radian
        is_free = (self._robot.lower + at_stop < theta) & (theta < self._robot.upper - at_stop)
        torque = np.where(is_free, torque, self._torque_noise)
        residuals = [moments.length - offset - length, torque, outside]
        value = np.concatenate(residuals, axis=1) / self._noise
        if not derivatives:
            return (value,)
        shifted = [self._torque(theta + STEP * row, pull)[0] for row in np.eye(joints)]
        torque_slope = (np.stack(shifted, axis=-1) - unbalanced[..., None]) / STEP
        torque_slope = torque_slope * is_free[..., None]
        outside_slope = (outside != 0.0)[..., None] * np.eye(joints)
        by_theta = np.concatenate([-jacobian, torque_slope, outside_slope], axis=1)
        by_constants = np.zeros((*value.shape, len(fit.constants)))
        m, j = np.arange(muscles), np.arange(joints)
        by_constants[:, m, m] = -1.0
        with_more_friction = self._mae.lengths(theta, end * np.exp(-STEP * moments.sliding))
        by_constants[:, m, muscles + m] = (length - with_more_friction) / STEP
        moment_arm = -np.swapaxes(jacobian, 1, 2) * is_free[..., None]
        by_friction = moment_arm * (pull * moments.sliding)[:, None]
        by_constants[:, muscles:-joints, muscles + m] = by_friction
        by_constants[:, muscles:-joints, 2 * muscles + m] = moment_arm * passed[:, None]
        by_constants[:, muscles + j, 3 * muscles + j] = turning * is_free
        return value, by_theta / self._noise[:, None], by_constants / self._noise[:, None]

    def _cost(self, value: Array, constants: Array) -> float:
        noisy, outside = np.split(value, [-self._robot.joint_count], axis=1)
        student = (FREEDOM + 1.0) * np.log1p(noisy**2 / FREEDOM).sum()
        prior = np.square((constants - self._prior_mean) / self._prior_spread).sum()
        return float(student + np.square(outside).sum() + prior)

    # -- Gauss–Newton ---------------------------------------------------------------------------

    def _refine(self, fit: Fit, moments: Moments, rounds: int) -> Steps:
        """Refine a fit by at most `rounds` Gauss–Newton steps."""
        joint_eye, constant_eye = np.eye(self._robot.joint_count), np.eye(len(self._prior_mean))
        damping = 1e-3
        turning = _turning(fit.theta, STICKING * self._radian)
        farthest = FARTHEST * self._radian
        (value,) = self._residuals(fit, moments, turning)
        fit = fit._replace(cost=self._cost(value, fit.constants))
        for _ in range(rounds):
            yield
            value, by_theta, by_constants = self._residuals(fit, moments, turning, derivatives=True)
            weight = (FREEDOM + 1.0) / (FREEDOM + value**2)
            weight[:, -len(joint_eye) :] = 1.0
            # Blocks of the normal equations: θ of each moment, the constants, and the cross terms.
            weighted = weight[..., None] * by_theta
            theta_normal = np.swapaxes(by_theta, 1, 2) @ weighted
            theta_gradient = np.einsum('krd,kr->kd', weighted, value)
            cross = np.swapaxes(by_constants, 1, 2) @ weighted
            normal = np.einsum('krp,kr,krq->pq', by_constants, weight, by_constants, optimize=True)
            normal += np.diag(self._prior_spread**-2)
            gradient = np.einsum('krp,kr->p', by_constants, weight * value)
            gradient += (fit.constants - self._prior_mean) / self._prior_spread**2
            before = fit.cost
            while damping < LARGEST_DAMPING:
                # Eliminate θ, solve for the constants, and substitute back.
                damped = theta_normal * (1.0 + damping * joint_eye) + 1e-6 * joint_eye
                inverse = np.linalg.inv(damped)
                through = cross @ inverse
                reduced = normal * (1.0 + damping * constant_eye)
                reduced = reduced - np.einsum('kpd,kqd->pq', through, cross)
                eliminated = np.einsum('kpd,kd->p', through, theta_gradient)
                shift = -np.linalg.solve(reduced, gradient - eliminated)
                turn = theta_gradient + np.einsum('kpd,p->kd', cross, shift)
                turn = np.clip(-np.einsum('kij,kj->ki', inverse, turn), -farthest, farthest)
                candidate = Fit(np.inf, fit.constants + shift, fit.theta + turn)
                (value,) = self._residuals(candidate, moments, turning)
                cost = self._cost(value, candidate.constants)
                if cost < before:
                    break
                damping *= 5.0
                yield
            else:
                break
            fit, damping = candidate._replace(cost=cost), max(0.2 * damping, 1e-6)
            if before - cost < 1e-4 * before and np.abs(shift).max() < 1e-4:
                break
        return fit


def _few(moments: Moments) -> Ints:
    """Return the indices of FEW_MOMENTS moments, evenly distributed."""
    last = len(moments.length) - 1
    few: Ints = np.unique(np.linspace(0, last, FEW_MOMENTS).astype(np.int64))
    return few


def _rewired(moments: Moments, wiring: Wiring) -> Moments:
    """Return moments in the order and with the signs of the muscles, according to a wiring."""
    return Moments(
        wiring.unsigned(moments.tension),
        wiring.signed(moments.length),
        wiring.signed(moments.sliding),
        wiring.signed(moments.read),
        moments.theta,
    )


def _turning(theta: Array, sticking: Array) -> Array:
    """Return the direction in which each joint moved last, in [−1, 1], (K, D).

    Args:
        theta: K consecutive postures [rad], (K, D).
        sticking: Motion after a reversal over which the direction changes its sign [rad], (D,).
    """
    result, reference = np.zeros_like(theta), theta[0].copy()
    for k, posture in enumerate(theta):
        reference = np.clip(reference, posture - sticking, posture + sticking)
        result[k] = (posture - reference) / sticking
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
