# SPDX-License-Identifier: Apache-2.0
"""A regression from lengths to joint angles, which knows nothing of the body.

    θ_j(l, T) ~ GP(mean, s_j² k),   k = a²/(1 + d/(2 w²)) + b² p + c² p² + 0.3, and noise σ²

p is the scalar product of two inputs and d their squared distance. Inputs are the lengths l, and
the tensions T times a factor f. They are scaled to mean 0 and standard deviation 1, and p and d are
divided by the number of lengths. θ is therefore a line and a parabola in l, and a rest that may be
rough. The constants a, σ, b, c, w and f are those with the largest evidence. Each joint has its
own, because lengths may determine some joints smoothly and others hardly at all.

The body estimates θ by searching the posture whose lengths are l. This amplifies errors of the
lengths. It fails where lengths do not determine the posture, and where muscles lengthen together
for another reason, as slack tendons let them. The regression learns from the same rest samples how
θ follows from l. Both estimates are weighed by their variances, joint by joint:

    θ_est = θ_body + v_body / (v_body + v_regression(l, T)) (θ_regression(l, T) − θ_body)

v_body is the mean squared error of the body at samples that are left out, and v_regression the
predictive variance. Away from the samples, it counts on a joint to vary by at least
LEAST_ANGLE_SPREAD. If the body explains the lengths, v_body is a hundredth of v_regression, and the
body decides. It also decides far from all samples, because v_regression is large there.

The network learns to estimate θ_est from synthetic samples (`synthetic`). From θ and T, however, it
computes the lengths of the body, which the regression does not change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.body_model.remainder import (
    FEW_SAMPLES,
    LEAST_SAMPLES,
    judging,
    likeliest,
    squares,
)

if TYPE_CHECKING:
    from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
    from musculoskeletal_ae.body_model.observations import Observations
    from musculoskeletal_ae.body_model.postures import FittedBody
    from musculoskeletal_ae.body_model.remainder import LeftOut
    from musculoskeletal_ae.robot.groups import Group
    from musculoskeletal_ae.robot.robot import Robot

#: expect these natural logarithms of a, σ, b, c, w and f before there are samples
USUAL = np.array([0.0, -2.0, 0.0, -1.0, 0.0, -1.0])
#: expect the logarithms to differ from USUAL by these standard deviations
SPREAD = np.array([3.0, 3.0, 3.0, 2.0, 1.5, 1.5])
#: search each of the six logarithms within these limits
BOUNDS = ((-8.0, 4.0), (-8.0, 2.0), (-8.0, 4.0), (-8.0, 4.0), (-4.0, 4.0), (-4.0, 1.0))
#: start a search from these logarithms, for a smooth and for a rough rest
STARTS: tuple[Array, ...] = USUAL, USUAL + [0.0, 0.0, 0.0, 0.0, -1.2, 0.0]
ROUNDS = 40  # end a search that starts from STARTS after this many iterations
FEW_ROUNDS = 4  # end a search that continues from the last result after this many iterations
CONSTANT = 0.3  # expect the mean of θ in all postures to differ from that in the samples by this²
JITTER = 1e-8  # add this variance to keep covariances positive definite
#: leave out inputs and joints that vary less than this in the samples [m, N, rad]
LEAST_SPREAD = 1e-6
#: leave out joints that a smaller share of the samples measures, and muscles whose lengths a
#: smaller share of them contains
MEASURED_SHARE = 0.5
#: away from the samples, expect each joint to vary by at least this standard deviation [rad],
#: because samples of a joint that hardly moved do not show how it moves elsewhere
LEAST_ANGLE_SPREAD = 0.15
#: expect the body's posture within this share of the joint ranges from their middle
USUAL_SHARE = 0.3
DIFFERENCE = 1e-4  # differentiate lengths with this step [rad]
UNKNOWN_SPREAD = 1e3  # assume this standard deviation of a length that a sample lacks [m]


class Pairs(NamedTuple):
    """Squared distances and products of pairs of scaled inputs, (N, K) each."""

    of_lengths: tuple[Array, Array]  # distance and product of the lengths alone
    of_tensions: tuple[Array, Array]  # distance and product of the tensions alone

    @classmethod
    def of(cls, one: Array, other: Array) -> Pairs:
        """Return the pairs of N and K inputs, (N, 2M) and (K, 2M)."""
        parts = zip(np.split(one, 2, axis=1), np.split(other, 2, axis=1), strict=True)
        return cls(*((squares(own, each), own @ each.T) for own, each in parts))

    def scaled(self, logarithms: Array) -> tuple[Array, Array]:
        """Return the distances d and the products p, with tensions scaled by f."""
        factor = np.exp(2.0 * logarithms[5])
        (distance, product), (by_tension, product_of_tensions) = self
        return distance + factor * by_tension, product + factor * product_of_tensions


@dataclass(frozen=True, eq=False)
class PostureRegression:
    """The regression of one group of joints and muscles, and its weight beside the body."""

    joints: Ints  # indices of the D joints that it estimates
    muscles: Ints  # indices of the M muscles
    mean: Array  # mean of l [m] and T [N] in the samples, (2M,)
    #: units of l [m] and T [N] in which p and d are those of the module's docstring with f = 1;
    #: infinite for inputs that do not vary in the samples, (2M,)
    scale: Array
    angle_mean: Array  # mean of θ in the samples [rad], (D,)
    angle_spread: Array  # s, standard deviation of θ in the samples [rad], (D,)
    body_variance: Array  # v_body [rad²], (D,)
    logarithms: Array  # natural logarithms of a, σ, b, c, w and f for each joint, (D, 6)
    inputs: Array  # l and T of the samples, minus `mean` and in units of `scale`, (N, 2M)
    roots: tuple[Array, ...]  # lower Cholesky factor of their covariance for each joint, (N, N)
    weights: Array  # α, (D, N): θ = mean + s k(·, inputs) α

    def combined(self, theta: Array, tension: Array, length: Array) -> Array:
        """Return θ_est of the regression's joints [rad], (N, D).

        Args:
            theta: Posture of the whole robot by the body [rad].
            tension: Tension readings of all muscles [N].
            length: Lengths of all muscles [m].
        """
        inputs = np.hstack([length[:, self.muscles], tension[:, self.muscles]])
        inputs, result = (inputs - self.mean) / self.scale, theta[:, self.joints]
        pairs = Pairs.of(inputs, self.inputs)
        own, tensions = np.split(np.square(inputs), 2, axis=1)
        size, size_of_tensions = own.sum(axis=1), tensions.sum(axis=1)
        least = np.maximum(self.angle_spread, LEAST_ANGLE_SPREAD)
        for d, (logarithms, root) in enumerate(zip(self.logarithms, self.roots, strict=True)):
            across = _kernel(*pairs.scaled(logarithms), logarithms)
            product = size + np.exp(2.0 * logarithms[5]) * size_of_tensions
            prior = _kernel(np.zeros_like(product), product, logarithms)
            known = np.square(solve_triangular(root, across.T, lower=True)).sum(axis=0)
            unknown, noise = np.maximum(prior - known, 0.0), np.exp(2.0 * logarithms[1])
            variance = least[d] ** 2 * unknown + self.angle_spread[d] ** 2 * noise
            share = self.body_variance[d] / (self.body_variance[d] + variance)
            estimate = self.angle_mean[d] + self.angle_spread[d] * (across @ self.weights[d])
            result[:, d] += share * (estimate - result[:, d])
        return result


def learned_regressions(
    body: CalibratedBody, observed: Observations, fit: FittedBody, left_out: Sequence[LeftOut]
) -> tuple[PostureRegression, ...]:
    """Learn the regression of each group from the samples in which its joints were measured.

    Joints that fewer than half of the samples measure, or that do not move in them, are left out,
    and so are muscles that fewer than half of the samples contain.

    Args:
        body: The fitted body, with its remainder.
        observed: The samples, with measured joint angles that the fit has corrected.
        fit: The fit of the body to these samples.
        left_out: Errors of the lengths of left-out samples, for each group with a remainder.
    """
    result = []
    starts = {
        (each.muscles.tobytes(), joint): logarithms
        for each in body.regressions
        for joint, logarithms in zip(each.joints.tolist(), each.logarithms, strict=True)
    }
    for group in body.robot.groups:
        joints, muscles = np.array(group.joints, dtype=int), np.array(group.muscles, dtype=int)
        is_measured = np.isfinite(observed.theta[:, joints])
        is_estimated = is_measured.mean(axis=0) >= MEASURED_SHARE
        is_known = fit.weight[:, muscles] > 0.0
        is_input = is_known.mean(axis=0) >= MEASURED_SHARE
        is_used = is_measured[:, is_estimated].all(axis=1) & is_known[:, is_input].all(axis=1)
        rows = np.flatnonzero(is_used)
        if len(rows) < LEAST_SAMPLES or not is_input.any():
            continue
        is_estimated &= observed.theta[rows][:, joints].std(axis=0) >= LEAST_SPREAD
        if not is_estimated.any():
            continue
        error, weight = _body_errors(body, observed, fit, rows, group, left_out)
        joints, muscles = joints[is_estimated], muscles[is_input]
        weighted = weight[:, None] * np.square(error[:, is_estimated])
        body_variance = weighted.sum(axis=0) / weight.sum()
        own_starts = [starts.get((muscles.tobytes(), joint)) for joint in joints.tolist()]
        used = observed[rows]
        used = replace(used, length=used.length + body.crept(used.age))
        result.append(
            _learned(body.robot, used, joints, muscles, weight, body_variance, own_starts)
        )
    return tuple(result)


def _learned(
    robot: Robot,
    observed: Observations,
    joints: Ints,
    muscles: Ints,
    weight: Array,
    body_variance: Array,
    starts: Sequence[Array | None],
) -> PostureRegression:
    """Learn one regression from samples with robust weights; the search begins at `starts`."""
    theta, tension = observed.theta[:, joints], observed.tension[:, muscles]
    if not robot.tension_source.is_known:
        tension = np.zeros_like(tension)
    inputs = np.hstack([observed.length[:, muscles], tension])
    mean, spread = inputs.mean(axis=0), inputs.std(axis=0)
    spread[spread < LEAST_SPREAD] = np.inf
    scale = spread * np.sqrt(len(muscles))
    angle_mean, angle_spread = theta.mean(axis=0), theta.std(axis=0)
    scaled, targets = (inputs - mean) / scale, (theta - angle_mean) / angle_spread
    pairs, noise, rows = Pairs.of(scaled, scaled), weight.max() / weight, judging(len(scaled))
    judged = scaled[rows]
    judged_pairs = Pairs.of(judged, judged)
    logarithms, roots, weights = list[Array](), list[Array](), list[Array]()
    for start, target in zip(starts, targets.T, strict=True):
        evidence = partial(_evidence, judged_pairs, target[rows], noise[rows])
        if start is None or len(scaled) < FEW_SAMPLES:
            logarithms.append(likeliest(evidence, STARTS, ROUNDS, BOUNDS))
        else:
            logarithms.append(likeliest(evidence, [start], FEW_ROUNDS, BOUNDS))
        roots.append(cholesky(_covariance(pairs, noise, logarithms[-1]), lower=True))
        weights.append(cho_solve((roots[-1], True), target))
    return PostureRegression(
        joints, muscles, mean, scale, angle_mean, angle_spread, body_variance,
        np.array(logarithms), scaled, tuple(roots), np.array(weights),
    )  # fmt: skip


def _kernel(distance: Array, product: Array, logarithms: Array) -> Array:
    """Return k without noise for squared distances d and products p, in the same shape."""
    rough, _, line, parabola, width, _ = np.exp(2.0 * logarithms)
    kernel: Array = rough / (1.0 + (0.5 / width) * distance)
    kernel += (line + parabola * product) * product
    kernel += CONSTANT
    return kernel


def _covariance(pairs: Pairs, noise: Array, logarithms: Array) -> Array:
    """Return the covariance of the samples, (N, N); `noise` has their variances in units of σ²."""
    variance = noise * (np.exp(2.0 * logarithms[1]) + JITTER)
    covariance: Array = _kernel(*pairs.scaled(logarithms), logarithms) + np.diag(variance)
    return covariance


def _evidence(
    pairs: Pairs, targets: Array, noises: Array, logarithms: Array
) -> tuple[float, Array]:
    """Return the negative logarithm of the evidence and its derivatives by six logarithms.

    Args:
        pairs: The pairs of samples.
        targets: What the regression should yield for each sample, (N,).
        noises: Variances of the samples in units of σ², (N,).
        logarithms: Logarithms of the hyperparameters, (6,).
    """
    deviation = (logarithms - USUAL) / SPREAD
    rough, noise, line, parabola, width, factor = np.exp(2.0 * logarithms)
    covariance = _covariance(pairs, noises, logarithms)
    try:
        root = cholesky(covariance, lower=True, check_finite=False)
    except LinAlgError:
        return 1e12, np.zeros(len(logarithms))
    inverse = cho_solve((root, True), np.eye(len(root)), check_finite=False)
    weights = inverse @ targets
    value = 0.5 * float(targets @ weights + deviation @ deviation)
    value += float(np.log(np.diag(root)).sum())
    slope = inverse - np.outer(weights, weights)
    d, p = pairs.scaled(logarithms)
    relative = 1.0 / (1.0 + 0.5 * d / width)
    by_distance = -0.5 * rough / width * np.square(relative)
    by_product = line + 2.0 * parabola * p
    distance_of_tensions, product_of_tensions = pairs.of_tensions
    by_tension = by_distance * distance_of_tensions + by_product * product_of_tensions
    gradient = [
        (slope * rough * relative).sum(),
        noise * (np.diag(slope) @ noises),
        line * (slope * p).sum(),
        parabola * (slope * np.square(p)).sum(),
        -(slope * by_distance * d).sum(),
        factor * (slope * by_tension).sum(),
    ]
    return value, np.array(gradient) + deviation / SPREAD


def _body_errors(
    body: CalibratedBody,
    observed: Observations,
    fit: FittedBody,
    rows: Ints,
    group: Group,
    left_out: Sequence[LeftOut],
) -> tuple[Array, Array]:
    """Return by how much the body misestimates the postures of samples, and the samples' weights.

        e = (Gᵀ Σ⁻¹ G + S⁻²)⁻¹ (Gᵀ Σ⁻¹ ρ + S⁻² (θ̄ − θ))

    ρ are the length errors of left-out samples, if the group has a remainder, else the residuals
    of the fit, and Σ is their covariance. θ̄ is the middle of the joint ranges and S the USUAL_SHARE
    of them. They determine the posture where lengths do not.

    Returns:
        e [rad], (N, D), for the samples in `rows` and the joints of the group, and ω, (N,).
    """
    joints, muscles = np.array(group.joints), np.array(group.muscles)
    theta, tension = fit.theta[rows], observed.tension[rows]
    theta = np.where(np.isfinite(observed.theta[rows]), observed.theta[rows], theta)
    error, weight = fit.residual[np.ix_(rows, muscles)], fit.weight[np.ix_(rows, muscles)]
    spread, correlation = np.tile(fit.noise[muscles], (len(rows), 1)), np.eye(len(muscles))
    for known, own in zip(body.remainder.groups, left_out, strict=True):
        if known.muscles.tolist() != muscles.tolist():
            continue
        correlation = known.correlation @ known.correlation.T
        is_known = np.isin(rows, own.rows)
        place = np.searchsorted(own.rows, rows[is_known])
        error[is_known], weight[is_known] = own.error[place], own.weight[place]
        spread[is_known] = np.sqrt(own.variance[place])
    is_missing = ~(weight > 0.0)
    error[is_missing], spread[is_missing] = 0.0, UNKNOWN_SPREAD
    direction = np.zeros_like(tension)

    def lengths(at: Array) -> Array:
        return body.lengths(at, tension, direction)[0][:, muscles]

    length, steps = lengths(theta), DIFFERENCE * np.eye(theta.shape[1])[joints]
    slope = np.stack([lengths(theta + step) - length for step in steps], axis=2) / DIFFERENCE
    inverse = np.linalg.inv(correlation) / (spread[:, :, None] * spread[:, None, :])
    by_length = slope.swapaxes(1, 2) @ inverse
    low, high = body.robot.lower[joints], body.robot.upper[joints]
    precision = (USUAL_SHARE * (high - low)) ** -2.0
    away = precision * (0.5 * (low + high) - theta[:, joints])
    right = (by_length @ error[:, :, None])[:, :, 0] + away
    curvature = by_length @ slope + np.diag(precision)
    errors: Array = np.linalg.solve(curvature, right[:, :, None])[:, :, 0]
    mean_weight: Array = weight.sum(axis=1) / np.maximum((~is_missing).sum(axis=1), 1)
    return errors, mean_weight
