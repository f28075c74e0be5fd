# SPDX-License-Identifier: Apache-2.0
"""The remainder: what the samples show of the lengths, and the calibrated body cannot express.

    l_i(θ, T) = body_i(θ, T; w_i) + g_i(θ, T),   g_i ~ GP(0, k),   l_i measured with noise σ_i

    k = a² exp(−‖(θ − θ')/(b R)‖²/2 − ‖(T − T')/(c T_limit)‖²/2)

R are the joint ranges. g depends on all joints and tensions of a group, whereas the constants of
the body affect only muscles that cross a joint. It represents, for example, an elastic body whose
links bend together, or tendons that stretch unlike their model.

The samples decide how far the body is trusted. The amplitude a, the scales b and c and the noise
are those with the largest evidence, which is the probability of the lengths after the parameters w
of the body have been integrated out over their prior:

    l_i − l_i(θ, T; w̄_i) ~ N(0, J_i S_i² J_iᵀ + k + σ² diag(1/ω_i)),   J_i = ∂l_i/∂w_i

S are the spreads of the prior, and ω the robust weights of the fit. If the body explains the
lengths, a falls to nearly zero. If it does not, g approaches the true lengths with more samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.learning.samples import Observations
from musculoskeletal_ae.robot.robot import Robot

if TYPE_CHECKING:
    from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
    from musculoskeletal_ae.body_model.priors import MusclePrior

#: Unknowns of the evidence are the natural logarithms of a, b, c and σ, relative to these units:
#: [m], joint ranges, T_limit and [m].
UNITS = np.array([0.002, 0.5, 1.0, 0.001])
USUAL = np.array([-1.5, 0.5, 2.0, -2.0])  # means of their prior
SPREAD = np.array([2.0, 0.4, 1.0, 1.5])  # standard deviations of their prior
BOUNDS = ((-8.0, 4.0), (-1.5, 3.0), (-1.5, 4.0), (-1.2, 3.0))
#: initial values of a search: a trusted body, a wrong body, and one with a rough remainder
STARTS = USUAL, USUAL + [2.5, 0.0, 0.0, 0.0], USUAL + [3.0, -1.0, 0.0, 1.0]
#: Number of samples below which each search begins with STARTS. The evidence of few samples has
#: several maxima, which change with each sample. Later searches continue from the last result.
FEW_SAMPLES = 60
ROUNDS = 25  # largest number of iterations of a search that begins with STARTS
FEW_ROUNDS = 4  # largest number of iterations of a search that continues from an earlier result
JUDGING = 150  # largest number of samples that the evidence is computed from
LEAST_SAMPLES = 5  # smallest number of samples from which a remainder is learned
UNKNOWN = 1.0  # variance of a length that a sample does not describe [m²]
JITTER = 1e-10  # variance that keeps covariances positive definite [m²]


class Lengths(NamedTuple):
    """Lengths of the N samples of one group, relative to the prior mean of the body."""

    theta: Array  # θ [rad], (N, D)
    tension: Array  # T or T_read [N], (N, M)
    deviation: list[Array]  # l − l(θ, T; w̄) of each muscle [m], (N,)
    by_body: list[Array]  # J S: change of each length with w in units of the spreads [m], (N, P)
    weight: Array  # robust weights ω, (N, M)

    @classmethod
    def of(
        cls,
        body: CalibratedBody,
        observed: Observations,
        weight: Array,
        priors: Sequence[MusclePrior],
    ) -> Lengths:
        """Return the samples of one group, with lengths relative to those of the prior mean body.

        Args:
            body: The fitted body of the group, without a remainder.
            observed: The samples of the group, with all joint angles.
            weight: Robust weights of the lengths, (N, M).
            priors: Prior of each muscle of the group.
        """
        poses, deviation, by_body = body.poses(observed.theta), list[Array](), list[Array]()
        for m, prior in enumerate(priors):
            smooth = body.smooth[m].at(observed.theta)
            tension, direction = observed.tension[:, m], observed.direction[:, m]
            length, jacobian = body.linearised(poses, smooth, tension, direction, m, observed.age)
            moved = jacobian @ (body.parameters[m] - prior.mean)
            deviation.append(observed.length[:, m] - length + moved)
            by_body.append(jacobian * prior.spread)
        return cls(observed.theta, observed.tension, deviation, by_body, weight)

    def part(self, rows: Ints) -> Lengths:
        """Return some of the samples."""
        deviation, by_body = ([own[rows] for own in part] for part in self[2:4])
        return Lengths(self.theta[rows], self.tension[rows], deviation, by_body, self.weight[rows])


@dataclass(frozen=True, eq=False)
class GroupRemainder:
    """The remainder g of one group of joints and muscles."""

    joints: Ints
    muscles: Ints
    scale: Array  # units of the inputs: R of the joints, T_limit of the muscles, (D+M,)
    logarithms: Array  # natural logarithms of a, b, c and σ in units of UNITS, (4,)
    inputs: Array  # θ and T of the samples in units of `scale`, (N, D+M)
    weights: Array  # α, (N, M): g = k(·, inputs) α
    #: error of each length that is predicted from all other samples [m], (N, M)
    left_out: Array
    #: lower Cholesky factor of k + σ² diag(1/ω), with the mean ω of all muscles, (N, N)
    root: Array

    def at(self, theta: Array, tension: Array) -> Array:
        """Return g [m] of the group's muscles, (N, M), for θ and T of the whole body."""
        return self._covariance(theta, tension) @ self.weights

    def spread(self, theta: Array, tension: Array) -> Array:
        """Return the posterior standard deviation of each g_i for a known body [m], (N,)."""
        covariance = self._covariance(theta, tension)
        known = np.square(solve_triangular(self.root, covariance.T, lower=True)).sum(axis=0)
        amplitude = _constants(self.logarithms)[0]
        return np.sqrt(np.maximum(amplitude**2 - known, 0.0))

    def text(self) -> str:
        """Return the four constants as text."""
        amplitude, by_theta, by_tension, noise = _constants(self.logarithms)
        sizes = f'a {1e3 * amplitude:.1f} mm, b {by_theta:.2f}, c {by_tension:.1f}'
        return f'{sizes}, σ {1e3 * noise:.2f} mm'

    def _covariance(self, theta: Array, tension: Array) -> Array:
        inputs = np.hstack([theta[:, self.joints], tension[:, self.muscles]]) / self.scale
        return _kernel(_squares(inputs, self.inputs, len(self.joints)), self.logarithms)


