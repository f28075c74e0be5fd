# SPDX-License-Identifier: Apache-2.0
"""Fits the calibrated body to samples.

The fit is a robust maximum a posteriori estimate (`gauss_newton`) of the parameters together with
the samples' postures (`postures`). It starts from the last fit. The prior spreads s have physical
causes: attachments are placed by hand with limited accuracy, and elastic elements of one kind
differ. With known postures, each muscle is fitted separately:

    min_w  Σ_n ω_n (l_n − l(θ_n, T_n; w))² / σ² + Σ_k ((w_k − w̄_k) / s_k)²

w are the parameters of the muscle with prior mean w̄, σ is the noise of its lengths, and ω_n are
robust weights of the samples.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody, Poses
from musculoskeletal_ae.body_model.observations import Observations
from musculoskeletal_ae.body_model.posture_regression import learned_regressions
from musculoskeletal_ae.body_model.postures import FIRST_NOISE, REST_NOISE, FittedBody, fit_jointly
from musculoskeletal_ae.body_model.priors import PRIOR, REOPENED, MusclePrior
from musculoskeletal_ae.body_model.remainder import learned_remainder
from musculoskeletal_ae.gauss_newton import (
    Equations,
    RightSides,
    SolvedStep,
    determined,
    minimise,
    noise_and_weight,
)
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.model_errors import attachment_spread

ROUNDS = 30  # end the fit of one muscle after this many Gauss–Newton iterations
#: end the fit of one muscle if an iteration lowers the cost by less than this, per measured length
LEAST_DECREASE = 1e-11
#: derive a new prior for a changed muscle only from at least this many samples before the change
LEAST_BEFORE_CHANGE = 8


def fit_body(
    body: CalibratedBody,
    observed: Observations,
    prior_mean: list[Array] | None = None,
    guess: Array | None = None,
) -> FittedBody:
    """Fit the parameters of a body in place, together with the samples' postures.

    The fit starts from the present parameters. A muscle has been changed, by a repair or a
    replacement, if at least LEAST_BEFORE_CHANGE samples no longer describe it, although it was not
    isolated when they were taken. Such a muscle is first fitted to these earlier samples, and the
    result is the prior mean of its new parameters.

    Args:
        body: The body.
        observed: The samples.
        prior_mean: Prior mean that replaces the geometric model, one vector for each muscle. It
            is used if parameters were learned from samples that no longer exist.
        guess: Initial values for joint angles that were not measured [rad], (N, D); by default the
            middle of each joint's range.
    """
    robot = body.robot
    if guess is None:
        guess = np.tile(0.5 * (robot.lower + robot.upper), (len(observed), 1))
    start = np.where(
        np.isnan(observed.theta), np.clip(guess, robot.lower, robot.upper), observed.theta
    )
    priors, attachments = [], attachment_spread(robot)
    for m, attachment in enumerate(attachments.tolist()):
        prior = _prior(body, observed, m, attachment)
        if prior_mean is not None:
            prior = prior._replace(mean=prior_mean[m])
        priors.append(_reopened(body, replace(observed, theta=start), prior, m, attachment))
    is_learned = prior_mean is not None

    def fitted() -> FittedBody:
        return fit_jointly(body, observed, start, priors, is_learned)

    own = np.isfinite(observed.theta) & (observed.spread == 0.0)

    def corrected(fit: FittedBody) -> Array:
        # Angles from a camera are less accurate than the fitted ones, which combine them with
        # lengths.
        return np.where(own, observed.theta - body.zero, fit.theta)

    def measured(theta: Array) -> Observations:
        return replace(observed, theta=np.where(np.isnan(observed.theta), np.nan, theta))

    fit = fitted()
    theta = corrected(fit)
    before = body.remainder.at(theta, observed.tension)
    body.remainder, left_out = learned_remainder(body, measured(theta), fit.weight, priors)
    # Fit the constants again if the remainder changed; otherwise both would explain the same
    # lengths.
    if np.abs(body.remainder.at(theta, observed.tension) - before).max() > REST_NOISE:
        fit = fitted()
    body.regressions = learned_regressions(body, measured(corrected(fit)), fit, left_out)
    return fit


def _prior(body: CalibratedBody, observed: Observations, m: int, attachment: float) -> MusclePrior:
    """Return the prior of a muscle around the geometric model."""
    layout = body.layouts[m]
    spread = PRIOR.spread(layout, attachment)
    # The prior of the offset describes the tendon before it crept, so widen it by the creep since.
    spread[layout.offset] = np.hypot(PRIOR.offset, PRIOR.creep * observed.age.max(initial=0.0))
    return MusclePrior(PRIOR.mean(layout), spread)


def _reopened(
    body: CalibratedBody, observed: Observations, prior: MusclePrior, m: int, attachment: float
) -> MusclePrior:
    """Return a wide prior for muscle `m` if the muscle was changed, else return `prior`.

    The wide prior lies around the parameters before the change. They are fitted to the samples from
    before the change, and are set in `body`.
    """
    # Exclude tensions of 0 N, which mean that the muscle was isolated.
    before = ~observed.known[:, m] & (observed.tension[:, m] != 0.0)
    if before.sum() < LEAST_BEFORE_CHANGE:
        return prior
    poses = body.poses(observed.theta)
    problem = MuscleFit(body, poses, observed, before, prior, REST_NOISE, m)
    body.parameters[m] = problem.run()
    return MusclePrior(body.parameters[m], REOPENED.spread(body.layouts[m], attachment))


class MusclePoint(NamedTuple):
    """A point of the fit of one muscle: its parameters, with residuals and derivatives."""

    parameters: Array  # w, fitted constants of the muscle, (P,)
    residual: Array  # measured minus computed lengths [m], (N, 1)
    jacobian: Array  # derivatives of the computed lengths by the parameters, (N, P)


class MuscleFit:
    """Fits the parameters of one muscle at known postures, as a `gauss_newton.Problem`."""

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
        """Prepare the fit of muscle `m` to the samples where `used` (N,) is True."""
        self._body, self._m = body, m
        self._poses, self._observed = poses, observed
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
        """Run the fit from the body's present parameters; return the fitted ones."""
        start = self.point(self._body.parameters[self._m])
        enough = LEAST_DECREASE * float(self._known.sum())
        return minimise(self, start, ROUNDS, enough).point.parameters

    def point(self, parameters: Array) -> MusclePoint:
        """Return the point of the fit with these parameters."""
        m, observed = self._m, self._observed
        of_all = list(self._body.parameters)
        of_all[m] = parameters
        length, jacobian = self._body.with_parameters(of_all).linearised(
            self._poses,
            observed.tension[:, m],
            observed.direction[:, m],
            m,
            observed.age,
        )
        return MusclePoint(parameters, (observed.length[:, m] - length)[:, None], jacobian)

    def weigh(self, point: MusclePoint) -> None:
        """Weigh the samples: compute noise and robust weights from the residuals at a point."""
        self._noise, weight = noise_and_weight(
            point.residual, self._known, self._noise, self._determined, self._least_noise
        )
        self._weight = weight / self._noise**2

    def cost(self, point: MusclePoint) -> float:
        """Return the cost of a point with the present weights."""
        deviation = self._mean - point.parameters
        return float((self._weight * point.residual**2).sum() + self._precision @ deviation**2)

    def equations(self, point: MusclePoint) -> Equations:
        """Return the normal equations of a Gauss–Newton step from a point."""
        curvature = (point.jacobian * self._weight).T @ point.jacobian
        self._determined = np.array([determined(curvature, self._precision)])
        return Equations.of_common(curvature + np.diag(self._precision))

    def right_sides(self, point: MusclePoint) -> RightSides:
        """Return the right-hand sides of the normal equations of a Gauss–Newton step."""
        by_samples = point.jacobian.T @ (self._weight * point.residual)[:, 0]
        by_prior = self._precision * (self._mean - point.parameters)
        return RightSides.of_common(by_samples + by_prior)

    def moved(self, point: MusclePoint, step: SolvedStep) -> MusclePoint:
        """Return the point to which a step of the solver leads."""
        return self.point(point.parameters + step.common)


