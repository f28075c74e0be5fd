# SPDX-License-Identifier: Apache-2.0
"""Joint fit of the body and the postures of its samples from all available sensors.

    min  Σ ω (l_nm − l_m(θ_n, T_n; w))²/σ_m² + Σ ω (g(θ_n) + K θ_n − b + Gᵀ T_end)_j²/σ_τ²
         + Σ (θ_nj + z_j − y_nj)²/σ_y² + Σ ‖R_iᵀ(θ_n) ĝ − u_ni‖²/σ_u² + Σ ((w − w̄)/s)²
         + Σ ((z − z̄)/s_z)² + Σ (e/s_e)²

The minimum is over the parameters w of the calibrated body, the postures θ_n, the joint-sensor
offsets z and the corrections e = (α, β) of the joints' springs (`springs`), by robust Gauss–Newton
(`gauss_newton`). y are joint angles that a joint sensor (with offset z) or a camera measured, or
that a user stated. u are directions of gravity in links that carry an IMU. Any of these
measurements may be missing. ω are robust weights, and σ are standard deviations of the residuals.
w̄ and s are prior means and prior spreads (`priors`). z̄ and s_z are derived from the joints' stops
(`sensor_offsets`). `posture_model` explains the other symbols.

The problem can be solved because M > D. N rests give N (M − D) more length equations than there are
angles, and N D torque equations. A joint that muscles push against its stop harder than friction
can hold is assumed to be at the stop. A joint beyond its stop is drawn back to it. Independent
groups of joints and muscles are fitted one after another. Each group uses

    PostureModel    parameters and postures → residuals and their derivatives
    GroupPrior      prior of the parameters, and accuracy of each sensor
    Stops           the joints that are at their stops
    GroupFit        weights, cost and normal equations for the solver
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.body_model.observations import Observations
from musculoskeletal_ae.body_model.posture_model import Bent, PostureModel, Residuals, Unknowns
from musculoskeletal_ae.body_model.priors import GroupPrior, MusclePrior
from musculoskeletal_ae.body_model.sensor_offsets import Stops
from musculoskeletal_ae.gauss_newton import (
    SMALL,
    Eliminated,
    Equations,
    RightSides,
    SolvedStep,
    determined,
    minimise,
    noise_and_weight,
    student,
)

if TYPE_CHECKING:
    from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody

#: expect measured directions of gravity to have this standard deviation [rad], due to noise and
#: mounting of the accelerometer
GRAVITY_NOISE = 0.02
#: assume that lengths have this standard deviation in the first iteration [m]
FIRST_NOISE = 0.002
REST_NOISE = 0.0003  # assume that lengths at rest have at least this standard deviation [m]
#: weigh lengths by at least this standard deviation [m], which covers errors of the body model
LEAST_NOISE = 0.0008
#: Expect errors of the torque balance (σ_τ) of this share of the muscles' absolute torques at a
#: joint. The share is high, because all samples have the same friction and sensor offsets.
TORQUE_NOISE = 0.3
#: recompute the factor for the spreads of the prior (Birge ratio, `GroupFit._posterior`) this many
#: times
SCALINGS = 2
ROUNDS = 12  # end the fit after this many Gauss–Newton iterations
#: End the fit if an iteration lowers the cost by less than this, per measured length. The step is
#: then far shorter than the posterior spread. With ten times this value, the fit mistakes a slipped
#: joint sensor for a changed muscle more often.
LEAST_DECREASE = 3e-4
TYPICAL_STEP = 0.3  # scale the damping of the solver to changes of an angle by this [rad]


class Weights(NamedTuple):
    """Weights of all residuals: robust weights ω, divided by the variances."""

    length: Array  # weights of the lengths [1/m²], (N, M)
    torque: Array  # weights of the torque balances [1/(N·m)²], (N, D)
    angle: Array  # weights of the angles [1/rad²], (N, D); 0 where none was measured
    gravity: Array  # weights of the directions of gravity, (N, 3J); 0 where none was measured


class PosturePoint(NamedTuple):
    """A point of the fit: values of the unknowns, and the residuals at these values."""

    unknowns: Unknowns
    residuals: Residuals


class FittedBody(NamedTuple):
    """Result of the fit of a body, besides its parameters, which are changed in place."""

    #: measured minus computed lengths [m], (N, M), at measured angles, or else at fitted ones
    residual: Array
    noise: Array  # standard deviation σ of each muscle's length [m], (M,)
    #: robust weights ω of the lengths, (N, M); 0 where a sample does not describe a muscle
    weight: Array
    theta: Array  # fitted postures of the samples [rad], (N, D)
    #: for each group, its muscles and R; (RᵀR)⁻¹ is the covariance of w, z and e
    root: list[tuple[Ints, Array]]


class GroupFit:
    """Fits parameters and postures of one group of joints and muscles, as a `gauss_newton.Problem`.

    Attributes:
        noise: Standard deviation σ of each muscle's length [m], (M,).
        weight: Robust weight ω of each length in (0, 1], (N, M); 0 where a sample does not describe
            a muscle.
        usual: Inverse squares of typical steps of θ, (D,), and of (w, z, e), by which the solver
            damps its steps.
    """

    def __init__(
        self,
        model: PostureModel,
        priors: list[MusclePrior],
        is_learned: bool = False,
    ) -> None:
        """Create the fit of one group.

        Args:
            model: Residuals of the group.
            priors: Prior of each muscle.
            is_learned: Whether the prior means were learned; otherwise they describe the geometric
                model.
        """
        self._least_ratio = 1.0 if is_learned else 0.0
        self.model, self.stops = model, Stops(model)
        self.prior = GroupPrior.of(model, priors)
        self._known = model.observed.known.astype(float)
        self.noise = np.full(len(priors), FIRST_NOISE)
        self.weight = self._known
        #: effective number of unknowns that each muscle's lengths determine
        self._determined = np.zeros(len(priors))
        self._weights: Weights
        self._stiffness: Array  # −∂τ/∂θ in the last normal equations [N·m/rad], (N, D, D)
        self.usual = (
            1.0 / np.full(model.body.robot.joint_count, TYPICAL_STEP) ** 2,
            np.concatenate(
                [self.prior.precision, self.prior.zero_precision, self.prior.spring_precision]
            ),
        )

    def run(self, start: Unknowns) -> tuple[Unknowns, Array]:
        """Run the fit from initial values; return the unknowns and the posterior root of (w, z, e).

        The root R is upper triangular, and (RᵀR)⁻¹ is the covariance of w, z and e.
        """
        enough = LEAST_DECREASE * self._known.sum()
        fit = minimise(self, self.point(start), ROUNDS, enough)
        root = self._posterior(fit.point)
        self._widen(fit.point.residuals, root)
        return fit.point.unknowns, root

    def _posterior(self, point: PosturePoint) -> Array:
        """Return the posterior root of (w, z, e) at the solution.

        The spreads of the prior are scaled by the Birge ratio √(χ²/γ). χ² is the square of the
        deviation from the prior mean in units of the spreads, and γ the number of parameters that
        the samples determine. If the samples show that an arm differs from its model more than the
        prior expects, the arm is expected to differ as much in properties that the samples do not
        show, such as offsets of joint sensors. With a learned prior the ratio is at least 1: an arm
        that agrees with a learned prior may still differ in properties that the samples do not
        show.
        """
        prior = self.prior
        # Errors of the body model are common to all samples, so all samples together count as at
        # most `priors.INDEPENDENT_SAMPLES` independent ones.
        self._weights = self._weights._replace(torque=self._weights.torque / prior.unread)
        prior.repeated = prior.repeated * prior.unread
        equations = self.equations(point)
        root = Eliminated(equations, 0.0, SMALL).root
        chi_square = float(prior.precision @ prior.deviation(point.unknowns.parameters) ** 2)
        parameters = np.arange(len(prior.precision))
        scaled = prior.precision
        for _ in range(SCALINGS):
            inverse = solve_triangular(root, np.eye(len(root)))[parameters]
            undetermined = float(scaled @ np.square(inverse).sum(axis=1))
            # Count a fictitious parameter that deviates as expected, so that the ratio is 1 without
            # samples.
            ratio = (chi_square + 1.0) / (max(0.0, len(parameters) - undetermined) + 1.0)
            scaled = prior.precision / max(self._least_ratio, ratio)
            common = equations.common.copy()
            common[parameters, parameters] += scaled - prior.precision
            root = Eliminated(equations._replace(common=common), 0.0, SMALL).root
        return root

    def _widen(self, residuals: Residuals, root: Array) -> None:
        """Widen the length noise of muscles that some samples do not describe.

        Fewer samples determine the parameters of such a muscle. The length error that follows from
        the posterior of these parameters is added to its noise.
        """
        for m in np.flatnonzero((self._known == 0.0).any(axis=0)):
            by_parameters = np.zeros((len(root), len(self._known)))
            by_parameters[self.model.columns[m]] = residuals.by_body[m].T
            scaled = solve_triangular(root, by_parameters, trans='T')
            variance = np.square(scaled).sum(axis=0)
            self.noise[m] = np.hypot(self.noise[m], np.sqrt(variance.mean()))

    def point(self, unknowns: Unknowns) -> PosturePoint:
        """Return the point of the fit with these values of the unknowns."""
        return PosturePoint(unknowns, self.model.residuals(unknowns))

    def weigh(self, point: PosturePoint) -> None:
        """Weigh the residuals at a point: compute length noise and robust weights; find stops."""
        residuals, own = point.residuals, point.unknowns.theta[:, self.model.joints]
        self.noise, self.weight = noise_and_weight(
            residuals.length, self._known, self.noise, self._determined, REST_NOISE
        )
        usual_torque = self.stops.usual_torque(own, residuals.torque, residuals.load)
        is_free = self.stops.are_free(own, residuals.torque / usual_torque)
        sigma = np.maximum(usual_torque, TORQUE_NOISE * residuals.load)
        y = self.prior.angle_precision
        self._weights = Weights(
            self.weight / np.maximum(self.noise, LEAST_NOISE) ** 2,
            is_free * student(residuals.torque / sigma) / sigma**2,
            y * student(residuals.angle * np.sqrt(y)),
            self.model.is_tilt_known / GRAVITY_NOISE**2,
        )

    def _pull(self, unknowns: Unknowns) -> tuple[Array, Array]:
        return self.stops.pull(unknowns.theta[:, self.model.joints], self.prior.repeated)

    def cost(self, point: PosturePoint) -> float:
        """Return the cost of a point with the present weights."""
        unknowns, residuals = point
        weights, prior = self._weights, self.prior
        stop, by_stop = self._pull(unknowns)
        return float(
            (weights.length * residuals.length**2).sum()
            + (weights.torque * residuals.torque**2).sum()
            + (weights.angle * residuals.angle**2).sum()
            + (by_stop * stop**2).sum()
            + (weights.gravity * residuals.gravity**2).sum()
            + prior.precision @ prior.deviation(unknowns.parameters) ** 2
            + prior.zero_precision @ (unknowns.zero - prior.zero) ** 2
            + prior.spring_precision @ self._springs(unknowns) ** 2
        )

    def equations(self, point: PosturePoint) -> Equations:
        """Return the normal equations of a Gauss–Newton step from a point.

        Their unknowns are the postures θ of the samples, and (w, z, e), which all samples share.
        """
        model, weights, residuals = self.model, self._weights, point.residuals
        count, places = model.by_sensor.shape
        size = model.parameter_count
        self._stiffness = stiffness = model.stiffness(point.unknowns)
        a, b, slope = weights.length, weights.torque, residuals.muscle_jacobian
        turned, e = residuals.gravity_by_posture, weights.gravity
        inner = np.einsum('nmi,nm,nmj->nij', slope, a, slope)
        inner += np.einsum('nki,nk,nkj->nij', stiffness, b, stiffness)
        inner += np.einsum('nki,nk,nkj->nij', turned, e, turned)
        _, by_stop = self._pull(point.unknowns)
        diagonal = weights.angle + by_stop + self.stops.least_weight
        inner += diagonal[:, :, None] * np.eye(places)

        by_torque, by_springs = residuals.torque_by_body, residuals.torque_by_springs
        every = size + places + by_springs.shape[2]
        outer, mixed = np.zeros((every, every)), np.zeros((count, places, every))
        for j, acting in enumerate(model.acting):
            weighted = by_torque[:, j, acting] * np.sqrt(b[:, j, None])
            outer[np.ix_(acting, acting)] += weighted.T @ weighted
        mixed[:, :, :size] = stiffness.swapaxes(1, 2) @ (b[:, :, None] * by_torque)
        if by_springs.size:
            own, weighted = slice(size + places, every), b[:, :, None] * by_springs
            outer[own, own] = np.einsum('njp,njq->pq', weighted, by_springs)
            outer[own, own] += np.diag(self.prior.spring_precision)
            outer[:size, own] = np.einsum('njp,njq->pq', by_torque, weighted)
            outer[own, :size] = outer[:size, own].T
            mixed[:, :, own] = stiffness.swapaxes(1, 2) @ weighted
        curvature = []
        for m, (column, by_body) in enumerate(zip(model.columns, residuals.by_body)):
            weighted = by_body * a[:, m, None]
            curvature.append(weighted.T @ by_body)
            outer[column, column] += curvature[-1]
            mixed[:, :, column] += slope[:, m, :, None] * weighted[:, None]
        of_zero = weights.angle * model.by_sensor
        zeros = size + np.arange(places)
        mixed[:, np.arange(places), zeros] = of_zero
        outer[zeros, zeros] = of_zero.sum(axis=0) + self.prior.zero_precision
        outer[np.arange(size), np.arange(size)] += self.prior.precision
        leverage = np.einsum('nmi,nij,nmj->nm', slope, np.linalg.inv(inner), slope) * a
        self._determined = self._by_lengths(curvature) + leverage.sum(axis=0)
        return Equations(inner, mixed, outer)

    def _by_lengths(self, curvature: list[Array]) -> Array:
        """Return the effective number of parameters that each muscle's lengths determine, (M,)."""
        precisions = (self.prior.precision[column] for column in self.model.columns)
        return np.array([determined(c, p) for c, p in zip(curvature, precisions, strict=True)])

    def right_sides(self, point: PosturePoint) -> RightSides:
        """Return the right sides of the normal equations of a Gauss–Newton step from a point."""
        unknowns, residuals = point
        weights, prior = self._weights, self.prior
        length, torque = weights.length * residuals.length, weights.torque * residuals.torque
        stop, by_stop = self._pull(unknowns)
        of_postures = np.einsum('nmi,nm->ni', residuals.muscle_jacobian, length)
        of_postures += np.einsum('nki,nk->ni', self._stiffness, torque)
        tilt = weights.gravity * residuals.gravity
        of_postures += np.einsum('nki,nk->ni', residuals.gravity_by_posture, tilt)
        of_postures += weights.angle * residuals.angle + by_stop * stop
        by_body = [at.T @ weighted for at, weighted in zip(residuals.by_body, length.T)]
        right = np.concatenate(by_body) + prior.precision * prior.deviation(unknowns.parameters)
        right += np.tensordot(torque, residuals.torque_by_body, 2)
        angle = (weights.angle * self.model.by_sensor * residuals.angle).sum(axis=0)
        of_zero = angle + prior.zero_precision * (prior.zero - unknowns.zero)
        of_springs = np.tensordot(torque, residuals.torque_by_springs, 2)
        of_springs -= prior.spring_precision * self._springs(unknowns)
        return RightSides(of_postures, np.concatenate([right, of_zero, of_springs]))

    def _springs(self, unknowns: Unknowns) -> Array:
        """Return the corrections of the group's springs, (2S,): α of all S springs, then β."""
        return unknowns.springs[:, self.model.sprung].ravel()

    def moved(self, point: PosturePoint, step: SolvedStep) -> PosturePoint:
        """Return the point to which a step of the solver leads."""
        theta, zero, parameters, springs = point.unknowns
        joints, size = self.model.joints, self.model.parameter_count
        after_zero, sprung = size + len(joints), self.model.sprung
        theta = theta.copy()
        theta[:, joints] += step.samples
        zero = zero + step.common[size:after_zero]
        if len(sprung):
            springs = springs.copy()
            springs[:, sprung] += step.common[after_zero:].reshape(2, -1)
        steps = (step.common[column] for column in self.model.columns)
        parameters = [own + change for own, change in zip(parameters, steps, strict=True)]
        return self.point(Unknowns(theta, zero, parameters, springs))


