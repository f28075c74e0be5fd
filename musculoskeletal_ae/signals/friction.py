# SPDX-License-Identifier: Apache-2.0
"""Tendon friction by Dahl's model: motor-side tension depends on the last sliding direction.

    T = T_end e^{μ s},   s ← w + (s − w) e^{−|Δl|/b},   w = −sign Δl

T is the motor-side tension and T_end the bone-side tension. The tendon friction μ is the exponent
of the capstan equation: coefficient of friction × wrapping angle. s is 1 after winding in, when T
is higher than T_end, and −1 after paying out. When a tendon slides by Δl, s approaches the
direction w over the distance b (REVERSAL), so that friction reverses gradually. The network models
the body without friction, so its tension is T_end. `Transmission` converts measured values of T to
T_end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musculoskeletal_ae.arrays import Array

REVERSAL = 0.0004  # b: let friction reverse over this sliding distance [m]
#: expect this noise of a length [m]; a mean deviation ē of this size (`FrictionDirection`) is as
#: likely due to sliding as due to noise
NOISE = 0.00013
LATEST = 0.07  # give the newest deviation this weight a in the running mean ē (`FrictionDirection`)
SPIKE = 0.0002  # clip a length to the range of the last two, extended by this on both sides [m]
#: limit the learned scale error |γ| of a motor current (`Transmission`) to this
LARGEST_GAIN = 1.5
#: before anything is learned, expect that scale error γ, offset b/T_limit and friction F/T_limit of
#: a motor current (`Transmission`) have these standard deviations; the means of γ and b are 0
DRIVE_SPREAD = 0.2, 0.05, 0.1
#: before anything is learned, expect this mean of the friction ratio F/T_limit
DRIVE_FRICTION_MEAN = 0.08


def slid(direction: Array, way: Array, moved: Array) -> Array:
    """Return the sliding directions s, (..., M), after tendons have slid.

    Args:
        direction: s before the sliding, (..., M).
        way: Direction of sliding, (..., M): 1 when winding in, −1 when paying out.
        moved: Sliding distance [m], (..., M).
    """
    after: Array = way + (direction - way) * np.exp(np.abs(moved) * (-1.0 / REVERSAL))
    return after


@dataclass(frozen=True, eq=False)
class Transmission:
    """Conversion between the reading of a muscle module and the bone-side tension.

        T = max(0, e^γ T_read − b − F s),   T_end = T e^{−μ s}

    T is the motor-side tension and T_end the bone-side tension. s is the direction in which the
    tendon slid last: 1 after winding in, −1 after paying out.

    A tension sensor reads T itself. A motor current, converted to T_read [N] by
    `robot.tension_source`, has a scale error γ and an offset b. Part of the current overcomes the
    friction F of motor and gear, which opposes the motion. The converted current can be negative,
    but T cannot, because a tendon does not push.

    γ, b and F are uncertain. While the friction reverses (|s| < 1), its direction is uncertain as
    well. The standard deviation σ_T of T follows from both:

        σ_T² = aᵀ C a + F² (1 − s²),   a = (e^γ T_read, −1, −s)

    Attributes:
        friction: Tendon friction μ, (M,).
        drive: γ, b [N] and F [N] of motor currents, (3, M); None for tension sensors.
        drive_covariance: Covariances C of γ, b and F, (M, 3, 3); None for tension sensors.
    """

    friction: Array
    drive: Array | None = None
    drive_covariance: Array | None = None

    @classmethod
    def unknown(cls, limit: Array) -> Transmission:
        """Return the transmission of motor currents before anything is learned.

        The conversion uses a friction F of 0, although a larger value is expected. This expected
        value is therefore part of the uncertainty of F.

        Args:
            limit: T_limit [N], (M,).
        """
        nothing = np.zeros_like(limit)
        spread = np.array([np.ones_like(limit), limit, limit]).T * DRIVE_SPREAD  # (M, 3)
        spread[:, 2] = np.hypot(spread[:, 2], DRIVE_FRICTION_MEAN * limit)
        return cls(nothing, np.zeros((3, len(limit))), np.eye(3) * np.square(spread)[:, None])

    def motor(self, read: Array, direction: Array) -> Array:
        """Return the motor-side tensions T [N], (..., M).

        Args:
            read: Readings T_read [N], (..., M).
            direction: Last sliding directions s: 1 for winding in, −1 for paying out, (..., M).
        """
        if self.drive is None:
            return read
        gain, offset, friction = self.drive
        tension: Array = np.exp(gain) * read - offset - friction * direction
        return np.maximum(tension, 0.0)

    def spread(self, read: Array, direction: Array) -> Array:
        """Return the standard deviations σ_T [N] of the motor-side tensions, (M,).

        They are 0 for tension sensors.

        Args:
            read: Readings T_read [N], (M,).
            direction: Last sliding directions s: 1 for winding in, −1 for paying out, (M,).
        """
        if self.drive is None or self.drive_covariance is None:
            return np.zeros_like(read)
        gain, _, friction = self.drive
        slope = np.stack([np.exp(gain) * read, -np.ones_like(read), -direction], axis=-1)
        variance = np.einsum('mi,mij,mj->m', slope, self.drive_covariance, slope)
        variance += np.square(friction) * np.maximum(1.0 - np.square(direction), 0.0)
        return np.sqrt(variance)

    def end(self, read: Array, direction: Array) -> Array:
        """Return the bone-side tensions T_end [N], (..., M).

        Args:
            read: Readings T_read [N], (..., M).
            direction: Last sliding directions s: 1 for winding in, −1 for paying out, (..., M).
        """
        end: Array = self.motor(read, direction) * np.exp(-self.friction * direction)
        return end

    def reading(self, motor: Array, direction: Array) -> Array:
        """Return the readings T_read [N], (..., M), that the muscle modules would report.

        Args:
            motor: Motor-side tensions T [N], (..., M).
            direction: Last sliding directions s: 1 for winding in, −1 for paying out, (..., M).
        """
        if self.drive is None:
            return motor
        gain, offset, friction = self.drive
        read: Array = (motor + offset + friction * direction) * np.exp(-gain)
        return read


class FrictionDirection:
    """Estimates s, the direction in which each tendon slid last, from muscle lengths alone.

        L ← L + g e,   g = (a + k) / (1 + k),   k = (ē / NOISE)⁴,   e = l − L

    L is a smoothed length, which follows the measured length l. ē is the running mean of the
    deviations e, in which the newest deviation has the weight a = LATEST. While a tendon rests, the
    gain g is low, and noise is averaged. While it slides, g rises, and L follows l without the
    delay of a low-pass filter.

    The remaining noise of L must not look like sliding. A tendon is therefore regarded as sliding
    only when L leaves a dead band of ±NOISE √(g / (2 − g)) [m], which then moves with L.

    Outliers have little effect, because each reading is limited to the range of the two readings
    before it, extended by SPIKE on both sides.
    """

    def __init__(self) -> None:
        self._length: Array | None = None

    def step(self, length: Array) -> Array:
        """Update the sliding directions with the next lengths [m], (M,), and return them, (M,)."""
        if self._length is None:
            self._length, self._mean, self._read = length, length, (length, length)
            self._off, self._direction = np.zeros_like(length), np.zeros_like(length)
        before, last = self._read
        limited = np.maximum(length, np.minimum(before, last) - SPIKE)
        limited = np.minimum(limited, np.maximum(before, last) + SPIKE)
        off = limited - self._mean
        self._read = last, length
        self._off = self._off + LATEST * (off / NOISE - self._off)  # ē / NOISE
        sliding = np.square(np.square(self._off))  # k
        share = sliding + LATEST  # g (1 + k)
        self._mean = self._mean + share / (1.0 + sliding) * off
        dead_band = NOISE * np.sqrt(share / (sliding + 2.0 - LATEST))
        least, most = self._mean - dead_band, self._mean + dead_band
        moved = np.minimum(np.maximum(self._length, least), most) - self._length
        self._length = self._length + moved
        self._direction = slid(self._direction, -np.sign(moved), moved)
        return self._direction

    def end_tension(self, transmission: Transmission, read: Array, length: Array) -> Array:
        """Update the sliding directions, and return the bone-side tensions [N], (M,).

        Args:
            transmission: Converts readings to bone-side tensions.
            read: Readings T_read [N], (M,).
            length: Next muscle lengths [m], (M,).
        """
        return transmission.end(read, self.step(length))

    def reset(self) -> None:
        """Discard all lengths, for example after a jump of the clock."""
        self._length = None


def directions(length: Array) -> Array:
    """Return the sliding directions s, (N, M), for the lengths [m], (N, M), of N messages.

    s is 1 after winding in and −1 after paying out.
    """
    step = FrictionDirection().step
    return np.array([step(each) for each in length]).reshape(length.shape)
