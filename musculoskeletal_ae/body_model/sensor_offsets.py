# SPDX-License-Identifier: Apache-2.0
"""Estimates joint-sensor offsets from the joints' mechanical stops.

A joint that reaches its limit is stopped there, in any posture of the other joints and under any
load. Readings of different rests then cluster at one value, and hardly any lie beyond it. Muscles
and gravity hardly determine the offset z of a joint sensor, but such a cluster determines it to a
fraction of a degree. For the readings y_n of a joint at rest and each of its two limits

    p(y | z, π, σ) = (1 − π) / range + π N(y − z − limit; σ)
    p(z | y) ∝ p(z) Π_limits Σ_π,σ p(π, σ) Π_n p(y_n | z, π, σ)

Here π is the share of rests at that stop, which is often 0, σ is the width of the cluster, and N is
the normal density. Beyond the limit, the first term is nearly 0 and the cluster is wider, because
stops are compliant. A sensor is calibrated accurately or roughly with equal probability, so the
prior p(z) is the sum of a narrow and a wide normal density. A limit may also not be a mechanical
stop, in which case the readings near it do not determine z.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools

if TYPE_CHECKING:
    from musculoskeletal_ae.body_model.posture_model import PostureModel

#: expect roughly calibrated joint sensors to have offsets of this standard deviation [rad]
ROUGH_OFFSET = np.deg2rad(2.0)
#: expect accurately calibrated joint sensors to have offsets of this standard deviation [rad]
ACCURATE_OFFSET = 0.003
#: refuse an update that estimates a larger offset of a joint sensor than this [rad]: ten standard
#: deviations of a roughly calibrated sensor
LARGEST_OFFSET = 10.0 * ROUGH_OFFSET
STOP_SPREAD = 0.01  # expect a stop to be this far from its joint limit (standard deviation) [rad]
#: consider these offsets z of a joint sensor, and compute the probability of each [rad]
OFFSETS = np.linspace(-4.0 * ROUGH_OFFSET, 4.0 * ROUGH_OFFSET, 281)
NO_STOPS = 0.1  # assume that a joint's limits are no mechanical stops with this probability
NOT_REACHED = 0.5  # assume that the arm never reaches a given stop with this probability
SHARES = 0.03, 0.1, 0.3  # consider that this share π of all rests is at a stop that is reached
#: consider that the readings at a stop scatter with these standard deviations σ [rad]
WIDTHS = 0.001, 0.002, 0.004
#: beyond a limit, let a cluster of readings at a stop be wider by this factor, because stops are
#: compliant
WIDTH_RATIO = 2.0
#: beyond a limit, expect this density of other readings, relative to that within the range
DENSITY_RATIO = 0.01
# A joint is at its stop if it is near a limit and the muscles push it there.
#: assume that a joint without a sensor may be at its stop within this distance from a limit [rad]
NEAR_STOP = 0.05
#: conclude that muscles push a joint against its stop if the unbalanced torque exceeds the usual
#: one by this factor
LEAST_PUSH = 3.0
#: assume that the usual unbalanced torque at a joint is at least this share of the muscles' summed
#: absolute torques
LEAST_TORQUE = 0.01
#: Assume that it is this share if the joint is near a limit in every sample. It could be at a stop
#: in all of them, so the samples do not show the usual torque.
UNKNOWN_TORQUE = 0.05
#: If the range of a joint is at most this multiple of the distance that counts as near, the joint
#: is near a limit nearly everywhere. Samples near a limit then count like all others.
NARROW = 4.0
#: give every angle this weight relative to that of a stop, so that the normal equations have a
#: unique solution
SMALL = 1e-6
NEAR_LIMIT = 0.3  # use no readings that are farther than this from a limit [rad]
# Two rests are distinct if another joint or the reading itself differs.
#: use another reading of a joint only if another joint has moved by more than this [rad], or if
#: this joint has moved by more than OWN_DIFFERENCE
OTHER_DIFFERENCE = 0.1
OWN_DIFFERENCE = 0.01  # see OTHER_DIFFERENCE [rad]


def sensor_zeros(read: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Estimate the zeros (offsets) of joint sensors from readings that pile up at joint limits.

    Args:
        read: Sensor readings at rest [rad], (N, D); NaN where nothing was measured.
        lower: Lower joint limits [rad], (D,).
        upper: Upper joint limits [rad], (D,).

    Returns:
        The offsets and their standard deviations [rad], (D,) each.
    """
    theta = read.T
    apart = np.abs(theta[:, None] - theta[:, :, None])  # (D, N, N)
    elsewhere: Bools = np.logical_or.reduce(apart > OTHER_DIFFERENCE)
    estimates = [_zero(*each, elsewhere) for each in zip(theta, lower.tolist(), upper.tolist())]
    zero, spread = np.reshape(estimates, (-1, 2)).T
    return zero, np.hypot(spread, STOP_SPREAD)


