# SPDX-License-Identifier: Apache-2.0
"""The zeros of joint sensors, told by where the joints stop.

A joint that reaches its limit is stopped there, in whatever posture the others are and whatever
pulls: readings of different rests pile up at one value, and hardly any is beyond. Muscles and
gravity hardly tell a sensor's zero z; such a pile tells it to a fraction of a degree:

    p(z | y) ∝ p(z) Π_n p(y_n | z),    p(y | z) = (1 − π) / range + π N(y − z − limit; σ)

over the rests near a limit, y_n; beyond it there is next to nothing but the pile. Sensors are as
often zeroed well as roughly (p(z) is a sharp and a wide normal distribution), and limits may be no
stops: then no reading says anything.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array

# Where a joint slides, [rad] below are times RACK [m].
ZERO, ZEROED = np.deg2rad(2.0), 0.003  # spread of zeros that are set roughly, or well [rad]
STOP = 0.01  # how far stops are from the limits [rad]
ZEROS = np.linspace(-4.0 * ZERO, 4.0 * ZERO, 281)  # that are tried [rad]
PILED = 0.06  # π, the share of rests at a stop
WIDTH, GIVE = 0.004, 0.008  # σ of readings there, and beyond the limit, as stops give way [rad]
BEYOND = 0.01  # density of readings beyond a limit, as a share of what it is within
NO_STOPS = 0.1  # probability that limits are no stops
NEAR = 0.3  # within so much of a limit a reading has to do with it [rad]
#: rests are different if another joint is so much elsewhere, or the reading itself [rad]
ELSEWHERE, SAME = 0.1, 0.01


def sensor_zeros(read: Array, lower: Array, upper: Array, radian: Array) -> tuple[Array, Array]:
    """Return zeros of joint sensors and their standard deviations [rad or m], (D,) each.

    From rests as they were `read` (N, D), NaN where nothing was, limits (D,), and `radian` (D,),
    what counts as a radian of each joint.
    """
    theta, lower, upper = read / radian, lower / radian, upper / radian
    found = [_zero(theta, j, lower[j], upper[j]) for j in range(len(lower))]
    zero, spread = np.reshape(found, (-1, 2)).T
    return zero * radian, np.hypot(spread, STOP) * radian


def _zero(theta: Array, j: int, lower: float, upper: float) -> tuple[float, float]:
    own = _different(theta, j, lower, upper)
    log = np.zeros_like(ZEROS)
    for limit, inwards in ((lower, 1.0), (upper, -1.0)):
        near = own[inwards * (own - limit) < NEAR]
        distance = inwards * (near[:, None] - ZEROS - limit)
        within = distance > 0.0
        even = np.where(within, 1.0, BEYOND) / (upper - lower)
        log += np.log((1.0 - PILED) * even + PILED * _pile(distance)).sum(axis=0)
        log += np.log(upper - lower) * len(near)  # beside a density that is even everywhere
    stops = np.logaddexp(np.log(1.0 - NO_STOPS) + log, np.log(NO_STOPS))
    weight = np.exp(stops - stops.max())
    weight *= _normal(ZEROS, ZERO) + _normal(ZEROS, ZEROED)
    weight /= weight.sum()
    # The median, since what is half known is better left where most sensors are.
    zero = float(np.interp(0.5, np.cumsum(weight) - 0.5 * weight, ZEROS))
    return zero, float(np.sqrt(weight @ (ZEROS - zero) ** 2))


def _different(theta: Array, j: int, lower: float, upper: float) -> Array:
    """Return readings of joint j near its limits, of rests that it moved to.

    Of many in one posture there is one: an arm that is commanded there again is no joint stopped.
    """
    theta = theta[np.isfinite(theta[:, j])]
    theta = theta[np.abs(np.diff(theta[:, j], prepend=np.inf)) > SAME]
    own, others = theta[:, j], np.delete(theta, j, axis=1)
    within, kept = np.minimum(own - lower, upper - own), list[int]()
    for n in np.argsort(within)[: np.count_nonzero(within < NEAR)]:
        alike = np.abs(own[kept] - own[n]) < SAME
        alike &= ~(np.abs(others[kept] - others[n]) > ELSEWHERE).any(axis=1)
        if not alike.any():
            kept.append(int(n))
    readings: Array = own[kept]
    return readings


def _pile(distance: Array) -> Array:
    """Return the density of readings at a stop, by how far within the limit they are [rad]."""
    score = distance / np.where(distance > 0.0, WIDTH, GIVE)
    density: Array = np.exp(-0.5 * score**2) / (np.sqrt(2.0 * np.pi) * 0.5 * (WIDTH + GIVE))
    return density


def _normal(x: Array, sigma: float) -> Array:
    density: Array = np.exp(-0.5 * (x / sigma) ** 2) / sigma
    return density
