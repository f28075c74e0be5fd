# SPDX-License-Identifier: Apache-2.0
"""A regression from lengths to joint angles, which knows nothing of the body.

    θ_j(l, T) ~ GP(mean, s_j² k),   k = a²/(1 + d/(2 w²)) + b² p + c² p² + 0.3, and noise σ²

p is the scalar product of two inputs and d their squared distance. Inputs are the lengths l, and
the tensions T times a factor f. They are scaled to mean 0 and standard deviation 1, and p and d are
divided by the number of lengths. θ is therefore a line and a parabola in l, and a rest that may be
rough. The constants a, σ, b, c, w and f are those with the largest evidence. All joints of a group
share them.

The body estimates θ by searching the posture whose lengths are l. This amplifies errors of the
lengths. It fails where lengths do not determine the posture, and where muscles lengthen together
for another reason, as slack tendons let them. The regression learns from the same rest samples how
θ follows from l. Both estimates are weighed by their variances, joint by joint:

    θ_est = θ_body + v_body / (v_body + v_regression(l, T)) (θ_regression(l, T) − θ_body)

v_body is the mean squared error of the body at samples that are left out, and v_regression the
predictive variance. If the body explains the lengths, v_body is a hundredth of v_regression, and
the body decides. It also decides far from all samples, because v_regression is large there.

The network learns to estimate θ_est from synthetic samples (`synthetic`). From θ and T, however, it
computes the lengths of the body, which the regression does not change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.body_model.remainder import FEW_SAMPLES, LEAST_SAMPLES, squares

if TYPE_CHECKING:
    from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
    from musculoskeletal_ae.body_model.fit import FittedBody
    from musculoskeletal_ae.learning.samples import Observations
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
LEAST_SPREAD = 1e-6  # leave out inputs that vary less than this in the samples [m, N]
#: leave out joints that a smaller share of the samples measures, and muscles whose lengths a
#: smaller share of them contains
MEASURED_SHARE = 0.5
#: leave out joints that vary less than this in the samples [rad], because such samples do not show
#: which lengths follow from a motion of the joint
LEAST_ANGLE_SPREAD = 0.05
#: expect the body's posture within this share of the joint ranges from their middle
USUAL_SHARE = 0.3
DIFFERENCE = 1e-4  # differentiate lengths with this step [rad]
UNKNOWN_SPREAD = 1e3  # assume this standard deviation of a length that a sample lacks [m]


@dataclass(frozen=True, eq=False)
class PostureRegression:
    """The regression of one group of joints and muscles, and its weight beside the body."""

    joints: Ints  # indices of the D joints that it estimates
    muscles: Ints  # indices of the M muscles
    mean: Array  # mean of l [m] and T [N] in the samples, (2M,)
    #: units of l [m] and T [N] in which p and d are those of the module's docstring; infinite for
    #: inputs that do not vary in the samples, (2M,)
    scale: Array
    angle_mean: Array  # mean of θ in the samples [rad], (D,)
    angle_spread: Array  # s, standard deviation of θ in the samples [rad], (D,)
    body_variance: Array  # v_body [rad²], (D,)
    logarithms: Array  # natural logarithms of a, σ, b, c, w and f, (6,)
    inputs: Array  # l and T of the samples, minus `mean` and in units of `scale`, (N, 2M)
    root: Array  # lower Cholesky factor of their covariance, (N, N)
    weights: Array  # α, (N, D): θ = mean + s k(·, inputs) α

    def combined(self, theta: Array, tension: Array, length: Array) -> Array:
        """Return θ_est of the regression's joints [rad], (N, D).

        Args:
            theta: Posture of the whole robot by the body [rad].
            tension: Tension readings of all muscles [N].
            length: Lengths of all muscles [m].
        """
        inputs = np.hstack([length[:, self.muscles], tension[:, self.muscles]])
        inputs, of_body = (inputs - self.mean) / self.scale, theta[:, self.joints]
        distance = squares(inputs, self.inputs)
        across = _kernel(distance, inputs @ self.inputs.T, self.logarithms)
        size = np.square(inputs).sum(axis=1)
        prior = _kernel(np.zeros_like(size), size, self.logarithms)
        known = np.square(solve_triangular(self.root, across.T, lower=True)).sum(axis=0)
        variance = np.maximum(prior - known, 0.0) + np.exp(2.0 * self.logarithms[1])
        variance = variance[:, None] * self.angle_spread**2
        share = self.body_variance / (self.body_variance + variance)
        estimate = self.angle_mean + self.angle_spread * (across @ self.weights)
        combined: Array = of_body + share * (estimate - of_body)
        return combined


def learned_regressions(
    body: CalibratedBody, observed: Observations, fit: FittedBody
) -> tuple[PostureRegression, ...]:
    """Learn the regression of each group from the samples in which its joints were measured.

    Joints that fewer than half of the samples measure, or that hardly move in them, are left out,
    and so are muscles that fewer than half of the samples contain.

    Args:
        body: The fitted body, with its remainder.
        observed: The samples, with measured joint angles that the fit has corrected.
        fit: The fit of the body to these samples.
    """
    result = []
    starts = {each.muscles.tobytes(): each.logarithms for each in body.regressions}
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
        is_estimated &= observed.theta[rows][:, joints].std(axis=0) >= LEAST_ANGLE_SPREAD
        if not is_estimated.any():
            continue
        error, weight = _body_errors(body, observed, fit, rows, group)
        joints, muscles = joints[is_estimated], muscles[is_input]
        weighted = weight[:, None] * np.square(error[:, is_estimated])
        body_variance = weighted.sum(axis=0) / weight.sum()
        start = starts.get(muscles.tobytes())
        used = observed[rows]
        used = replace(used, length=used.length + body.crept(used.age))
        result.append(_learned(body.robot, used, joints, muscles, weight, body_variance, start))
    return tuple(result)


def _learned(
    robot: Robot,
    observed: Observations,
    joints: Ints,
    muscles: Ints,
    weight: Array,
    body_variance: Array,
    start: Array | None,
) -> PostureRegression:
    """Learn one regression from samples with robust weights; `start` is that of the search."""
    theta, tension = observed.theta[:, joints], observed.tension[:, muscles]
    if not robot.tension_source.is_known:
        tension = np.zeros_like(tension)
    inputs = np.hstack([observed.length[:, muscles], tension])
    mean, spread = inputs.mean(axis=0), inputs.std(axis=0)
    spread[spread < LEAST_SPREAD] = np.inf
    scale = spread * np.sqrt(len(muscles))
    angle_mean, angle_spread = theta.mean(axis=0), theta.std(axis=0)
    scaled, targets = (inputs - mean) / scale, (theta - angle_mean) / angle_spread
    evidence = _Evidence(np.split(scaled, 2, axis=1), targets, weight)
    starts, rounds = STARTS, ROUNDS
    if start is not None and len(scaled) >= FEW_SAMPLES:
        starts, rounds = (start,), FEW_ROUNDS
    found = [
        minimize(
            evidence, each, jac=True, method='L-BFGS-B', bounds=BOUNDS, options={'maxiter': rounds}
        )
        for each in starts
    ]
    logarithms = min(found, key=lambda result: result.fun).x
    root = cholesky(evidence.covariance(logarithms), lower=True)
    factor = np.exp(logarithms[5])
    scale[len(muscles) :] /= factor
    scaled[:, len(muscles) :] *= factor
    return PostureRegression(
        joints, muscles, mean, scale, angle_mean, angle_spread, body_variance, logarithms,
        scaled, root, cho_solve((root, True), targets),
    )  # fmt: skip


def _kernel(distance: Array, product: Array, logarithms: Array) -> Array:
    """Return k without noise for squared distances d and products p, in the same shape."""
    rough, _, line, parabola, width, _ = np.exp(2.0 * logarithms)
    kernel: Array = rough / (1.0 + (0.5 / width) * distance)
    kernel += (line + parabola * product) * product
    kernel += CONSTANT
    return kernel


class _Evidence:
    """Computes the negative logarithm of the evidence and its derivatives by six logarithms."""

    def __init__(self, inputs: Sequence[Array], targets: Array, weight: Array) -> None:
        self._targets = targets
        self._distances = [squares(part, part) for part in inputs]  # of lengths, and of tensions
        self._products = [part @ part.T for part in inputs]
        self._noise = weight.max() / weight  # variances of θ in units of σ²

    def _pairs(self, logarithms: Array) -> tuple[Array, Array]:
        """Return d and p of all pairs of samples, (N, N) each."""
        factor = np.exp(2.0 * logarithms[5])
        (distance, of_tensions), (product, product_of_tensions) = self._distances, self._products
        return distance + factor * of_tensions, product + factor * product_of_tensions

    def covariance(self, logarithms: Array) -> Array:
        """Return the covariance of the samples, (N, N)."""
        noise = self._noise * (np.exp(2.0 * logarithms[1]) + JITTER)
        covariance: Array = _kernel(*self._pairs(logarithms), logarithms) + np.diag(noise)
        return covariance

    def __call__(self, logarithms: Array) -> tuple[float, Array]:
        deviation = (logarithms - USUAL) / SPREAD
        rough, noise, line, parabola, width, factor = np.exp(2.0 * logarithms)
        targets = self._targets
        try:
            root = cholesky(self.covariance(logarithms), lower=True, check_finite=False)
        except LinAlgError:
            return 1e12, np.zeros(len(logarithms))
        inverse = cho_solve((root, True), np.eye(len(root)), check_finite=False)
        weights = inverse @ targets
        value = 0.5 * float((targets * weights).sum() + deviation @ deviation)
        value += targets.shape[1] * float(np.log(np.diag(root)).sum())
        slope = targets.shape[1] * inverse - weights @ weights.T
        d, p = self._pairs(logarithms)
        relative = 1.0 / (1.0 + 0.5 * d / width)
        by_distance = -0.5 * rough / width * np.square(relative)
        by_product = line + 2.0 * parabola * p
        by_tension = by_distance * self._distances[1]
        by_tension += by_product * self._products[1]
        gradient = [
            (slope * rough * relative).sum(),
            noise * (np.diag(slope) @ self._noise),
            line * (slope * p).sum(),
            parabola * (slope * np.square(p)).sum(),
            -(slope * by_distance * d).sum(),
            factor * (slope * by_tension).sum(),
        ]
        return value, np.array(gradient) + deviation / SPREAD


def _body_errors(
    body: CalibratedBody, observed: Observations, fit: FittedBody, rows: Ints, group: Group
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
    if (known := body.remainder.group_of(group.muscles)) is not None:
        correlation = known.correlation @ known.correlation.T
        is_known = np.isin(rows, known.left_out.rows)
        place = np.searchsorted(known.left_out.rows, rows[is_known])
        error[is_known], weight[is_known] = (
            part[place] for part in (known.left_out.error, known.left_out.weight)
        )
        spread[is_known] = np.sqrt(known.left_out.variance[place])
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