def fit_jointly(
    body: CalibratedBody,
    observed: Observations,
    start: Array,
    priors: list[MusclePrior],
    is_learned: bool = False,
) -> FittedBody:
    """Fit the body, the joint-sensor offsets and the postures of the samples.

    Args:
        body: The body, whose parameters, springs and joint-sensor offsets are changed in place.
        observed: The samples.
        start: Initial postures [rad], (N, D).
        priors: Prior of each muscle's parameters.
        is_learned: Whether the prior means were learned; otherwise they describe the geometric
            model.
    """
    own, zero = np.isfinite(observed.theta) & (observed.spread == 0.0), body.zero
    theta, samples = start - own * zero, [length.tobytes() for length in observed.length]
    bent = Bent.unknown(*theta.shape)
    for n, sample in enumerate(samples):
        if sample in body.last_postures:
            theta[n], bent.theta[n], bent.stiffness[n] = body.last_postures[sample]
    # Take the remainder of the last fit at the measured angles, where there are any.
    posture = np.where(np.isnan(observed.theta), theta, observed.theta - own * zero)
    remainder = body.remainder.at(posture, observed.tension)
    of_body = replace(observed, length=observed.length - remainder)
    weight = np.zeros_like(observed.length)
    noise, root = np.empty(observed.length.shape[1]), []
    for group in body.robot.groups:
        joints, muscles = np.array(group.joints), np.array(group.muscles)
        model = PostureModel(body, of_body, joints, muscles, bent)
        fit = GroupFit(model, [priors[m] for m in muscles], is_learned)
        own_parameters = [body.parameters[m] for m in muscles]
        begin = Unknowns(theta, zero[joints], own_parameters, body.springs)
        solution, group_root = fit.run(begin)
        theta, zero[joints], body.springs = solution.theta, solution.zero, solution.springs
        for m, parameters in zip(muscles, solution.parameters):
            body.parameters[m] = parameters
        noise[muscles], weight[:, muscles] = fit.noise, fit.weight
        root.append((muscles, group_root))
    body.last_postures = dict(zip(samples, zip(theta, *bent), strict=True))
    # Use the measured angles where there are any: a slipped joint sensor then shows in the
    # residuals of all muscles of that joint.
    measured = np.where(np.isnan(observed.theta), theta, observed.theta - own * zero)
    (length,) = body.lengths(measured, observed.tension, observed.direction)
    residual = observed.length + body.crept(observed.age) - length
    return FittedBody(residual, noise, weight, theta, root)
