# SPDX-License-Identifier: Apache-2.0
"""The calibrated body: the geometric model with other constants, plus a smooth rest; and its fit.

    l_i(θ, T) = f_i(θ; p + δ) − f_i(0; p + δ) − L_e(f_i, T e^{−μ s}; c e^κ) + o − r a + ψ(θ)ᵀ v

Attachments p are off by millimetres (δ), elastic constants c by some per cent (κ), the length
sensor by its zero (o), wires wrap round bones that the straight lines do not know (ψ, random
Fourier features over the joints that the muscle crosses), and a wire that slides reads a tension
that differs from the one at its elastic unit (μ: friction of the route, s: direction of the last
sliding, +1 wound in, −1 paid out). Wires creep, by r from one sample to the next: a sample after
which a others came says what the length was then. All parameters zero is the geometric model.

The fit to samples is maximum a posteriori and robust, together with the samples' postures
(`postures`), from where the last fit ended. The prior spreads s are physical: how far a hand places
an attachment, how far elastic units of one kind differ. Where postures are known for sure, muscles
are fitted one by one:

    min_w  Σ_n ω_n (l_n − l(θ_n, T_n; w))² / σ² + Σ_k (w_k / s_k)²

The weights ω are those of a Student distribution, so that a sample taken while the arm was touched,
or a glitch, counts little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints, Singles
from musculoskeletal_ae.friction import end_tension
from musculoskeletal_ae.learning.postures import FIRST_NOISE, fit_jointly, student
from musculoskeletal_ae.learning.samples import Observations
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.series_elastic import SeriesElastic

FEATURES = 60  # of the smooth rest that are drawn, per muscle
WIDTH = 0.35  # of the kernel that they approximate, as a share of the joint ranges
#: share of their variance that is left out with the directions that vary least, about half of them
#: (less than 0.1 mm at the prior's spread), and the postures that it is taken over
LEFT_OUT, POSTURES = 1e-3, 500
# More than twice the tension at the elastic unit than at the motor is no friction.
LARGEST_FRICTION = 0.7
LARGEST_LOG = 1.5


class Layout:
    """Where the parameters of one muscle are: δ (three per route point), κ, μ, o, r, v."""

    def __init__(self, points: Ints, features: int) -> None:
        end = 3 * len(points)
        self.points = points  # its route points
        self.attachment = slice(0, end)  # δ [m]
        self.elastic = slice(end, end + 3)  # κ: log of force, rate, wire_stretch over nominal ones
        self.friction, self.offset, self.creep = end + 3, end + 4, end + 5  # μ; o, r [m]
        self.size = end + 6 + features
        self.rest = slice(end + 6, self.size)  # v [m]


class Smooth(NamedTuple):
    """ψ of one muscle: K random Fourier features, in the F directions in which they vary.

    In single precision, in which cosines take a seventh of the time.
    """

    frequency: Singles  # [1/rad or 1/m], (K, D); 0 for joints that the muscle does not cross
    phase: Singles  # (K,)
    basis: Singles  # (K, F)

    @classmethod
    def drawn(cls, robot: Robot, crossed: Bools, theta: Array, rng: np.random.Generator) -> Smooth:
        """Draw those of a muscle which crosses some joints (D,); they vary over θ (N, D)."""
        count = FEATURES if crossed.any() else 0
        frequency = rng.normal(0.0, 1.0, (count, robot.joint_count))
        frequency = frequency * crossed / (WIDTH * (robot.upper - robot.lower))
        phase = rng.uniform(0.0, 2.0 * np.pi, count)
        every = cls(*(part.astype(np.float32) for part in (frequency, phase, np.eye(count))))
        values = every.at(theta)
        power, basis = np.linalg.eigh(values.T @ values)
        kept = basis[:, power.cumsum() > LEFT_OUT * power.sum()]
        return every._replace(basis=kept.astype(np.float32))

    def at(self, theta: Array) -> Array:
        """Return ψ(θ) − ψ(0), shape (N, F)."""
        angles = theta @ self.frequency.T + self.phase
        values = np.cos(angles.astype(self.phase.dtype)) - np.cos(self.phase)
        return (values @ self._scaled).astype(float)

    def slope(self, theta: Array, joints: Ints) -> Singles:
        """Return ∂ψ/∂θ of some joints [1/rad or 1/m], shape (joints, N, F)."""
        angles = theta @ self.frequency.T + self.phase
        values = -np.sin(angles.astype(self.phase.dtype)) * self.frequency.T[joints, None]
        return values @ self._scaled

    @property
    def _scaled(self) -> Singles:
        return math.sqrt(2.0 / max(1, len(self.phase))) * self.basis


class Poses(NamedTuple):
    """Of pinocchio's joints in the root link's frame, and what wrapping adds to straight lines."""

    rotation: Array  # (N, J, 3, 3)
    translation: Array  # [m], (N, J, 3)
    detour: Array  # of the nominal body [m], (N, M)


class CorrectedBody:
    """Lengths of the calibrated body, and how they change with its `parameters`."""

    def __init__(
        self,
        robot: Robot,
        parameters: list[Array] | None = None,
        seed: int = 0,
        smooth: list[Smooth] | None = None,
    ) -> None:
        """Correct `robot` by one vector per muscle (zero); `seed` draws `smooth` if not given."""
        self.robot, routes = robot, robot.routes
        if smooth is None:
            rng = np.random.default_rng([seed, 0xF0])
            theta = robot.random_postures(POSTURES, np.random.default_rng([seed, 0xF1]))
            smooth = [Smooth.drawn(robot, crossed, theta, rng) for crossed in routes.crossed]
        self.smooth, self.layouts = smooth, list[Layout]()
        for m, own in enumerate(smooth):
            segments = np.flatnonzero(routes.muscle == m)
            points = np.append(routes.first[segments], routes.second[segments[-1]])
            self.layouts.append(Layout(points, own.basis.shape[1]))
        self.parameters = parameters or [np.zeros(layout.size) for layout in self.layouts]
        #: where a fit starts: zeros of the joint sensors [rad]; θ (D,) of samples by their lengths,
        #: with a row of `postures.Bent`
        self.zero = np.zeros(robot.joint_count)
        self.found: dict[bytes, tuple[Array, ...]] = {}

    def limb(self, joints: Ints, muscles: Ints) -> CorrectedBody:
        """Return the body of one group, with the parameters of its muscles."""
        of_group = [self.smooth[m] for m in muscles]
        smooth = [own._replace(frequency=own.frequency[:, joints]) for own in of_group]
        parameters = [self.parameters[m] for m in muscles]
        return CorrectedBody(self.robot.limb(joints, muscles), parameters, smooth=smooth)

    def elastic(self, m: int) -> SeriesElastic:
        """Return the constants of one muscle, arrays of shape ()."""
        nominal = self.robot.series_elastic
        log = self.parameters[m][self.layouts[m].elastic]
        force, rate, stretch = np.exp(np.clip(log, -LARGEST_LOG, LARGEST_LOG))
        return SeriesElastic(
            nominal.force[m] * force, nominal.rate[m] * rate, nominal.wire_stretch[m] * stretch
        )

    def frictions(self) -> Array:
        """Return μ of each wire (M,)."""
        return np.array([self.friction(m) for m in range(len(self.layouts))])

    def friction(self, m: int) -> float:
        """Return μ of one muscle."""
        value = self.parameters[m][self.layouts[m].friction]
        return float(np.clip(value, -LARGEST_FRICTION, LARGEST_FRICTION))

    def crept(self, age: Array) -> Array:
        """Return by how much lengths have grown since samples of an age (N,) [m], (N, M)."""
        rates = [p[at.creep] for p, at in zip(self.parameters, self.layouts, strict=True)]
        return age[:, None] * np.array(rates)

    def poses(self, theta: Array) -> Poses:
        """Return the joint poses of θ (N, D) and, in the last place, of θ = 0."""
        theta, robot = np.vstack([theta, np.zeros(theta.shape[1])]), self.robot
        at = robot.kinematics.joint_poses(theta)
        return Poses(at.rotation, at.translation, robot.routes.detours(theta))

    def _world(self, poses: Poses, m: int) -> tuple[Array, Array]:
        """Return the route's points in the root link's frame, and how their links are turned."""
        layout, routes = self.layouts[m], self.robot.routes
        joint = routes.joint[layout.points]
        shift = self.parameters[m][layout.attachment].reshape(-1, 3)
        turn = poses.rotation[:, joint]  # (N, P, 3, 3)
        local = routes.point[layout.points] + shift
        return (turn @ local[:, :, None])[..., 0] + poses.translation[:, joint], turn

    def lengths(self, theta: Array, tension: Array, *direction: Array) -> tuple[Array, ...]:
        """Return l [m] (N, M) at θ [rad] (N, D) and the motors' T [N] (N, M).

        One result for each direction s in [−1, 1], shape (N, M); 0 is the mean of both directions.
        """
        result = tuple(np.empty_like(tension) for _ in direction)
        poses = self.poses(theta)
        for m, layout in enumerate(self.layouts):
            world, _ = self._world(poses, m)
            absolute = np.linalg.norm(world[:, 1:] - world[:, :-1], axis=-1).sum(axis=1)
            absolute += poses.detour[:, m]
            absolute, at_zero = absolute[:-1], absolute[-1]
            fixed = absolute - at_zero + self.parameters[m][layout.offset]
            fixed += self.smooth[m].at(theta) @ self.parameters[m][layout.rest]
            elastic, friction = self.elastic(m), self.friction(m)
            for lengths, s in zip(result, direction, strict=True):
                end = end_tension(friction, tension[:, m], s[:, m])
                lengths[:, m] = fixed - elastic.elongation(absolute, end)
        return result

    def linearised(
        self, poses: Poses, smooth: Array, tension: Array, direction: Array, m: int,
        age: Array | float = 0.0,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return l_i [m] (N,) of one muscle and ∂l_i/∂parameters (N, P).

        Of θ come the `poses` and ψ (N, F), `smooth`; T_i [N] and s_i are the muscle's own, (N,).
        """
        layout, parameters = self.layouts[m], self.parameters[m]
        world, turn = self._world(poses, m)
        line = world[:, 1:] - world[:, :-1]
        norm = np.linalg.norm(line, axis=-1)
        along = line / np.maximum(norm, 1e-9)[..., None]
        pull = np.zeros_like(world)
        pull[:, 1:] += along
        pull[:, :-1] -= along
        by_point = (pull[:, :, None] @ turn).reshape(len(world), -1)
        whole = norm.sum(axis=1) + poses.detour[:, m]
        absolute, at_zero = whole[:-1], whole[-1]
        elastic = self.elastic(m)
        end = np.maximum(end_tension(self.friction(m), tension, direction), 0.0)
        length = absolute - at_zero - elastic.elongation(absolute, end)
        length = length + parameters[layout.offset] + smooth @ parameters[layout.rest]
        length -= age * parameters[layout.creep]
        slope = 1.0 - elastic.length_slope(end)
        jacobian = np.empty((len(smooth), layout.size))
        jacobian[:, layout.attachment] = slope[:, None] * by_point[:-1] - by_point[-1]
        jacobian[:, layout.elastic] = np.stack(
            [
                end / (elastic.force + end) / elastic.rate,
                np.log1p(end / elastic.force) / elastic.rate,
                -elastic.wire_stretch * absolute * end,
            ],
            axis=1,
        )
        jacobian[:, layout.friction] = elastic.compliance(absolute, end) * end * direction
        jacobian[:, layout.offset], jacobian[:, layout.creep] = 1.0, -np.asarray(age)
        jacobian[:, layout.rest] = smooth
        return length, jacobian


