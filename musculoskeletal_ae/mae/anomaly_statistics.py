# SPDX-License-Identifier: Apache-2.0
"""Residuals of ② on healthy data, which a detector needs and a checkpoint carries.

    e = (T_est − T, l_est − l) in scaled units, shape (2M,)

The detector itself is a task; here is only what it has to know of the healthy body.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from musculoskeletal_ae.arrays import Array

# Below any sensor's resolution (0.02 N, 0.01 mm); keeps the covariance invertible when a network
# restores some combination of its inputs perfectly.
FLOOR = 1e-4


@dataclass(frozen=True, eq=False)
class AnomalyStatistics:
    """Mean and covariance of e over healthy data.

    Attributes:
        mean: Shape (2M,).
        covariance: Symmetric positive definite, shape (2M, 2M).
        calibrated: Whether the data came from the real arm, not from geometry.
        samples: How many samples they rest on.
        thresholds: What a detector found worth keeping, by name; finite numbers.
    """

    mean: Array
    covariance: Array
    calibrated: bool
    samples: int
    thresholds: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        residuals: Array,
        calibrated: bool,
        thresholds: Mapping[str, float] | None = None,
    ) -> AnomalyStatistics:
        """Take the statistics of residuals of shape (N, 2M), N ≥ 2."""
        centred = residuals - residuals.mean(axis=0)
        covariance = centred.T @ centred / max(len(residuals) - 1, 1)
        covariance = 0.5 * (covariance + covariance.T) + FLOOR**2 * np.eye(residuals.shape[1])
        return cls(
            residuals.mean(axis=0), covariance, calibrated, len(residuals), dict(thresholds or {})
        )
