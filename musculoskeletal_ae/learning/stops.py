# SPDX-License-Identifier: Apache-2.0
"""The zeros of joint sensors, told by where the joints stop.

A joint that reaches its limit is stopped there, in whatever posture the others are and whatever
pulls: readings of different rests pile up at one value, and hardly any is beyond. Muscles and
gravity hardly tell a sensor's zero z; such a pile tells it to a fraction of a degree. For the rests
y_n of a joint and each of its two limits

    p(y | z, π, σ) = (1 − π) / range + π N(y − z − limit; σ),    next to nothing but the pile beyond
    p(z | y) ∝ p(z) Π_limits Σ_π,σ p(π, σ) Π_n p(y_n | z, π, σ)

with the share π of rests at that stop, often none, and piles as sharp as σ, wider beyond the limit,
where a stop gives way. Sensors are as often zeroed well as roughly (p(z) is a sharp and a wide
normal distribution), and limits may be no stops: then no reading says anything.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools

if TYPE_CHECKING:
    from musculoskeletal_ae.learning.posture_model import PostureModel

# Where a joint slides, [rad] below are times RACK [m].
ZERO, ZEROED = np.deg2rad(2.0), 0.003  # spread of zeros that are set roughly, or well [rad]
STOP = 0.01  # how far stops are from the limits [rad]
ZEROS = np.linspace(-4.0 * ZERO, 4.0 * ZERO, 281)  # that are tried [rad]
NO_STOPS, NOT_REACHED = 0.1, 0.5  # how often limits are no stops, and a stop is never reached
SHARES, WIDTHS = (0.03, 0.1, 0.3), (0.001, 0.002, 0.004)  # π and σ [rad] that are tried else
GIVE = 2.0  # σ beyond the limit, in units of that within
BEYOND = 0.01  # density of readings beyond a limit, as a share of that within
#: from a limit, where a joint that muscles push there is taken to be at its stop [rad], and how
#: many spreads of the torque that is usually left that takes
NEAR_STOP, PUSHED = 0.05, 3.0
SMALL = 1e-6  # weight of every angle, as a share of that of a stop
NEAR = 0.3  # a limit, so that a reading has to do with it [rad]
#: rests are different if another joint is so much elsewhere, or the reading itself [rad]
ELSEWHERE, SAME = 0.1, 0.01


def sensor_zeros(read: Array, lower: Array, upper: Array, radian: Array) -> tuple[Array, Array]:
    """Return zeros of joint sensors and their standard deviations [rad or m], (D,) each.

    From rests as they were `read` (N, D), NaN where nothing was, limits (D,), and `radian` (D,),
    what counts as a radian of each joint.
    """
    theta, lower, upper = (read / radian).T, lower / radian, upper / radian
    apart = np.abs(theta[:, None] - theta[:, :, None])  # (D, N, N)
    elsewhere: Bools = np.logical_or.reduce(apart > ELSEWHERE)
    found = [_zero(*each, elsewhere) for each in zip(theta, lower.tolist(), upper.tolist())]
    zero, spread = np.reshape(found, (-1, 2)).T
    return zero * radian, np.hypot(spread, STOP) * radian


def _zero(own: Array, lower: float, upper: float, elsewhere: Bools) -> tuple[float, float]:
    own = _different(own, elsewhere)
    stops = _at_stop(own - lower, upper - lower) + _at_stop(upper - own, upper - lower)[::-1]
    log = np.logaddexp(np.log(1.0 - NO_STOPS) + stops, np.log(NO_STOPS))
    weight = np.exp(log - log.max()) * (_normal(ZEROS, ZERO) + _normal(ZEROS, ZEROED))
    weight /= weight.sum()
    # The median, since what is half known is better left where most sensors are.
    zero = float(np.interp(0.5, np.cumsum(weight) - 0.5 * weight, ZEROS))
    return zero, float(np.sqrt(weight @ (ZEROS - zero) ** 2))


def _at_stop(within: Array, span: float) -> Array:
    """Return log p(y | z) of ZEROS, by how far within a limit readings are [rad], (N,).

    Beside a density that is even everywhere, as where limits stop nothing; `span` is the joint's
    range [rad].
    """
    single = np.float32  # in which logarithms take a fraction of the time
    distance = (within[within < NEAR, None] - ZEROS).astype(single)
    even, wide = (np.where(distance > 0.0, single(1.0), single(x)) for x in (BEYOND, GIVE))
    ways = [np.log(NOT_REACHED) + np.log(even).sum(axis=0, dtype=float)]
    for width in WIDTHS:
        mean = 0.5 * (1.0 + GIVE) * width
        pile = span / mean * _normal(distance / (width * wide), 1.0)
        for share in SHARES:
            log = np.log((1.0 - share) * even + share * pile).sum(axis=0, dtype=float)
            log += (len(within) - len(distance)) * np.log(1.0 - share)
            ways.append(log + np.log((1.0 - NOT_REACHED) / (len(WIDTHS) * len(SHARES))))
    total: Array = np.logaddexp.reduce(ways)
    return total


def _different(own: Array, elsewhere: Bools) -> Array:
    """Return readings of a joint (N,), of rests that it moved to, one of many in one posture.

    A parked joint, or an arm that is commanded to one posture again, is none that is stopped;
    `elsewhere` says of which two rests the postures differ, (N, N).
    """
    read = np.flatnonzero(np.isfinite(own))
    moved = read[np.abs(np.diff(own[read], prepend=np.inf)) > SAME]
    own = own[moved]
    alike = (np.abs(own[:, None] - own) < SAME) & ~elsewhere[np.ix_(moved, moved)]
    kept = np.ones(len(own), dtype=bool)
    for n in np.flatnonzero(np.tril(alike, -1).any(axis=1)):
        kept[n] = not (alike[n, :n] & kept[:n]).any()
    return own[kept]


def _normal(x: Array, sigma: float) -> Array:
    density: Array = np.exp(-0.5 * (x / sigma) ** 2) / (math.sqrt(2.0 * math.pi) * sigma)
    return density


class Stops:
    """Which joints of a group lean on their stops, and what draws joints back that passed one."""

    def __init__(self, model: PostureModel) -> None:
        """Start with no joint at a stop."""
        robot, observed = model.body.robot, model.observed
        self._lower, self._upper = robot.lower, robot.upper
        self._radian = robot.kinematics.radian
        self._by_sensor = model.by_sensor
        self._near = self._radian * np.where(model.by_sensor, 2.0 * ZERO, NEAR_STOP)
        # The torque of a muscle that was changed since is not that of the one there is.
        changed = ~observed.known & (observed.tension > 0.0)  # 0 N: isolated
        #: whose balance of torques says something, (N, D)
        self.is_balanced = ~(changed @ robot.routes.crossed)
        self._at = np.full(model.by_sensor.shape, np.nan)  # the stops that joints lean on [rad]

    def lean(self, own: Array, score: Array) -> Bools:
        """Find the joints at their stops; return those whose balance says something, (N, D).

        Args:
            own: θ [rad], (N, D).
            score: The torque that is left at each joint, in units of what is usually left, (N, D).
                It pushes the joint; at a stop it is the stop's own.
        """
        # A joint that a sensor reads leans on its stop until it would have to be held there.
        # Another joint would be held by a stop that it was taken to once, and all others would be
        # bent after it.
        enough = np.where(self._by_sensor & np.isfinite(self._at), 0.0, PUSHED)
        above = self.is_balanced & (own > self._upper - self._near) & (score > enough)
        below = self.is_balanced & (own < self._lower + self._near) & (score < -enough)
        self._at = np.where(above, self._upper, np.where(below, self._lower, np.nan))
        return self.is_balanced & ~(above | below)

    def pull(self, own: Array, repeated: Array) -> tuple[Array, Array]:
        """Return how far joints are from the stops they lean on or passed [rad], and weights."""
        goal = np.where(np.isnan(self._at), np.clip(own, self._lower, self._upper), self._at)
        is_pulled = ~np.isnan(self._at) | (goal != own)
        return goal - own, is_pulled / (STOP * self._radian) ** 2 / repeated

    @property
    def least_weight(self) -> Array:
        """A weight of every angle that keeps the equations regular, (D,)."""
        weight: Array = SMALL / (STOP * self._radian) ** 2
        return weight
