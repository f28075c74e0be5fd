# SPDX-License-Identifier: Apache-2.0
"""Collect the readings that length calibration rests on: means of short windows, called moments.

Tendon friction lengthens and shortens by turns. Therefore the moments have to cover many postures,
which are reached from different sides. Only moments at which the arm has moved on count.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.signals.friction import FrictionDirection

WINDOW = 0.25  # [s] that one moment averages
MOVED = 0.002  # [m] of some muscle since the moment before, beyond which the arm has moved on
FASTEST = 0.05  # [m/s] of a muscle, above which inertia is no longer small beside the weight
MOST = 240  # moments that are kept


class Moments(NamedTuple):
    """Means of K short windows.

    Attributes:
        tension: T [N], (K, M).
        length: l as it was read [m], (K, M); 0 for isolated muscles.
        sliding: s of every tendon's friction: 1 wound in last, −1 paid out last, (K, M).
        read: l of all muscles as it was read, also of isolated ones [m], (K, M).
        theta: Measured θ [rad], (K, D); NaN where it was not measured.
    """

    tension: Array
    length: Array
    sliding: Array
    read: Array
    theta: Array

    def rows(self, rows: Ints) -> Moments:
        """Return some of the moments."""
        return Moments(*(part[rows] for part in self))


class MomentCollector:
    """Collects the moments of an arm that moves gently, or that stands in a stated posture.

    Attributes:
        time: How long the arm has moved gently, or stood [s].
        has_moved_away: Whether an arm that was to stand has moved.
    """

    def __init__(self, used: Bools, joint_count: int, posture: Array | None) -> None:
        """Collect.

        Args:
            used: Which muscles are not isolated, (M,).
            joint_count: D.
            posture: θ [rad] (D,) in which the arm stands, or None if it moves.
        """
        self._used, self._posture = used, posture
        self._no_angles = np.full(joint_count, np.nan)
        self._direction = FrictionDirection()
        self._window: list[tuple[Array, ...]] = []  # T, l, s and l as it was read
        self._angles: list[Array] = []  # θ in the same window, where it was measured
        self._span = 0.0  # [s] of the window so far
        self._moments: list[tuple[Array, ...]] = []
        self._last_length: Array = np.zeros(len(used))  # of the last moment at which it had moved
        self.time = 0.0
        self.has_moved_away = False

    def __len__(self) -> int:
        return len(self._moments)

    def moments(self) -> Moments:
        """Return all moments that are kept."""
        return Moments(*map(np.array, zip(*self._moments)))

    def step(self, tension: Array, length: Array, dt: float, theta: Array | None) -> None:
        """Take T [N] and l as it was read [m], (M,), dt [s] after the last, and θ if measured."""
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
