# SPDX-License-Identifier: Apache-2.0
"""Friction along the wires: which way each slid last decides what it takes of the tension.

    T = T_end e^{μ s},   s ← w + (s − w) e^{−|Δl|/b},   w = −sign Δl

T is the motor's, T_end the elastic unit's; s = 1 if the wire was wound in last: T is more then
(Dahl's friction: a wire that turns round lets go little by little). The network is that of the body
without friction: what it takes for T is T_end, so that everybody who asks it about what sensors
read turns one into the other.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array

REVERSAL = 0.0004  # [m] b, of sliding that turns friction round
#: [m] noise of a length; one that is off by as much in the mean of about 1/LATEST messages is as
#: likely sliding
NOISE = 0.00013
LATEST = 0.07
SPIKE = 0.0002  # [m] by which a reading may lie beyond the last two


def slid(direction: Array, way: Array, moved: Array) -> Array:
    """Return s (..., M) after wires have slid by `moved` [m] in a `way`, 1: wound in, (..., M)."""
    after: Array = way + (direction - way) * np.exp(np.abs(moved) * (-1.0 / REVERSAL))
    return after


def end_tension(friction: Array | float, tension: Array, direction: Array) -> Array:
    """Return T_end [N] (..., M) of T [N], by μ (M,) and s (..., M)."""
    end: Array = tension * np.exp(-friction * direction)
    return end


class FrictionDirection:
    """Which way each wire slid last, from muscle lengths alone.

        L ← L + g e,   g = (a + k) / (1 + k),   k = (ē / NOISE)⁴,   e = l − L

    with ē the mean of the latest e, and their share a = LATEST. So the lengths of a wire that rests
    are averaged, and one that slides is not followed late, as it would be by a low pass. It slid by
    as much as L leaves a play of NOISE √(g / (2 − g)) each way: the noise that is left in L would
    add up, to and fro. Of l counts what lies at most SPIKE beyond the last two: one that is off
    slides little.
    """

    def __init__(self) -> None:
        self._length: Array | None = None

    def step(self, length: Array) -> Array:
        """Take l [m] (M,); return s (M,)."""
        if self._length is None:
            self._length, self._mean, self._read = length, length, (length, length)
            self._off, self._direction = np.zeros_like(length), np.zeros_like(length)
        before, last = self._read
        likely = np.maximum(length, np.minimum(before, last) - SPIKE)
        off = np.minimum(likely, np.maximum(before, last) + SPIKE) - self._mean
        self._read = last, length
        self._off = self._off + LATEST * (off / NOISE - self._off)  # ē / NOISE
        sliding = np.square(np.square(self._off))
        share = sliding + LATEST  # g (1 + k)
        self._mean = self._mean + share / (1.0 + sliding) * off
        play = NOISE * np.sqrt(share / (sliding + 2.0 - LATEST))
        least, most = self._mean - play, self._mean + play
        moved = np.minimum(np.maximum(self._length, least), most) - self._length
        self._length = self._length + moved
        self._direction = slid(self._direction, -np.sign(moved), moved)
        return self._direction

    def end_tension(self, friction: Array | float, tension: Array, length: Array) -> Array:
        """Take T [N] and l [m] (M,); return T_end (M,), by μ (M,)."""
        return end_tension(friction, tension, self.step(length))

    def reset(self) -> None:
        """Forget, as after a jump of the clock."""
        self._length = None


def directions(length: Array) -> Array:
    """Return s (N, M) of l [m] (N, M), one message after the other."""
    step = FrictionDirection().step
    return np.array([step(each) for each in length]).reshape(length.shape)
