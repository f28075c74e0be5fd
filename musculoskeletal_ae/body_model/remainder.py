# SPDX-License-Identifier: Apache-2.0
"""The remainder: the part of the measured lengths that the calibrated body cannot express.

    l_i(θ, T) = body_i(θ, T; w_i) + g_i(θ, T),   g_i ~ GP(0, k_i),   l_i measured with noise σ_i

    k_i = a² (1 + q/(2ν))^−ν
    q = ‖(θ − θ')_c/(b R)‖² + ‖(θ − θ')_u/(e b R)‖² + ‖(T − T')/(c T_limit)‖²

R are the joint ranges, (…)_c has the joints that muscle i crosses, and (…)_u those that it does not
cross. With a large e, g depends only on the joints that a muscle crosses, for example because
tendons wrap round bones. With e near 1, all joints change all lengths, for example because the
links of an elastic body bend together. A small c means that tendons stretch unlike their model.
With a large ν, g is smooth on one scale. With ν near 1, it varies on many scales, for example where
tendons become slack: it may be rough, and yet distant samples still inform it.

The samples decide how far the body is trusted. The amplitude a, the scales b, e and c, the shape ν
and the noise σ are those with the largest evidence, which is the probability of the lengths after
the parameters w of the body have been integrated out over their prior:

    l_i − l_i(θ, T; w̄_i) ~ N(0, J_i S_i² J_iᵀ + k + σ² diag(1/ω_i)),   J_i = ∂l_i/∂w_i

S are the spreads of the prior, and ω the robust weights of whole samples (`_robust_weights`). If
the body explains the lengths, a falls to nearly zero. If it does not, g approaches the true lengths
with more samples.

The errors of g are correlated between muscles: if one slack tendon lets the link move, all other
lengths change. The correlation is computed from the errors of each sample's lengths when they are
predicted from all other samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.body_model.observations import Observations
from musculoskeletal_ae.gauss_newton import FREEDOM, student
from musculoskeletal_ae.robot.robot import Robot

if TYPE_CHECKING:
    from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
    from musculoskeletal_ae.body_model.priors import MusclePrior

#: Express the six constants a [m], b [joint ranges], e, c [T_limit], ν and σ [m] of the covariance
#: in these units. The evidence is a function of the natural logarithms of the six ratios.
UNITS = np.array([0.002, 0.5, 1.0, 1.0, 1.0, 0.001])
#: expect these logarithms (prior means) before there are samples
USUAL = np.array([-1.5, 0.5, 1.0, 2.0, 1.0, -2.0])
#: expect the logarithms to differ from USUAL by these standard deviations; they draw the search for
#: the largest evidence towards USUAL
SPREAD = np.array([2.0, 0.4, 1.0, 1.0, 1.0, 1.5])
#: search each of the six logarithms within these limits
BOUNDS = ((-8.0, 4.0), (-1.5, 3.0), (0.0, 4.0), (-1.5, 4.0), (0.0, 3.5), (-2.5, 3.0))
#: start a search from these logarithms: for a body that explains the lengths, for one that does
#: not, and for a rough remainder
STARTS = (
    USUAL,
    USUAL + [2.5, 0.0, 0.0, 0.0, 0.0, 0.0],
    USUAL + [3.0, -1.0, -1.0, 0.0, 0.0, 1.0],
)
#: Start every search from STARTS if there are fewer samples than this: the evidence then has many
#: maxima, which change with each sample. With more samples, continue from the last result.
FEW_SAMPLES = 60
ROUNDS = 25  # end a search that starts from STARTS after this many iterations
FEW_ROUNDS = 4  # end a search that continues from the last result after this many iterations
JUDGING = 150  # compute the evidence from at most this many samples, to bound the time of a search
LEAST_SAMPLES = 5  # learn a remainder only from at least this many samples
UNKNOWN = 1.0  # give a length that a sample lacks this variance, so that it has no effect [m²]
JITTER = 1e-10  # add this variance to keep covariances positive definite [m²]


class Lengths(NamedTuple):
    """Lengths of the N samples of one group, relative to the prior mean of the body."""

    theta: Array  # joint angles θ [rad], (N, D)
    tension: Array  # tension readings T or T_read [N], (N, M)
    deviation: list[Array]  # measured length minus that of the prior mean body [m], (N,) each
    by_body: list[Array]  # J S: derivatives of lengths by w, times the prior spreads [m], (N, P)
    weight: Array  # robust weights ω of the lengths, (N, M)

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
            tension, direction = observed.tension[:, m], observed.direction[:, m]
            length, jacobian = body.linearised(poses, tension, direction, m, observed.age)
            moved = jacobian @ (body.parameters[m] - prior.mean)
            deviation.append(observed.length[:, m] - length + moved)
            by_body.append(jacobian * prior.spread)
        return cls(observed.theta, observed.tension, deviation, by_body, weight)

    def part(self, rows: Ints) -> Lengths:
        """Return these lengths for the samples with the indices `rows` only."""
        deviation, by_body = ([own[rows] for own in part] for part in self[2:4])
        return Lengths(self.theta[rows], self.tension[rows], deviation, by_body, self.weight[rows])


class LeftOut(NamedTuple):
    """Errors of the lengths of N samples, each predicted from all other samples of a group."""

    rows: Ints  # indices of the samples, ascending, (N,)
    error: Array  # measured minus predicted lengths [m], (N, M)
    variance: Array  # variance of these errors [m²], (N, M)
    weight: Array  # robust weights ω of the samples' lengths, (N, M)


@dataclass(frozen=True, eq=False)
class GroupRemainder:
    """The remainder g of one group of joints and muscles.

    g is the part of the muscle lengths that the parameters of the body cannot express.
    """

    joints: Ints  # indices of the joints
    muscles: Ints  # indices of the muscles
    scale: Array  # units of the inputs: R of the joints, T_limit of the muscles, (D+M,)
    crossed: Bools  # whether each muscle crosses each joint, (M, D)
    logarithms: Array  # natural logarithms of a, b, e, c, ν and σ in units of UNITS, (6,)
    inputs: Array  # θ and T of the samples in units of `scale`, (N, D+M)
    weights: Array  # α, (N, M): g_i = k_i(·, inputs) α_i
    #: lower Cholesky factor of the correlation between the errors of the g_i, (M, M)
    correlation: Array
    #: lower Cholesky factor of k + σ² diag(1/ω) for each row of `crossed` that differs, with the
    #: mean ω of all muscles, (N, N) each
    roots: tuple[Array, ...]

    def at(self, theta: Array, tension: Array) -> Array:
        """Return the remainder of the group's muscles [m], (N, M), at θ and T of the whole body."""
        result = np.empty((len(theta), len(self.muscles)))
        for own, covariance in self._covariances(theta, tension):
            result[:, own] = covariance @ self.weights[:, own]
        return result

    def spread(self, theta: Array, tension: Array) -> Array:
        """Return the posterior uncertainty (σ) of each g_i for a known body [m], (N, M)."""
        result = np.empty((len(theta), len(self.muscles)))
        amplitude = _constants(self.logarithms)[0]
        parts = zip(self._covariances(theta, tension), self.roots, strict=True)
        for (own, covariance), root in parts:
            known = np.square(solve_triangular(root, covariance.T, lower=True)).sum(axis=0)
            result[:, own] = np.sqrt(np.maximum(amplitude**2 - known, 0.0))[:, None]
        return result

    def _covariances(self, theta: Array, tension: Array) -> Iterator[tuple[Ints, Array]]:
        """Yield muscles that cross the same joints, and k between given states and the samples."""
        inputs = np.hstack([theta[:, self.joints], tension[:, self.muscles]]) / self.scale
        for joints, own in _alike(self.crossed):
            yield own, _covariance(inputs, self.inputs, joints, self.logarithms)