NETWORK_STATES = 400  # fit a body to the lengths of a network at this many random states
NETWORK_ERROR = 0.001  # assume that these lengths have at least this standard deviation [m]
FIXED = 1e-6  # give a parameter that must stay at its prior mean this prior spread


def fit_to_network(
    body: CalibratedBody, mae: Mae, seed: int = 0, *, with_remainder: bool = True
) -> None:
    """Fit a body in place to the muscle lengths of a network that has learned a real arm.

    The samples that the network learned from may be missing (after `train --from-bag`, on another
    machine, or if the state was lost). With this fit as prior, learning continues from the learned
    body instead of the geometric model. An exported model of the learned body is fitted in the same
    way, but without a remainder, which it cannot contain.
    """
    robot, rng = body.robot, np.random.default_rng([seed, 0x1B])
    theta = robot.random_postures(NETWORK_STATES, rng)
    shape = NETWORK_STATES, robot.muscle_count
    tension = rng.uniform(robot.tension.bias, robot.tension.limit, shape)
    everything = np.ones(shape, dtype=bool)
    lengths = mae.lengths(theta, tension)
    read = mae.transmission.reading(tension, np.zeros(shape))
    observed = Observations(theta, read, lengths, np.zeros(shape), everything)
    poses, priors = body.poses(theta), list[MusclePrior]()
    attachments = attachment_spread(robot).tolist()
    for m, (layout, attachment) in enumerate(zip(body.layouts, attachments, strict=True)):
        mean, spread = PRIOR.mean(layout), PRIOR.spread(layout, attachment)
        # The network's lengths contain no information about friction and drive, because its input
        # is T_end. Their prior means are therefore the values that were learned with the network.
        spread[layout.drive] = FIXED
        if mae.touch is not None:
            mean[layout.friction] = mae.friction[m]
            if mae.touch.drive is not None:
                mean[layout.drive] = mae.touch.drive[:, m] / body.drive_units[:, m]
        prior = MusclePrior(mean, spread)
        priors.append(prior)
        problem = MuscleFit(body, poses, observed, everything[:, m], prior, NETWORK_ERROR, m)
        body.parameters[m] = problem.run()
    if not with_remainder:
        return
    body.remainder, _ = learned_remainder(body, observed, everything.astype(float), priors)
    explained = replace(observed, length=lengths - body.remainder.at(theta, read))
    for m, prior in enumerate(priors):
        problem = MuscleFit(body, poses, explained, everything[:, m], prior, NETWORK_ERROR, m)
        body.parameters[m] = problem.run()