# -- the fit --------------------------------------------------------------------------------------

ROUNDS = 6  # of Gauss–Newton per fit
SHARES = (1.0, 0.5, 0.25, 0.125, 0.0625)  # of a Gauss–Newton step, tried until one lowers the cost
LEAST_NOISE = 0.0003  # [m] of a length at rest, beyond what all the rest explains
#: samples from before a muscle changed that are enough to start from what they said
LEAST_ANCHOR = 8


@dataclass(frozen=True)
class Prior:
    """How much a body differs from its geometric model (one standard deviation each)."""

    attachment: float = 0.007  # each coordinate of each route point [m]
    elastic: float = 0.2  # logarithm of each elastic constant
    friction: float = 0.05  # relative tension loss along the route, around its mean
    friction_mean: float = 0.05
    offset: float = 0.001  # zero of the length sensor [m]
    creep: float = 1e-5  # of a wire, from one sample to the next [m]
    smooth: float = 0.002  # the smooth rest [m]

    def spread(self, layout: Layout) -> Array:
        """Return s of every parameter of a muscle."""
        spread = np.empty(layout.size)
        spread[layout.attachment] = self.attachment
        spread[layout.elastic] = self.elastic
        spread[layout.friction] = self.friction
        spread[layout.offset], spread[layout.creep] = self.offset, self.creep
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