@dataclass(frozen=True, eq=False)
class Remainder:
    """The remainder of a whole body: what its parameters cannot express of the muscle lengths.

    `groups` are the parts of groups with enough samples. `before` is a remainder that is added, for
    example that of the network from which learning continues.
    """

    muscle_count: int
    groups: tuple[GroupRemainder, ...] = ()
    before: Remainder | None = None

    def at(self, theta: Array, tension: Array) -> Array:
        """Return the remainder g [m] (N, M) at θ [rad] (N, D) and T [N] (N, M)."""
        result = np.zeros((len(theta), self.muscle_count))
        for group in self.groups:
            result[:, group.muscles] = group.at(theta, tension)
        return result if self.before is None else result + self.before.at(theta, tension)

    def drawn_error(self, theta: Array, tension: Array, rng: np.random.Generator) -> Array:
        """Draw errors of the remainder [m], (N, M), from its posterior, one for each state."""
        result = np.zeros((len(theta), self.muscle_count))
        for group in self.groups:
            spread = group.spread(theta, tension)
            drawn = rng.standard_normal(spread.shape) @ group.correlation.T
            result[:, group.muscles] = spread * drawn
        return result


def learned_remainder(
    body: CalibratedBody, observed: Observations, weight: Array, priors: Sequence[MusclePrior]
) -> tuple[Remainder, tuple[LeftOut, ...]]:
    """Learn the remainder of a fitted body from the samples whose joint angles are all known.

    Args:
        body: The fitted body.
        observed: The samples, with joint angles corrected for the offsets of the joint sensors.
        weight: Robust weights of the lengths, (N, M).
        priors: Prior of each muscle.

    Returns:
        The remainder, and for each of its groups the errors of the lengths of left-out samples.
    """
    present, before = body.remainder, body.remainder.before
    starts = {group.joints.tobytes(): group.logarithms for group in present.groups}
    groups, left_out = list[GroupRemainder](), list[LeftOut]()
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
        learned, errors = group_remainder(body.robot, joints, muscles, rows, of_group, start)
        groups.append(learned)
        left_out.append(errors)
    return Remainder(body.robot.muscle_count, tuple(groups), before), tuple(left_out)