@dataclass(frozen=True, eq=False)
class Remainder:
    """The remainder g of a whole body: the groups in which samples have shown one.

    `before` is a remainder that is added, for example that of the network from which learning
    continues.
    """

    muscle_count: int
    groups: tuple[GroupRemainder, ...] = ()
    before: Remainder | None = None

    def at(self, theta: Array, tension: Array) -> Array:
        """Return g(θ, T) [m] (N, M) at θ [rad] (N, D) and T [N] (N, M)."""
        result = np.zeros((len(theta), self.muscle_count))
        for group in self.groups:
            result[:, group.muscles] = group.at(theta, tension)
        return result if self.before is None else result + self.before.at(theta, tension)

    def drawn_error(self, theta: Array, tension: Array, rng: np.random.Generator) -> Array:
        """Draw the error of g [m] (N, M) from its posterior, independently for each sample."""
        result = np.zeros((len(theta), self.muscle_count))
        for group in self.groups:
            spread = group.spread(theta, tension)[:, None]
            result[:, group.muscles] = spread * rng.standard_normal(
                (len(theta), len(group.muscles))
            )
        return result


def learned_remainder(
    body: CalibratedBody, observed: Observations, weight: Array, priors: Sequence[MusclePrior]
) -> Remainder:
    """Learn the remainder of a fitted body from the samples whose joint angles are all known.

    Args:
        body: The fitted body.
        observed: The samples, with joint angles corrected for the offsets of the joint sensors.
        weight: Robust weights of the lengths, (N, M).
        priors: Prior of each muscle.
    """
    present, before = body.remainder, body.remainder.before
    starts = {group.joints.tobytes(): group.logarithms for group in present.groups}
    groups = []
    for group in body.robot.groups:
        joints, muscles = np.array(group.joints), np.array(group.muscles)
        rows = np.flatnonzero(np.isfinite(observed.theta[:, joints]).all(axis=1))
        if len(rows) < LEAST_SAMPLES or not min(map(len, group)):
            continue
        own = observed[rows]
        if before is not None:
            own = replace(own, length=own.length - before.at(own.theta, own.tension))
        limb, priors_of_group = body.limb(joints, muscles), [priors[m] for m in muscles]
        of_group = Lengths.of(
            limb, own.limb(joints, muscles), weight[np.ix_(rows, muscles)], priors_of_group
        )
        start = starts.get(joints.tobytes())
        groups.append(group_remainder(body.robot, joints, muscles, of_group, start))
    return Remainder(body.robot.muscle_count, tuple(groups), before)


