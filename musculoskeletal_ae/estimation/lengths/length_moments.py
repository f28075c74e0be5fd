# SPDX-License-Identifier: Apache-2.0
"""Collects the readings for a length calibration: means over short windows, called moments.

Tendon friction changes its sign with the direction of motion. The moments therefore have to cover
many postures, reached from different sides. A moment of a moving arm is kept only if the arm has
moved since the previous moment, but not so fast that inertial forces matter. If the arm is to stand
in a stated posture, moments are kept until it moves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.signals.friction import FrictionDirection

WINDOW = 0.25  # average readings over this time; the mean is called a moment [s]
#: conclude that the arm has moved since the last moment if a length has changed by more than this
#: [m]
MOVED = 0.002
#: skip moments in which a muscle is faster than this [m/s], because inertial forces matter then
FASTEST = 0.05
MOST = 240  # keep at most this many of the newest moments, which bounds the time of a fit


class Moments(NamedTuple):
    """Means of the readings over K short windows.

    Attributes:
        tension: Tensions [N], 0 for isolated muscles, (K, M).
        length: Muscle lengths as read [m], 0 for isolated muscles, (K, M).
        sliding: Direction in which each tendon slid last, (K, M): 1 when wound in, −1 when paid
            out.
        read: Lengths of all muscles as read, including isolated muscles [m], (K, M).
        theta: Measured or stated joint angles [rad], NaN where they are unknown, (K, D).
    """

    tension: Array
    length: Array
    sliding: Array
    read: Array
    theta: Array

    def rows(self, rows: Ints) -> Moments:
        """Return the moments with these indices."""
        return Moments(*(part[rows] for part in self))


class MomentCollector:
    """Averages the readings of an arm that moves gently or stands, over short windows (moments).

    Attributes:
        time: Duration of the gentle motion, or of standing [s].
        has_moved_away: Whether an arm that should stand has moved.
    """

    def __init__(self, used: Bools, joint_count: int, posture: Array | None) -> None:
        """Start without moments.

        Args:
            used: Whether each muscle is used, that is, not isolated, (M,).
            joint_count: Number of joints D.
            posture: θ [rad] (D,) in which the arm stands, or None if it moves.
        """
        self._used, self._posture = used, posture
        self._no_angles = np.full(joint_count, np.nan)
        self._direction = FrictionDirection()
        #: tension, length, sliding direction and raw length of each message
        self._window: list[tuple[Array, ...]] = []
        self._angles: list[Array] = []  # measured θ in the same window
        self._span = 0.0  # duration of the present window so far [s]
        self._moments: list[tuple[Array, ...]] = []
        self._last_length: Array = np.zeros(len(used))  # length from which motion counts [m]
        self.time = 0.0
        self.has_moved_away = False

    def __len__(self) -> int:
        return len(self._moments)

    def moments(self) -> Moments:
        """Return all moments that have been kept."""
        return Moments(*map(np.array, zip(*self._moments)))

    def step(self, tension: Array, length: Array, dt: float, theta: Array | None) -> None:
        """Add the readings of one message to the present window; a full window becomes a moment.

        Args:
            tension: Tensions [N], (M,).
            length: Muscle lengths as read [m], (M,).
            dt: Time since the previous message [s].
            theta: Measured joint angles [rad], (D,), or None.
        """
        used_length = length * self._used
        sliding = self._direction.step(used_length)
        self._window.append((tension * self._used, used_length, sliding, length))
        known_angles = theta if self._posture is None else self._posture
        if known_angles is not None:
            self._angles.append(known_angles)
        self._span += dt
        if self._span < WINDOW:
            return
        parts = (*zip(*self._window), self._angles or [self._no_angles])
        self._take(tuple(np.mean(part, axis=0) for part in parts))
        self._window, self._angles, self._span = [], [], 0.0

    def _take(self, moment: tuple[Array, ...]) -> None:
        length, is_first = moment[1], not self._moments
        moved = 0.0 if is_first else float(np.abs(length - self._last_length).max())
        if self._posture is not None:
            if moved > MOVED:
                self.has_moved_away = True
                return
            if is_first:
                self._last_length = length
        else:
            if not is_first and moved < MOVED:
                return
            self._last_length = length
            if moved > FASTEST * WINDOW:
                return
        self.time += 0.0 if is_first else WINDOW
        self._moments = [*self._moments[1 - MOST :], moment]