def group_remainder(
    robot: Robot, joints: Ints, muscles: Ints, rows: Ints, lengths: Lengths, start: Array | None
) -> tuple[GroupRemainder, LeftOut]:
    """Learn the remainder of one group from samples; also return errors of left-out samples.

    The robust weights follow from the errors with which the last remainder predicts left-out
    samples. With few samples, or without a last remainder, it is learned twice.

    Args:
        robot: The whole robot.
        joints: Joints of the group.
        muscles: Muscles of the group.
        rows: Indices of the samples.
        lengths: The samples, with the robust weights of the fit.
        start: Logarithms of the six constants (see UNITS) from which the search starts; None to
            start from STARTS.
    """
    ranges = (robot.upper - robot.lower)[joints]
    scale = np.concatenate([ranges, robot.tension.limit[muscles]])
    if not robot.tension_source.is_known:
        scale[len(joints) :] = np.inf  # ignore the tensions
    crossed = robot.routes.crossed[np.ix_(muscles, joints)]
    inputs = np.hstack([lengths.theta, lengths.tension]) / scale

    def evidence(lengths: Lengths) -> _Evidence:
        return _Evidence(lengths.part(judging(len(lengths.theta))), scale, crossed)

    is_few = len(inputs) < FEW_SAMPLES
    if start is None or is_few:
        known = [] if start is None else [start]
        start = likeliest(evidence(lengths), [*known, *STARTS], ROUNDS, BOUNDS)
    starts, rounds = ([start, *STARTS], ROUNDS) if is_few else ([start], FEW_ROUNDS)
    left_out = _solved(lengths, inputs, crossed, start)
    lengths = lengths._replace(weight=_robust_weights(lengths.weight, left_out, start))
    logarithms = likeliest(evidence(lengths), starts, rounds, BOUNDS)
    weights, error, variance = _solved(lengths, inputs, crossed, logarithms)
    correlation = _correlation(np.where(lengths.weight > 0.0, error / np.sqrt(variance), 0.0))
    mean_noise = np.diag(_variances(lengths.weight.mean(axis=1), logarithms))
    roots = tuple(
        cholesky(_covariance(inputs, inputs, of_joints, logarithms) + mean_noise, lower=True)
        for of_joints, _ in _alike(crossed)
    )
    group = GroupRemainder(
        joints, muscles, scale, crossed, logarithms, inputs, weights, correlation, roots
    )
    return group, LeftOut(rows, error, variance, lengths.weight)


def likeliest(
    evidence: Callable[[Array], tuple[float, Array]],
    starts: Sequence[Array],
    rounds: int,
    bounds: Sequence[tuple[float, float]],
) -> Array:
    """Return the logarithms of the hyperparameters with the largest evidence, (6,).

    Args:
        evidence: Returns the negative logarithm of the evidence, and its derivatives, (6,).
        starts: Logarithms at which a search begins, (6,) each.
        rounds: Largest number of iterations of each search.
        bounds: Lowest and highest value of each logarithm.
    """
    found = [
        minimize(
            evidence, each, jac=True, method='L-BFGS-B', bounds=bounds, options={'maxiter': rounds}
        )
        for each in starts
    ]
    logarithms: Array = min(found, key=lambda result: result.fun).x
    return logarithms


