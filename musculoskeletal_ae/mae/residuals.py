# SPDX-License-Identifier: Apache-2.0
"""Residuals of tensions and lengths, and their statistics on a healthy arm.

    e = (T_est − T, l_est − l)                        scaled units, shape (2M,)
    A = ‖T_est − T‖₂ + ‖l_est − l‖₂                   (paper, §III-D, eq. 4)

T and l are measured, and the network reconstructs T_est and l_est from them. A checkpoint contains
mean and covariance of e over healthy data. The detector that uses them is
`estimation/detectors/residual_distance.py`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.units import LENGTH_SCALE, TENSION_SCALE, State

NORM = 'norm'  # name under which a checkpoint stores the threshold of the anomaly score A
#: Assume at least this standard deviation of a residual in scaled units: 0.02 N or 0.01 mm, which
#: no sensor resolves. This floor keeps the covariance invertible if a network reconstructs some
#: combination of its inputs perfectly.
FLOOR = 1e-4
#: give the residuals of an ignored muscle this standard deviation in scaled units, which is 2000 N
#: or 1 m, so that they do not matter
ANYTHING = 10.0
#: rely on the residual torque only after it was measured during at least this much motion [s]
LEAST_MOTION = 60.0
LEAST_PEAKS = 6  # detect contact only once this many peaks are known (`rare_peak`)
#: Peaks are assumed to follow a Gumbel distribution. One peak in 3600, which is one in 10 h, is at
#: least this many standard deviations above their mean.
RARE = 5.9
#: N peaks determine their standard deviation badly if N is small: multiply it by 1 + FEW / N
FEW = 3.0
LEAST_SCATTER = 0.15  # assume at least this standard deviation of the peaks, relative to the median
#: standard deviation of a Gumbel distribution, relative to its median absolute deviation
GUMBEL = 1.67
#: Clip peaks that are further above the median than this many standard deviations (as estimated by
#: the median absolute deviation). They may be contacts from before the threshold was known.
OUTLYING = 6.0


def residuals(
    reconstructed: State, tension: Array, length: Array, isolated: Sequence[int] = ()
) -> Array:
    """Return the residuals e in scaled units, (..., 2M), which are 0 for isolated muscles.

    Args:
        reconstructed: States that the network reconstructed from the measured T and l.
        tension: Measured T [N], (..., M).
        length: Measured l [m], (..., M).
        isolated: Indices of isolated muscles.
    """
    by_tension = TENSION_SCALE * (reconstructed.tension - tension)
    by_length = LENGTH_SCALE * (reconstructed.length - length)
    if isolated:
        by_tension[..., list(isolated)] = by_length[..., list(isolated)] = 0.0
    return np.concatenate((by_tension, by_length), axis=-1)


def anomaly(error: Array) -> Array:
    """Return the anomaly score A (...) of residuals e (..., 2M)."""
    halves = error.reshape(*error.shape[:-1], 2, -1)
    size: Array = np.sqrt((halves * halves).sum(axis=-1)).sum(axis=-1)
    return size


@dataclass(frozen=True, eq=False)
class AnomalyStatistics:
    """Mean and covariance of the residuals e = (T_est − T, l_est − l) over healthy data."""

    mean: Array  # mean μ of the residuals e, (2M,)
    covariance: Array  # their covariance Σ, symmetric and positive definite, (2M, 2M)
    calibrated: bool  # whether enough data of the real arm, in its present state, are included
    samples: int  # number of messages from which mean and covariance were computed
    #: thresholds of the detectors, by name; all are finite
    thresholds: Mapping[str, float] = field(default_factory=dict)
    #: θ [rad] (K, D) of healthy postures far apart from each other; K may be 0
    postures: Array = field(default_factory=lambda: np.empty((0, 0)))

    @classmethod
    def of(cls, error: Array, calibrated: bool) -> AnomalyStatistics:
        """Return the statistics of residuals of shape (N, 2M), N ≥ 2.

        `calibrated` says whether they were measured on the arm, and not on its model.
        """
        mean = error.mean(axis=0)
        centred = error - mean
        covariance = centred.T @ centred / max(len(error) - 1, 1)
        covariance = 0.5 * (covariance + covariance.T) + FLOOR**2 * np.eye(error.shape[1])
        return cls(mean, covariance, calibrated, len(error))

    def distances(self, error: Array) -> Array:
        """Return the Mahalanobis distances √((e − μ)ᵀ Σ⁻¹ (e − μ)) of residuals (N, 2M)."""
        centred = error - self.mean
        squares = np.einsum('ni,ni->n', centred, np.linalg.solve(self.covariance, centred.T).T)
        return np.sqrt(squares)

    def without(self, muscles: Sequence[int]) -> AnomalyStatistics:
        """Return the statistics without these muscles, whose residuals are then always 0."""
        return self._with_spread(muscles, FLOOR)

    def ignoring(self, muscles: Sequence[int]) -> AnomalyStatistics:
        """Return statistics ignoring these muscles: any residual of theirs is normal.

        Their residuals then hardly change the result of `distances`.
        """
        return self._with_spread(muscles, ANYTHING)

    def _with_spread(self, muscles: Sequence[int], spread: float) -> AnomalyStatistics:
        count = len(self.mean) // 2
        places = [place + m for place in (0, count) for m in muscles]
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[places] = covariance[places] = covariance[:, places] = 0.0
        covariance[places, places] = spread**2
        return replace(self, mean=mean, covariance=covariance)


def rare_peak(peaks: Array) -> float:
    """Return the evidence for contact d that a healthy arm exceeds about once in 10 h of motion.

    The result is ∞ if there are too few peaks.

    The external torque of a healthy arm is sometimes estimated much larger than usual, in rare
    postures or when friction suddenly reverses. How much larger differs between arms, so each arm
    has a threshold of its own.

    Args:
        peaks: The largest d in each period of 10 s of motion, (N,). Less than half of the periods
            may contain contacts.
    """
    if len(peaks) < LEAST_PEAKS:
        return np.inf
    middle = np.median(peaks)
    least = LEAST_SCATTER * middle
    usual = max(GUMBEL * np.median(np.abs(peaks - middle)), least)
    bounded = np.minimum(peaks, middle + OUTLYING * usual)
    spread = max(bounded.std(ddof=1), least)
    return float(bounded.mean() + RARE * (1.0 + FEW / len(peaks)) * spread)


@dataclass(frozen=True, eq=False)
class TouchStatistics:
    """Tendon friction and residual torque, by which contact is detected."""

    friction: Array  # tendon friction μ of each muscle, (M,): T = T_end e^{±μ}
    #: root mean square of the estimated τ_ext of the healthy moving arm [N·m], (D,); positive
    spread: Array
    time: float = 0.0  # duration of the motion in which `spread` was measured [s]
    #: scale error γ, offset b [N] and friction F [N] of motor currents, (3, M), as
    #: `signals.friction.Transmission` explains; None for tension sensors
    drive: Array | None = None
    #: covariances of γ, b and F, (M, 3, 3); None for tension sensors
    drive_covariance: Array | None = None
    #: the largest evidence for contact in the last periods of healthy motion, (N,), N ≥ 0
    peaks: Array = field(default_factory=lambda: np.empty(0))

    @property
    def calibrated(self) -> bool:
        """Whether the residual torque was measured in enough motion to rely on it."""
        return self.time >= LEAST_MOTION

    def with_measurements_of(self, other: TouchStatistics) -> TouchStatistics:
        """Return these statistics with what another network knows from healthy motion."""
        return replace(self, spread=other.spread, time=other.time, peaks=other.peaks)
