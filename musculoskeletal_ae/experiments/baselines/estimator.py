# SPDX-License-Identifier: Apache-2.0
"""What every baseline can do, and what it may learn from."""

from __future__ import annotations

from typing import Protocol

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot


class Baseline(Protocol):
    """An estimator of θ from (T, l).

    Attributes:
        name: For tables.
        stride: It is given every so many messages, where all of them would take too long.
    """

    name: str
    stride: int

    def learn(self, theta: Array, tension: Array, length: Array) -> None:
        """Learn from samples (N, D), (N, M), (N, M) what its paper learned, if it did."""

    def estimate(self, tension: Array, length: Array, dt: float) -> Array:
        """Return θ [rad] (N, D) for successive messages (N, M) that are `dt` [s] apart."""


def unstretched(robot: Robot, tension: Array, length: Array) -> Array:
    """Return l without the elongation that the model expects, l + L_e(l_abs, T) [m].

    L_e needs the absolute length, which the measured one gives to within the elongation itself.
    """
    absolute = robot.routes.length_at_zero + length
    elongation = robot.series_elastic.elongation(absolute, tension)
    compensated: Array = length + robot.series_elastic.elongation(absolute + elongation, tension)
    return compensated