def judging(count: int) -> Ints:
    """Return the indices of the samples whose evidence decides on constants, at most JUDGING."""
    return np.linspace(0, count - 1, min(count, JUDGING)).astype(int)


class _Solution(NamedTuple):
    """The solution for given hyperparameters, and its predictions of left-out lengths."""

    weights: Array  # α, (N, M)
    #: error of each length if it is predicted from all other samples [m], (N, M)
    error: Array
    variance: Array  # variance of this error [m²], (N, M)


def _solved(lengths: Lengths, inputs: Array, crossed: Bools, logarithms: Array) -> _Solution:
    count = len(inputs)
    weights, variance = (np.empty((count, len(crossed))) for _ in range(2))
    for of_joints, alike in _alike(crossed):
        kernel = _covariance(inputs, inputs, of_joints, logarithms)
        for m in alike:
            noise = _variances(lengths.weight[:, m], logarithms)
            covariance = kernel + lengths.by_body[m] @ lengths.by_body[m].T + np.diag(noise)
            inverse = cho_solve((cholesky(covariance, lower=True), True), np.eye(count))
            weights[:, m] = inverse @ lengths.deviation[m]
            # The error is α_n/(K⁻¹)_nn, and its variance 1/(K⁻¹)_nn.
            variance[:, m] = 1.0 / np.diag(inverse)
    return _Solution(weights, weights * variance, variance)


def _robust_weights(weight: Array, left_out: _Solution, logarithms: Array) -> Array:
    """Return robust weights ω (N, M) from the errors of left-out samples.

        ω_n = (ν + M_n) / (ν + Σ_m ρ_nm²/v_nm)

    This is the weight of a multivariate Student distribution, because a wrong joint angle changes
    all lengths of a sample. M_n is the number of known lengths, and v the variance of the error ρ
    if the sample had the weight 1. Residuals of g itself would hide a bad sample that g follows.
    Weights of single lengths would let g follow some lengths of a bad sample and reject others. No
    weight exceeds the largest one of a single length.

    Args:
        weight: The weights so far; those of unknown lengths are 0, and stay 0.
        left_out: The predictions of left-out samples with these weights.
        logarithms: Logarithms of the hyperparameters.
    """
    is_known, count = weight > 0.0, (weight > 0.0).sum(axis=1)
    noise = _constants(logarithms)[5] ** 2 + JITTER
    own = np.stack([_variances(each, logarithms) for each in weight.T], axis=1)
    variance = np.maximum(left_out.variance - own + noise, noise)
    squares = np.where(is_known, left_out.error**2 / variance, 0.0).sum(axis=1)
    of_sample = (FREEDOM + count) / (FREEDOM + squares)
    return np.where(is_known, np.minimum(of_sample, student(np.zeros(1)))[:, None], 0.0)


def _correlation(scores: Array) -> Array:
    """Return the lower Cholesky factor of the correlation between the errors of M muscles.

    Few samples cannot distinguish a correlation from chance. Therefore M more samples are added,
    whose errors are not correlated.

    Args:
        scores: Errors in standard deviations, (N, M); 0 where they are unknown.
    """
    product = scores.T @ scores + scores.shape[1] * np.eye(scores.shape[1])
    size = np.sqrt(np.diag(product))
    root: Array = cholesky(product / np.outer(size, size), lower=True)
    return root


