# SPDX-License-Identifier: Apache-2.0
"""The fit of the calibrated body to samples.

It is maximum a posteriori and robust (`gauss_newton`), together with the samples' postures
(`postures`), and starts from where the last fit ended. The prior spreads s are physical: how far a
hand places an attachment, how far elastic elements of one kind differ. Where postures are known for
sure, muscles are fitted one by one:

    min_w  Σ_n ω_n (l_n − l(θ_n, T_n; w))² / σ² + Σ_k ((w_k − w̄_k) / s_k)²
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.gauss_newton import (
    Equations,
    RightSides,
    Step,
    determined,
    minimise,
    noise_and_weight,
)
from musculoskeletal_ae.learning.body import CalibratedBody, Poses
from musculoskeletal_ae.learning.postures import FIRST_NOISE, fit_jointly
from musculoskeletal_ae.learning.priors import PRIOR, REOPENED, MusclePrior
from musculoskeletal_ae.learning.samples import Observations
from musculoskeletal_ae.mae.mae import Mae

ROUNDS = 30  # of Gauss–Newton for one muscle
ENOUGH = 1e-11  # decrease of the cost, in variances for each length, that ends them
LEAST_NOISE = 0.0003  # [m] of a length at rest, beyond what all the rest explains
#: samples from before a muscle changed that are enough to start from what they said
LEAST_ANCHOR = 8


class Fit(NamedTuple):
    """What a fit says of the samples."""

    residual: Array  # l − l(θ, T; w) [m], (N, M)
    noise: Array  # σ of each muscle [m], (M,)
    weight: Array  # ω in (0, 1], (N, M); 0 where a sample says nothing about a muscle
    theta: Array  # where the arm was [rad], (N, D)
    root: list[tuple[Ints, Array]]  # muscles of a group, R with (RᵀR)⁻¹ the covariance of theirs


def fit_body(
    body: CalibratedBody,
    observed: Observations,
    prior_mean: list[Array] | None = None,
    guess: Array | None = None,
) -> Fit:
    """Fit the parameters of a body in place, from the present ones, and the samples' postures.

    Args:
        body: The body.
        observed: The samples.
        prior_mean: Parameters in the place of the geometric model's, if some were learned before
            without the samples that they came from.
        guess: Where angles that were not read are looked for [rad], (N, D); by default the middle
            of the range.

    A muscle was changed if there are samples that say nothing about it any more, unless it was
    isolated when they came. What they said is where its new parameters are looked for.
    """
    robot = body.robot
    if guess is None:
        guess = np.tile(0.5 * (robot.lower + robot.upper), (len(observed), 1))
    start = np.where(
        np.isnan(observed.theta), np.clip(guess, robot.lower, robot.upper), observed.theta
    )
    priors = []
    for m in range(len(body.layouts)):
        prior = _prior(body, observed, m)
        if prior_mean is not None:
            prior = prior._replace(mean=prior_mean[m])
        priors.append(_reopened(body, replace(observed, theta=start), prior, m))
    means, spreads = map(list, zip(*priors, strict=True))
    return Fit(*fit_jointly(body, observed, start, means, spreads, LEAST_NOISE))


def _prior(body: CalibratedBody, observed: Observations, m: int) -> MusclePrior:
    """Return the prior of a muscle round the geometric model."""
    layout = body.layouts[m]
    spread = PRIOR.spread(layout)
    # The offset that is expected to be near 0 is that from before all creep.
    spread[layout.offset] = np.hypot(PRIOR.offset, PRIOR.creep * observed.age.max(initial=0.0))
    return MusclePrior(PRIOR.mean(layout), spread)


def _reopened(body: CalibratedBody, there: Observations, prior: MusclePrior, m: int) -> MusclePrior:
    """Return the prior of a muscle round what it was before it was changed, if it was."""
    before = ~there.known[:, m] & (there.tension[:, m] > 0.0)  # 0 N: it was isolated then
    if before.sum() < LEAST_ANCHOR:
        return prior
    problem = MuscleFit(body, body.poses(there.theta), there, before, prior, LEAST_NOISE, m)
    body.parameters[m] = problem.run()
    return MusclePrior(body.parameters[m], REOPENED.spread(body.layouts[m]))


class MusclePoint(NamedTuple):
    """The parameters of one muscle, with residuals and derivatives."""

    parameters: Array  # w, (P,)
    residual: Array  # l − l(θ, T; w) [m], (N, 1)
    jacobian: Array  # ∂l/∂w, (N, P)


class MuscleFit:
    """The problem of one muscle at known postures, for the solver (`gauss_newton.Problem`)."""

    def __init__(
        self,
        body: CalibratedBody,
        poses: Poses,
        observed: Observations,
        used: Bools,
        prior: MusclePrior,
        least_noise: float,
        m: int,
    ) -> None:
        """Fit muscle `m` of a body to those of the samples (N,) that are used."""
        self._body, self._m = body, m
        self._poses, self._smooth = poses, body.smooth[m].at(observed.theta)
        self._seen = observed
        self._known = used.astype(float)[:, None]
        self._mean = prior.mean
        self._least_noise = least_noise
        self._noise = np.array([FIRST_NOISE])
        self._determined = np.zeros(1)
        self.usual = np.zeros(0), 1.0 / prior.spread**2

    @property
    def _precision(self) -> Array:
        return self.usual[1]

    def run(self) -> Array:
        """Return the parameters that fit, from the present ones of the body."""
        start = self.point(self._body.parameters[self._m])
        enough = ENOUGH * float(self._known.sum())
        return minimise(self, start, ROUNDS, enough).point.parameters

    def point(self, parameters: Array) -> MusclePoint:
        """Return a point with its residuals."""
        m, observed = self._m, self._seen
        of_all = list(self._body.parameters)
        of_all[m] = parameters
        length, jacobian = self._body.with_parameters(of_all).linearised(
            self._poses,
            self._smooth,
            observed.tension[:, m],
            observed.direction[:, m],
            m,
            observed.age,
        )
        return MusclePoint(parameters, (observed.length[:, m] - length)[:, None], jacobian)

    def weigh(self, point: MusclePoint) -> None:
        """Take noise and weights from the residuals at a point."""
        self._noise, weight = noise_and_weight(
            point.residual, self._known, self._noise, self._determined, self._least_noise
        )
        self._weight = weight / self._noise**2

    def cost(self, point: MusclePoint) -> float:
        """Return what is to be minimised, with the weights as they are."""
        deviation = self._mean - point.parameters
        return float((self._weight * point.residual**2).sum() + self._precision @ deviation**2)

    def equations(self, point: MusclePoint) -> Equations:
        """Return the normal equations at a point."""
        curvature = (point.jacobian * self._weight).T @ point.jacobian
        self._determined = np.array([determined(curvature, self._precision)])
        return Equations.of_common(curvature + np.diag(self._precision))

    def right_sides(self, point: MusclePoint) -> RightSides:
        """Return the right sides of the normal equations."""
        pulled = point.jacobian.T @ (self._weight * point.residual)[:, 0]
        return RightSides.of_common(pulled + self._precision * (self._mean - point.parameters))

    def moved(self, point: MusclePoint, step: Step) -> MusclePoint:
        """Return the point after a step."""
        return self.point(point.parameters + step.common)


NETWORK_STATES = 400  # that a network is asked for
NETWORK_ERROR = 0.001  # [m] by which its lengths may err


def fit_to_network(body: CalibratedBody, mae: Mae, seed: int = 0) -> None:
    """Fit a body in place to the lengths that a network restores which has learned a real arm.

    A checkpoint carries what was learned of an arm, but not the samples (`train --from-bag`,
    another machine, a lost state). The first samples after that then correct the body that the
    network knows instead of replacing it by the geometric model.
    """
    robot, rng = body.robot, np.random.default_rng([seed, 0x1B])
    theta = robot.random_postures(NETWORK_STATES, rng)
    shape = NETWORK_STATES, robot.muscle_count
    tension = rng.uniform(robot.tension.bias, robot.tension.limit, shape)
    everything = np.ones(shape, dtype=bool)
    lengths = mae.lengths(theta, tension)
    observed = Observations(theta, tension, lengths, np.zeros(shape), everything)
    poses = body.poses(theta)
    for m, layout in enumerate(body.layouts):
        mean = PRIOR.mean(layout)
        if mae.touch is not None:  # of friction, lengths say nothing
            mean[layout.friction] = mae.friction[m]
        prior = MusclePrior(mean, PRIOR.spread(layout))
        problem = MuscleFit(body, poses, observed, everything[:, m], prior, NETWORK_ERROR, m)
        body.parameters[m] = problem.run()