def group_remainder(
    robot: Robot, joints: Ints, muscles: Ints, lengths: Lengths, start: Array | None
) -> GroupRemainder:
    """Learn the remainder of one group from samples.

    Args:
        robot: The whole robot.
        joints: Joints of the group.
        muscles: Muscles of the group.
        lengths: The samples.
        start: Logarithms of a, b, c and σ from which the search starts; None to search from the
            beginning.
    """
    ranges = (robot.upper - robot.lower)[joints]
    scale = np.concatenate([ranges, robot.tension.limit[muscles]])
    if not robot.tension_source.is_known:
        scale[len(joints) :] = np.inf  # the tensions say nothing
    count = len(lengths.theta)
    rows = np.arange(count)
    if count > JUDGING:
        rows = np.linspace(0, count - 1, JUDGING).astype(int)
    evidence = _Evidence(lengths.part(rows), scale)
    is_fresh = start is None or count < FEW_SAMPLES
    starts = [*([] if start is None else [start]), *(STARTS if is_fresh else [])]
    rounds = ROUNDS if is_fresh else FEW_ROUNDS
    found = [
        minimize(
            evidence, each, jac=True, method='L-BFGS-B', bounds=BOUNDS, options={'maxiter': rounds}
        )
        for each in starts
    ]
    logarithms = min(found, key=lambda result: result.fun).x
    inputs = np.hstack([lengths.theta, lengths.tension]) / scale
    kernel = _kernel(_squares(inputs, inputs, len(joints)), logarithms)
    weights, left_out = [], []
    for m in range(len(muscles)):
        noise = _variances(lengths.weight[:, m], logarithms)
        covariance = kernel + lengths.by_body[m] @ lengths.by_body[m].T + np.diag(noise)
        inverse = cho_solve((cholesky(covariance, lower=True), True), np.eye(count))
        weights.append(inverse @ lengths.deviation[m])
        left_out.append(weights[-1] / np.diag(inverse))
    of_muscles, errors = (np.stack(part, axis=1) for part in (weights, left_out))
    noise = _variances(lengths.weight.mean(axis=1), logarithms)
    root = cholesky(kernel + np.diag(noise), lower=True)
    return GroupRemainder(joints, muscles, scale, logarithms, inputs, of_muscles, errors, root)


class _Evidence:
    """Negative logarithm of the evidence, and its derivatives by the four logarithms."""

    def __init__(self, lengths: Lengths, scale: Array) -> None:
        self._lengths = lengths
        inputs = np.hstack([lengths.theta, lengths.tension]) / scale
        self._squares = _squares(inputs, inputs, lengths.theta.shape[1])
        self._by_body = [part @ part.T for part in lengths.by_body]

    def __call__(self, logarithms: Array) -> tuple[float, Array]:
        kernel = _kernel(self._squares, logarithms)
        value, identity = 0.0, np.eye(len(kernel))
        common, by_noise = np.zeros_like(kernel), 0.0
        for m, by_body in enumerate(self._by_body):
            noise = _variances(self._lengths.weight[:, m], logarithms)
            try:
                root = cholesky(by_body + kernel + np.diag(noise), lower=True, check_finite=False)
            except LinAlgError:
                return 1e12, np.zeros(4)
            inverse = cho_solve((root, True), identity, check_finite=False)
            weights = inverse @ self._lengths.deviation[m]
            value += 0.5 * float(weights @ self._lengths.deviation[m])
            value += float(np.log(np.diag(root)).sum())
            slope = inverse - np.outer(weights, weights)
            common += slope
            used = self._lengths.weight[:, m] > 0.0
            by_noise += float(np.diag(slope)[used] @ noise[used])
        _, by_theta, by_tension, _ = _constants(logarithms)
        angles, tensions = self._squares
        deviation = (logarithms - USUAL) / SPREAD
        weighted = common * kernel
        gradient = np.array(
            [
                weighted.sum(),
                0.5 * (weighted * angles).sum() / by_theta**2,
                0.5 * (weighted * tensions).sum() / by_tension**2,
                by_noise,
            ]
        )
        return value + 0.5 * float(deviation @ deviation), gradient + deviation / SPREAD


def _constants(logarithms: Array) -> Array:
    """Return a [m], b, c and σ [m]."""
    constants: Array = UNITS * np.exp(logarithms)
    return constants


def _squares(one: Array, other: Array, joints: int) -> tuple[Array, Array]:
    """Return squared distances between inputs by angles and by tensions, (N, K) each."""
    parts = (one[:, :joints], other[:, :joints]), (one[:, joints:], other[:, joints:])
    by_angle, by_tension = (
        np.maximum(np.square(a).sum(axis=1)[:, None] + np.square(b).sum(axis=1) - 2 * a @ b.T, 0.0)
        for a, b in parts
    )
    return by_angle, by_tension


def _kernel(squares: Sequence[Array], logarithms: Array) -> Array:
    amplitude, by_theta, by_tension, _ = _constants(logarithms)
    exponent = squares[0] / by_theta**2 + squares[1] / by_tension**2
    kernel: Array = amplitude**2 * np.exp(-0.5 * exponent)
    return kernel


def _variances(weight: Array, logarithms: Array) -> Array:
    """Return the variance of measured lengths with robust weights ω (N,) [m²], (N,)."""
    variances = np.full(len(weight), UNKNOWN)
    used = weight > 0.0
    variances[used] = _constants(logarithms)[3] ** 2 / weight[used] + JITTER
    return variances