class _Evidence:
    """Computes the negative logarithm of the evidence and its derivatives by six logarithms."""

    def __init__(self, lengths: Lengths, scale: Array, crossed: Bools) -> None:
        self._lengths = lengths
        inputs = np.hstack([lengths.theta, lengths.tension]) / scale
        self._alike = [(_parts(inputs, joints), muscles) for joints, muscles in _alike(crossed)]
        self._by_body = [part @ part.T for part in lengths.by_body]

    def __call__(self, logarithms: Array) -> tuple[float, Array]:
        identity = np.eye(len(self._lengths.theta))
        _, by_theta, ratio, by_tension, tail, _ = _constants(logarithms)
        deviation = (logarithms - USUAL) / SPREAD
        value, gradient = 0.5 * float(deviation @ deviation), deviation / SPREAD
        for (crossed, others, tensions), muscles in self._alike:
            distance = crossed / by_theta**2 + others / (ratio * by_theta) ** 2
            distance += tensions / by_tension**2
            kernel = _kernel(distance, logarithms)
            common = np.zeros_like(kernel)
            for m in muscles:
                noise = _variances(self._lengths.weight[:, m], logarithms)
                covariance = self._by_body[m] + kernel + np.diag(noise)
                try:
                    root = cholesky(covariance, lower=True, check_finite=False)
                except LinAlgError:
                    return 1e12, np.zeros(len(logarithms))
                inverse = cho_solve((root, True), identity, check_finite=False)
                weights = inverse @ self._lengths.deviation[m]
                value += 0.5 * float(weights @ self._lengths.deviation[m])
                value += float(np.log(np.diag(root)).sum())
                slope = inverse - np.outer(weights, weights)
                common += slope
                used = self._lengths.weight[:, m] > 0.0
                gradient[5] += float(np.diag(slope)[used] @ noise[used])
            relative = 0.5 * distance / tail
            by_scale = 0.5 * common * kernel / (1.0 + relative)
            of_others = (by_scale * others).sum() / (ratio * by_theta) ** 2
            gradient[0] += (common * kernel).sum()
            gradient[1] += (by_scale * crossed).sum() / by_theta**2 + of_others
            gradient[2] += of_others
            gradient[3] += (by_scale * tensions).sum() / by_tension**2
            by_tail = relative / (1.0 + relative) - np.log1p(relative)
            gradient[4] += 0.5 * tail * (common * kernel * by_tail).sum()
        return value, gradient


def _alike(crossed: Bools) -> Iterator[tuple[Bools, Ints]]:
    """Yield each set of joints (D,) that some muscles cross, and the indices of these muscles."""
    joints, place = np.unique(crossed, axis=0, return_inverse=True)
    for n, own in enumerate(joints):
        yield own, np.flatnonzero(place.ravel() == n)


def _constants(logarithms: Array) -> Array:
    """Return the six constants in their units: a [m], b, e, c, ν and σ [m]."""
    constants: Array = UNITS * np.exp(logarithms)
    return constants


def _parts(inputs: Array, crossed: Bools) -> list[Array]:
    """Return squared distances between inputs, (N, N) each.

    They are those of the crossed joints alone, of the other joints, and of the tensions.
    """
    joints, of_tensions = inputs[:, : len(crossed)], inputs[:, len(crossed) :]
    parts = joints[:, crossed], joints[:, ~crossed], of_tensions
    return [squares(part, part) for part in parts]


def _covariance(one: Array, other: Array, crossed: Bools, logarithms: Array) -> Array:
    """Return the prior covariance k of some muscles' lengths between two sets of inputs, (N, K)."""
    _, by_theta, ratio, by_tension, _, _ = _constants(logarithms)
    scale = np.full(one.shape[1], by_tension)
    scale[: len(crossed)] = by_theta * np.where(crossed, 1.0, ratio)
    return _kernel(squares(one / scale, other / scale), logarithms)


def squares(one: Array, other: Array) -> Array:
    """Return the squared distances between inputs, (N, K)."""
    squares = np.square(one).sum(axis=1)[:, None] + np.square(other).sum(axis=1)
    squares -= 2.0 * one @ other.T
    return np.maximum(squares, 0.0, out=squares)


def _kernel(distance: Array, logarithms: Array) -> Array:
    """Return the kernel k = a² (1 + q/(2ν))^−ν for values of q, in the same shape."""
    constants = _constants(logarithms)
    amplitude, tail = constants[0], constants[4]
    kernel = np.log1p(distance * (0.5 / tail))
    kernel *= -tail
    np.exp(kernel, out=kernel)
    kernel *= amplitude**2
    return kernel


def _variances(weight: Array, logarithms: Array) -> Array:
    """Return the variance of measured lengths with robust weights ω (N,) [m²], (N,)."""
    variances = np.full(len(weight), UNKNOWN)
    used = weight > 0.0
    variances[used] = _constants(logarithms)[5] ** 2 / weight[used] + JITTER
    return variances
