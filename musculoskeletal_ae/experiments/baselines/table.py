# SPDX-License-Identifier: Apache-2.0
"""Table search (Nakanishi 2010): the posture whose muscle lengths are nearest to the measured.

    θ_est = θ_k,   k = argmin_k ‖l_k − (l + L_e(l_abs, T))‖₂

Before learning the table holds random postures of the geometric model; learning replaces it by what
was measured while exploring, every row with its elongation taken off.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.experiments.baselines.estimator import unstretched
from musculoskeletal_ae.robot.robot import Robot

ROWS = 100_000


class TableSearch:
    """A table of postures and their lengths without tension."""

    name = 'table search'
    stride = 1

    def __init__(self, robot: Robot) -> None:
        """Fill the table from the geometric model."""
        self._robot = robot
        theta = robot.random_postures(ROWS, np.random.default_rng(0))
        self._fill(theta, robot.routes.relative_lengths(theta))

    def _fill(self, theta: Array, length: Array) -> None:
        self._theta, self._lengths = theta, cKDTree(length)

    def learn(self, theta: Array, tension: Array, length: Array) -> None:
        """Replace the table by samples."""
        self._fill(theta, unstretched(self._robot, tension, length))

    def estimate(self, tension: Array, length: Array, dt: float) -> Array:  # noqa: ARG002 (no rates)
        """Return θ [rad] (N, D); see `Baseline`."""
        nearest = self._lengths.query(unstretched(self._robot, tension, length))[1]
        found: Array = self._theta[nearest]
        return found
