# SPDX-License-Identifier: Apache-2.0
"""What ② leaves of a message, and what that looks like on a healthy body.

    e = (T_est − T, l_est − l)                        scaled units, shape (2M,)
    A = ‖T_est − T‖₂ + ‖l_est − l‖₂                   (paper, §III-D, eq. 4)

A checkpoint carries mean and covariance of e over healthy data; the detector that decides by them
is `estimation/detectors/residual_distance.py`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.units import LENGTH_SCALE, TENSION_SCALE, State

# Below any sensor's resolution (0.02 N, 0.01 mm); keeps the covariance invertible when a network
# restores some combination of its inputs perfectly.
FLOOR = 1e-4
LEAST_MOTION = 60.0  # [s]


def residuals(
    restored: State, tension: Array, length: Array, isolated: Sequence[int] = ()
) -> Array:
    """Return e (..., 2M) of states restored from measured T [N] (..., M) and l [m] (..., M).

    That of isolated muscles is 0.
    """
    pull = TENSION_SCALE * (restored.tension - tension)
    shift = LENGTH_SCALE * (restored.length - length)
    if isolated:
        pull[..., list(isolated)] = shift[..., list(isolated)] = 0.0
    return np.concatenate((pull, shift), axis=-1)


def anomaly(error: Array) -> Array:
    """Return A (...) of residuals e (..., 2M)."""
    halves = error.reshape(*error.shape[:-1], 2, -1)
    size: Array = np.sqrt((halves * halves).sum(axis=-1)).sum(axis=-1)
    return size


@dataclass(frozen=True, eq=False)
class AnomalyStatistics:
    """Mean and covariance of e over healthy data."""

    mean: Array  # (2M,)
    covariance: Array  # symmetric positive definite, (2M, 2M)
    calibrated: bool  # from the real arm, not from geometry
    samples: int  # that they rest on
    thresholds: Mapping[str, float] = field(default_factory=dict)  # of a detector, by name; finite
    #: θ [rad] (K, D) that they were seen in, far apart from each other; K may be 0
    postures: Array = field(default_factory=lambda: np.empty((0, 0)))

    @classmethod
    def of(cls, error: Array, calibrated: bool) -> AnomalyStatistics:
        """Return the statistics of residuals of shape (N, 2M), N ≥ 2."""
        mean = error.mean(axis=0)
        centred = error - mean
        covariance = centred.T @ centred / max(len(error) - 1, 1)
        covariance = 0.5 * (covariance + covariance.T) + FLOOR**2 * np.eye(error.shape[1])
        return cls(mean, covariance, calibrated, len(error))

    def distances(self, error: Array) -> Array:
        """Return d = √((e − μ)ᵀ Σ⁻¹ (e − μ)) of residuals (N, 2M)."""
        centred = error - self.mean
        squares = np.einsum('ni,ni->n', centred, np.linalg.solve(self.covariance, centred.T).T)
        return np.sqrt(squares)

    def without(self, muscles: Sequence[int]) -> AnomalyStatistics:
        """Return the statistics of the same residuals, but those of some muscles 0."""
        count = len(self.mean) // 2
        lost = [place + m for place in (0, count) for m in muscles]
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[lost] = covariance[lost] = covariance[:, lost] = 0.0
        covariance[lost, lost] = FLOOR**2
        return replace(self, mean=mean, covariance=covariance)


@dataclass(frozen=True, eq=False)
class TouchStatistics:
    """What tells a push from friction (`estimation/contact.py`)."""

    friction: Array  # μ of each wire: T at the motor is that at the elastic unit times e^{±μ}, (M,)
    spread: Array  # root mean square of τ_ext of the healthy arm in motion [N·m], (D,); positive
    time: float = 0.0  # of motion that the spread rests on [s]

    @property
    def calibrated(self) -> bool:
        """Whether it has seen enough motion to decide on contact."""
        return self.time >= LEAST_MOTION
