# SPDX-License-Identifier: Apache-2.0
"""What the detector has to know of a healthy arm: residuals of ② over messages that were fine.

    d = √((e − μ)ᵀ Σ⁻¹ (e − μ)),   threshold = margin · (1 + young/samples) · max d

Messages, moving and resting, are kept in a reservoir, a uniform draw from all that ever came; each
new network gets statistics of its own residuals on them. The threshold rests on the maximum, since
friction gives d heavy tails, and on a part of the messages that Σ did not see. Glitches of
a sensor are no part of that: a few messages at most, far beyond all the rest, are left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.anomaly import DISTANCE
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import FLOOR, AnomalyStatistics, residuals

CAPACITY = 4000
SPACING = 0.1  # [s] between messages that are kept
#: healthy time [s], samples learned, and different rests within that time before a detector is
#: worth trusting
LEAST_TIME, LEAST_SAMPLES = 60.0, 20
#: Threshold over the largest d seen, for a body well known. A load of 3.6 kg that was never carried
#: before doubles it; a wire that is cut multiplies it by six to ten within 0.3 s.
MARGIN = 3.5
#: and by how much more while few samples say what the body is: 1 + this / samples
YOUNG = 20.0
#: Σ is mixed with its own diagonal, so that no combination of muscles looks impossible that was
#: only not seen
DIAGONAL_SHARE = 0.1
#: this share of the messages is left out at most, and what is so many times beyond all others
GLITCHES, GLITCH = 0.002, 3.0


class Healthy(NamedTuple):
    """What was seen of the healthy arm since it was last changed.

    Attributes:
        messages: (T, l), shape (N, 2M).
        time: Time that they were drawn from [s].
        rests: How many different rests there were within.
    """

    messages: NDArray[np.float32]
    time: float
    rests: int


class Reservoir:
    """A uniform draw of bounded size from all healthy messages.

    Attributes:
        time: Healthy time seen [s].
    """

    def __init__(self, muscles: int, seed: int = 0, capacity: int = CAPACITY) -> None:
        """Start empty."""
        self._rng = np.random.default_rng([seed, 0x4E])
        self._kept = np.empty((capacity, 2 * muscles), dtype=np.float32)
        self._seen = 0
        self._since = 0.0
        self.time = 0.0

    def step(self, tension: Array, length: Array, dt: float) -> None:
        """Take a healthy message."""
        self._since += dt
        if self._since < SPACING - 1e-9:
            return
        self.time += min(self._since, 2.0 * SPACING)
        self._since = 0.0
        capacity = len(self._kept)
        place = self._seen if self._seen < capacity else int(self._rng.integers(self._seen + 1))
        if place < capacity:
            self._kept[place] = np.concatenate([tension, length])
        self._seen += 1

    def clear(self) -> None:
        """Forget all, as when the body has changed."""
        self._seen, self._since, self.time = 0, 0.0, 0.0

    def messages(self) -> NDArray[np.float32]:
        """Return (T, l) of the messages kept, shape (N, 2M)."""
        return self._kept[: min(self._seen, len(self._kept))].copy()


def calibrate(mae: Mae, healthy: Healthy, samples: int) -> AnomalyStatistics | None:
    """Return statistics of a network's residuals, or None where there is too little.

    Args:
        mae: The network.
        healthy: What the healthy arm showed.
        samples: How many samples the network has learned.
    """
    if len(healthy.messages) < 2:
        return None
    tension, length = np.split(healthy.messages.astype(float), 2, axis=1)
    error = _without_glitches(residuals(mae.estimate(tension, length), tension, length))
    known = min(samples, healthy.rests)
    calibrated = healthy.time >= LEAST_TIME and known >= LEAST_SAMPLES
    part = AnomalyStatistics.of(error[::2], calibrated)
    held_out = distances(_regularised(part), error[1::2])
    statistics = _regularised(AnomalyStatistics.of(error, calibrated))
    largest = max(float(held_out.max()), float(distances(statistics, error).max()))
    norm = sum(np.linalg.norm(half, axis=1) for half in np.split(error, 2, axis=1))
    thresholds = {
        DISTANCE: MARGIN * (1.0 + YOUNG / max(known, 1)) * largest,
        'norm': float(np.max(norm)),
    }
    return AnomalyStatistics(
        statistics.mean, statistics.covariance, calibrated, len(error), thresholds
    )


def _without_glitches(error: Array) -> Array:
    few = int(GLITCHES * len(error))
    if few == 0:
        return error
    # Statistics that glitches cannot spoil: of the others, first by each residual's own spread.
    middle = np.median(error, axis=0)
    spread = np.median(np.abs(error - middle), axis=0) + FLOOR
    order = np.argsort((np.abs(error - middle) / spread).max(axis=1))
    distance = distances(_regularised(AnomalyStatistics.of(error[order[:-few]], False)), error)
    rest = np.sort(distance)[-few - 1]
    return error[distance <= GLITCH * rest]


def recalibrate(
    mae: Mae, before: AnomalyStatistics | None, healthy: Healthy, samples: int
) -> AnomalyStatistics | None:
    """Return statistics of a network's residuals that are at least as trusted as those before.

    After a restart the messages are few, and the calibrated statistics of the network that was
    saved serve its successors until there are enough. Arguments as `calibrate`.
    """
    found = calibrate(mae, healthy, samples)
    keep = before is not None and before.calibrated
    if found is None or (keep and not found.calibrated):
        return before
    return found


def distances(statistics: AnomalyStatistics, error: Array) -> Array:
    """Return d of residuals (N, 2M)."""
    centred = error - statistics.mean
    squares = np.einsum('ni,ni->n', centred, np.linalg.solve(statistics.covariance, centred.T).T)
    return np.sqrt(squares)


def _regularised(statistics: AnomalyStatistics) -> AnomalyStatistics:
    covariance = statistics.covariance
    mixed = (1.0 - DIAGONAL_SHARE) * covariance + DIAGONAL_SHARE * np.diag(np.diag(covariance))
    return AnomalyStatistics(statistics.mean, mixed, statistics.calibrated, statistics.samples)
