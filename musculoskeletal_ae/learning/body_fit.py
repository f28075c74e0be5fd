# SPDX-License-Identifier: Apache-2.0
"""Fitting the corrected body to samples: maximum a posteriori, muscle by muscle, robustly.

    min_w  Σ_n ω_n (l_n − l(θ_n, T_n; w))² / σ² + Σ_k (w_k / s_k)²

by Gauss–Newton from where the last fit ended. The prior spreads s are physical: how far a hand
places an attachment, how far elastic units of one kind differ. The weights ω are those of a
Student distribution, so that a sample taken while the arm was touched, or a glitch, counts little.

The torque balance at rest, g(θ) + Gᵀ T = 0 (PIMBS), is not fitted: what is learned from the lengths
alone meets it as well as the true body does, which is as well as friction lets anyone
(`bench/torque_residual` measures both).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.learning.body import CorrectedBody, Layout
from musculoskeletal_ae.learning.samples import Observations
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.kinematics import JointPoses

FREEDOM = 4.0  # of the Student distribution
ROUNDS = 6  # of Gauss–Newton per fit
SHORTEST = 0.05  # share of a Gauss–Newton step that is still tried
FIRST_NOISE = 0.002  # [m], before anything is known
#: samples from before a muscle changed that are enough to start from what they said
LEAST_ANCHOR = 8
#: residuals beyond this many σ say that a sample does not fit the body
OUTLIER = 6.0


@dataclass(frozen=True)
class Prior:
    """How much a body differs from its geometric model (one standard deviation each).

    Attributes:
        attachment: Each coordinate of each route point [m].
        elastic: Logarithm of each elastic constant.
        friction: Relative tension loss along the route, around its mean.
        friction_mean: Its mean.
        offset: Zero of the length sensor [m].
        smooth: The smooth rest [m].
        noise: Least standard deviation of a length at rest that the rest does not explain [m].
    """

    attachment: float = 0.007
    elastic: float = 0.2
    friction: float = 0.05
    friction_mean: float = 0.05
    offset: float = 0.001
    smooth: float = 0.002
    noise: float = 0.0003

    def spread(self, layout: Layout) -> Array:
        """Return s of every parameter of a muscle."""
        spread = np.empty(layout.size)
        spread[layout.attachment] = self.attachment
        spread[layout.elastic] = self.elastic
        spread[layout.friction] = self.friction
        spread[layout.offset] = self.offset
        spread[layout.rest] = self.smooth
        return spread

    def mean(self, layout: Layout) -> Array:
        """Return the prior mean of every parameter of a muscle."""
        mean = np.zeros(layout.size)
        mean[layout.friction] = self.friction_mean
        return mean


PRIOR = Prior()
#: of a muscle that was replaced or re-wired, around what it was before
REOPENED = Prior(attachment=0.004, elastic=0.3, offset=0.03, smooth=0.001)


@dataclass(frozen=True)
class Fit:
    """What a fit found out about the samples.

    Attributes:
        residual: l − l(θ, T; w) [m], shape (N, M).
        noise: σ of each muscle [m], shape (M,).
        weight: ω in (0, 1], shape (N, M); 0 where a sample says nothing about a muscle.
    """

    residual: Array
    noise: Array
    weight: Array


def fit_body(
    body: CorrectedBody,
    seen: Observations,
    prior: Prior = PRIOR,
    prior_mean: list[Array] | None = None,
) -> Fit:
    """Fit the parameters of a body in place.

    Args:
        body: Starts from its present parameters.
        seen: The samples.
        prior: What is known without any. A muscle with samples that say nothing about it any more
            was changed: what they said is where its new parameters are looked for.
        prior_mean: Parameters learned before, without the samples that they came from; they take
            the place of the geometric model.
    """
    poses = body.poses(seen.theta)
    parts = []
    for m, layout in enumerate(body.layouts):
        known, mean, spread = seen.known[:, m], prior.mean(layout), prior.spread(layout)
        if prior_mean is not None:
            mean = prior_mean[m]
        if (~known).sum() >= LEAST_ANCHOR:
            _fit_muscle(body, poses, seen, ~known, mean, spread, prior.noise, m)
            mean, spread = body.parameters[m], REOPENED.spread(layout)
        parts.append(_fit_muscle(body, poses, seen, known, mean, spread, prior.noise, m))
    residual, noise, weight = zip(*parts, strict=True)
    return Fit(np.stack(residual, axis=1), np.array(noise), np.stack(weight, axis=1))


def _fit_muscle(
    body: CorrectedBody,
    poses: JointPoses,
    seen: Observations,
    used: Bools,
    mean: Array,
    spread: Array,
    least_noise: float,
    m: int,
) -> tuple[Array, float, Array]:
    precision = 1.0 / spread**2
    known = used.astype(float)
    noise, weight = FIRST_NOISE, known
    data = poses, seen.theta, seen.tension[:, m], seen.direction[:, m]
    length, jacobian = body.linearised(*data, m)
    for _ in range(ROUNDS):
        at = body.parameters[m]
        target = seen.length[:, m] - length + jacobian @ at
        # The robust weights are iterated within one linearisation.
        for _ in range(3):
            weighted = jacobian * (weight / noise**2)[:, None]
            curvature = weighted.T @ jacobian
            normal = curvature + np.diag(precision)
            best = np.linalg.solve(normal, weighted.T @ target + precision * mean)
            determined = np.trace(np.linalg.solve(normal, curvature))
            freedom = max(1.0, float(known.sum() - determined))
            residual = target - jacobian @ best
            noise, weight = _noise_and_weight(residual, known, noise, freedom, least_noise)

        share = 1.0
        before = _cost(seen.length[:, m] - length, weight / noise**2, at - mean, precision)
        while share > SHORTEST:
            body.parameters[m] = at + share * (best - at)
            length, jacobian = body.linearised(*data, m)
            deviation = body.parameters[m] - mean
            residual = seen.length[:, m] - length
            if _cost(residual, weight / noise**2, deviation, precision) <= before:
                break
            share *= 0.5
        else:
            body.parameters[m] = at
            length, jacobian = body.linearised(*data, m)
            break
    residual = seen.length[:, m] - length
    noise, weight = _noise_and_weight(residual, known, noise, max(1.0, known.sum()), least_noise)
    return residual, noise, weight


def _cost(residual: Array, weight: Array, deviation: Array, precision: Array) -> float:
    return float(weight @ residual**2 + precision @ deviation**2)


def _noise_and_weight(
    residual: Array, known: Array, noise: float, freedom: float, least: float
) -> tuple[float, Array]:
    """One step of the EM algorithm for the scale and weights of a Student distribution."""
    weight = known * (FREEDOM + 1.0) / (FREEDOM + (residual / noise) ** 2)
    variance = (weight @ residual**2 + 4.0 * least**2) / (freedom + 4.0)
    return max(least, float(np.sqrt(variance))), weight


NETWORK_STATES = 400  # that a network is asked for
NETWORK_ERROR = 0.001  # [m] by which its lengths may err


def fit_to_network(body: CorrectedBody, mae: Mae, seed: int = 0) -> None:
    """Fit a body in place to the lengths that a learned network restores.

    A checkpoint carries what was learned of an arm, but not the samples (`train --from-bag`,
    another machine, a lost state). The first samples after that then correct the body that the
    network knows instead of replacing it by the geometric model.

    Args:
        body: Becomes the network's.
        mae: Learned on a real arm.
        seed: Draws the states that are asked for.
    """
    robot, rng = body.robot, np.random.default_rng([seed, 0x1B])
    theta = robot.random_postures(NETWORK_STATES, rng)
    shape = NETWORK_STATES, robot.muscle_count
    tension = rng.uniform(robot.tension.bias, robot.tension.limit, shape)
    lengths = mae.lengths(theta, tension)
    everything = np.ones(shape, dtype=bool)
    seen = Observations(theta, tension, lengths, np.zeros(shape), everything)
    fit_body(body, seen, replace(PRIOR, noise=NETWORK_ERROR))