class Fit(NamedTuple):
    """What a fit says of the samples."""

    residual: Array  # l − l(θ, T; w) [m], (N, M)
    noise: Array  # σ of each muscle [m], (M,)
    weight: Array  # ω in (0, 1], (N, M); 0 where a sample says nothing about a muscle
    theta: Array  # where the arm was [rad], (N, D)
    root: list[tuple[Ints, Array]]  # muscles of a group, R with (RᵀR)⁻¹ the covariance of theirs


def fit_body(
    body: CorrectedBody,
    seen: Observations,
    prior_mean: list[Array] | None = None,
    guess: Array | None = None,
) -> Fit:
    """Fit the parameters of a body in place, from the present ones, and the samples' postures.

    Angles that were not read are looked for from `guess` [rad] (N, D), or the middle of the range.

    A muscle with samples that say nothing about it any more was changed, unless it was isolated
    when they came: what they said is where its new parameters are looked for. In the place of the
    geometric model come the parameters `prior_mean` where some were learned before, without the
    samples that they came from.
    """
    robot = body.robot
    if guess is None:
        guess = np.tile(0.5 * (robot.lower + robot.upper), (len(seen), 1))
    start = np.where(np.isnan(seen.theta), np.clip(guess, robot.lower, robot.upper), seen.theta)
    means, spreads = [], []
    for m, layout in enumerate(body.layouts):
        known, mean, spread = seen.known[:, m], PRIOR.mean(layout), PRIOR.spread(layout)
        # The zero that is expected to be near 0 is that from before all creep.
        spread[layout.offset] = np.hypot(PRIOR.offset, PRIOR.creep * seen.age.max(initial=0.0))
        if prior_mean is not None:
            mean = prior_mean[m]
        before = ~known & (seen.tension[:, m] > 0.0)  # 0 N: it was isolated then
        if before.sum() >= LEAST_ANCHOR:
            there = replace(seen, theta=start)
            _fit_muscle(body, body.poses(start), there, before, mean, spread, LEAST_NOISE, m)
            mean, spread = body.parameters[m], REOPENED.spread(layout)
        means.append(mean)
        spreads.append(spread)
    return Fit(*fit_jointly(body, seen, start, means, spreads, LEAST_NOISE))