def _zero(own: Array, lower: float, upper: float, elsewhere: Bools) -> tuple[float, float]:
    own = _different(own, elsewhere)
    stops = _at_stop(own - lower, upper - lower) + _at_stop(upper - own, upper - lower)[::-1]
    log = np.logaddexp(np.log(1.0 - NO_STOPS) + stops, np.log(NO_STOPS))
    prior = _normal(OFFSETS, ROUGH_OFFSET) + _normal(OFFSETS, ACCURATE_OFFSET)
    weight = np.exp(log - log.max()) * prior
    weight /= weight.sum()
    # Use the median: with little evidence it stays near 0, where most offsets are.
    zero = float(np.interp(0.5, np.cumsum(weight) - 0.5 * weight, OFFSETS))
    return zero, float(np.sqrt(weight @ (OFFSETS - zero) ** 2))


def _at_stop(within: Array, span: float) -> Array:
    """Return the log likelihood of a joint's readings y near one limit, for each offset in OFFSETS.

    The likelihood is relative to that of readings which are uniform over the joint's range.

    Args:
        within: Distances of the readings from the limit, positive within the range [rad], (N,).
        span: The joint's range [rad].
    """
    single = np.float32  # computes the logarithms several times faster than double precision
    distance = (within[within < NEAR_LIMIT, None] - OFFSETS).astype(single)
    even = np.where(distance > 0.0, single(1.0), single(DENSITY_RATIO))
    wide = np.where(distance > 0.0, single(1.0), single(WIDTH_RATIO))
    logs = [np.log(NOT_REACHED) + np.log(even).sum(axis=0, dtype=float)]
    for width in WIDTHS:
        mean = 0.5 * (1.0 + WIDTH_RATIO) * width
        pile = span / mean * _normal(distance / (width * wide), 1.0)
        for share in SHARES:
            log = np.log((1.0 - share) * even + share * pile).sum(axis=0, dtype=float)
            log += (len(within) - len(distance)) * np.log(1.0 - share)
            logs.append(log + np.log((1.0 - NOT_REACHED) / (len(WIDTHS) * len(SHARES))))
    total: Array = np.logaddexp.reduce(logs)
    return total


def _different(own: Array, elsewhere: Bools) -> Array:
    """Return those readings of a joint that were taken at distinct rests.

    Repeated readings of a parked joint, or of an arm that returns to the same posture, would
    otherwise look like a cluster at a stop.

    Args:
        own: Readings of the joint, (N,).
        elsewhere: Whether the postures of two rests differ, (N, N).
    """
    read = np.flatnonzero(np.isfinite(own))
    moved = read[np.abs(np.diff(own[read], prepend=np.inf)) > OWN_DIFFERENCE]
    own = own[moved]
    alike = (np.abs(own[:, None] - own) < OWN_DIFFERENCE) & ~elsewhere[np.ix_(moved, moved)]
    kept = np.ones(len(own), dtype=bool)
    for n in np.flatnonzero(np.tril(alike, -1).any(axis=1)):
        kept[n] = not (alike[n, :n] & kept[:n]).any()
    return own[kept]


def _normal(x: Array, sigma: float) -> Array:
    density: Array = np.exp(-0.5 * (x / sigma) ** 2) / (math.sqrt(2.0 * math.pi) * sigma)
    return density


class Stops:
    """Detects joints at their mechanical stops, and computes their displacements back to the stops.

    These displacements keep the postures that a fit estimates within the joints' ranges.
    """

    def __init__(self, model: PostureModel) -> None:
        """Start with no joint at a stop."""
        robot, observed = model.body.robot, model.observed
        self._lower, self._upper = robot.lower, robot.upper
        self._by_sensor = model.by_sensor
        self._near = np.where(model.by_sensor, 2.0 * ROUGH_OFFSET, NEAR_STOP)
        # Samples from before the change of a muscle give no torque balance, because the earlier
        # torque of the muscle cannot be computed from its new parameters. A tension of 0 N,
        # however, means that the muscle was only isolated.
        changed = ~observed.known & (observed.tension != 0.0)
        #: joints whose torque balance is informative, (N, D)
        self.is_balanced = ~(changed @ robot.routes.crossed)
        if not robot.tension_source.is_known:
            self.is_balanced[:] = False
        #: limit [rad] at whose stop each joint is, NaN for joints that are not at a stop, (N, D)
        self._at = np.full(model.by_sensor.shape, np.nan)

    def usual_torque(self, own: Array, torque: Array, load: Array) -> Array:
        """Return the usual unbalanced torque at each joint [N·m], (D,).

        Near a limit, a stop may exert the torque that is missing, and the median over all samples
        would call its torque usual if most samples are there. In this case, they are left out.

        Args:
            own: Joint angles θ of the group [rad], (N, D).
            torque: Unbalanced torques [N·m], (N, D).
            load: Usual sum of the muscles' absolute torques at each joint [N·m], (D,).
        """
        near = np.logical_or(*self._near_limits(own))
        is_wide = self._upper - self._lower > NARROW * self._near
        is_mostly_near = is_wide & (near.mean(axis=0) > 0.5)
        usable = np.ma.array(np.abs(torque), mask=near & is_mostly_near)
        usual = 1.5 * np.ma.median(usable, axis=0)
        return np.maximum(usual.filled(UNKNOWN_TORQUE * load), LEAST_TORQUE * load + SMALL)

    def are_free(self, own: Array, score: Array) -> Bools:
        """Return which joints are free of their stops, so that their torques must balance.

        Args:
            own: Joint angles θ of the group [rad], (N, D).
            score: Residual torque at each joint relative to its usual size, (N, D). A positive
                torque pushes the joint towards its upper limit.

        Returns:
            A mask (N, D). It is false for a joint at its stop, which exerts an unknown torque.
        """
        # A joint with a sensor stays at its stop until the torque pulls it away. The score of a
        # joint without a sensor has to exceed LEAST_PUSH at every call. Otherwise a stop that was
        # assumed wrongly would hold the joint and distort the other joints.
        enough = np.where(self._by_sensor & np.isfinite(self._at), 0.0, LEAST_PUSH)
        near_lower, near_upper = self._near_limits(own)
        above = self.is_balanced & near_upper & (score > enough)
        below = self.is_balanced & near_lower & (score < -enough)
        self._at = np.where(above, self._upper, np.where(below, self._lower, np.nan))
        return self.is_balanced & ~(above | below)

    def _near_limits(self, own: Array) -> tuple[Bools, Bools]:
        return own < self._lower + self._near, own > self._upper - self._near

    def pull(self, own: Array, repeated: Array) -> tuple[Array, Array]:
        """Return the displacements [rad] that move joints back to their stops, and their weights.

        Both have the shape (N, D). They are 0 for all joints that are neither at a stop nor beyond
        a joint limit.

        Args:
            own: Joint angles θ of the group [rad], (N, D).
            repeated: Number of readings of each joint's sensor that together have the weight of a
                single independent one, (D,).
        """
        goal = np.where(np.isnan(self._at), np.clip(own, self._lower, self._upper), self._at)
        is_pulled = ~np.isnan(self._at) | (goal != own)
        return goal - own, is_pulled / STOP_SPREAD**2 / repeated

    @property
    def least_weight(self) -> Array:
        """A small weight for each joint angle, which keeps the normal equations regular, (D,)."""
        return np.full(len(self._lower), SMALL / STOP_SPREAD**2)