def _fit_muscle(
    body: CorrectedBody,
    poses: Poses,
    seen: Observations,
    used: Bools,
    mean: Array,
    spread: Array,
    least_noise: float,
    m: int,
) -> None:
    precision, known = 1.0 / spread**2, used.astype(float)
    noise, weight = FIRST_NOISE, known

    smooth = body.smooth[m].at(seen.theta)

    def linearised(parameters: Array) -> tuple[Array, Array]:
        body.parameters[m] = parameters
        tension, direction = seen.tension[:, m], seen.direction[:, m]
        length, jacobian = body.linearised(poses, smooth, tension, direction, m, seen.age)
        return seen.length[:, m] - length, jacobian

    def cost() -> float:
        deviation = body.parameters[m] - mean
        return float(weight / noise**2 @ residual**2 + precision @ deviation**2)

    residual, jacobian = linearised(body.parameters[m])
    for _ in range(ROUNDS):
        at = body.parameters[m]
        target = residual + jacobian @ at
        # The robust weights are iterated within one linearisation.
        for _ in range(3):
            weighted = jacobian * (weight / noise**2)[:, None]
            curvature = weighted.T @ jacobian
            normal = curvature + np.diag(precision)
            best = np.linalg.solve(normal, weighted.T @ target + precision * mean)
            determined = np.trace(np.linalg.solve(normal, curvature))
            freedom = max(1.0, float(known.sum() - determined))
            left = target - jacobian @ best
            noise, weight = _noise_and_weight(left, known, noise, freedom, least_noise)

        highest = cost()
        for share in SHARES:
            residual, jacobian = linearised(at + share * (best - at))
            if cost() <= highest:
                break
        else:
            linearised(at)
            return


def _noise_and_weight(
    residual: Array, known: Array, noise: float, freedom: float, least: float
) -> tuple[float, Array]:
    """One step of the EM algorithm for the scale and weights of a Student distribution."""
    weight = known * student(residual / noise)
    variance = (weight @ residual**2 + 4.0 * least**2) / (freedom + 4.0)
    return max(least, float(np.sqrt(variance))), weight


NETWORK_STATES = 400  # that a network is asked for
NETWORK_ERROR = 0.001  # [m] by which its lengths may err


def fit_to_network(body: CorrectedBody, mae: Mae, seed: int = 0) -> None:
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
    seen = Observations(theta, tension, lengths, np.zeros(shape), everything)
    poses = body.poses(theta)
    for m, layout in enumerate(body.layouts):
        mean = PRIOR.mean(layout)
        if mae.touch is not None:  # of friction, lengths say nothing
            mean[layout.friction] = mae.friction[m]
        prior = mean, PRIOR.spread(layout)
        _fit_muscle(body, poses, seen, everything[:, m], *prior, NETWORK_ERROR, m)
