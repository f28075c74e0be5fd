# SPDX-License-Identifier: Apache-2.0
"""Calibrating the anomaly detector: residuals of ② over messages of the healthy arm.

    d = √((e − μ)ᵀ Σ⁻¹ (e − μ)),   threshold = margin · (1 + young/samples) · max d (of A: max A)

Messages, moving and resting, are kept in a reservoir, a uniform draw from all that ever came; each
new network gets statistics of its own residuals on them. The threshold rests on the maximum, since
friction gives d heavy tails, and on a part of the messages that Σ did not see. Glitches of
a sensor are no part of that: a few messages at most, far beyond all the rest, are left out.

Where joint sensors read all angles, the network learns from every second message, too (`update`);
the others, which it has never seen, tell how good its estimates are.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.estimation.detectors.residual_distance import DISTANCE, NORM
from musculoskeletal_ae.learning.samples import Observations, Sample, SampleStore
from musculoskeletal_ae.learning.settings import DEFAULT, Settings
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import FLOOR, AnomalyStatistics, anomaly, residuals
from musculoskeletal_ae.signals.friction import end_tension

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
POSTURES = 200  # that tell where it was calibrated
#: healthy time [s] and rests within which messages are learned from: wires creep and bed in
RECENT, RECENT_RESTS = 3600.0, 200


class Healthy(NamedTuple):
    """What was seen of the healthy arm since it was last changed."""

    messages: NDArray[np.float32]  # (T, l, s), (N, 3M)
    time: float  # that they were drawn from [s]
    rests: int  # how many different ones there were within
    #: recent ones, moving or resting, with all angles: those that are learned, and those that judge
    learned: Observations | None = None
    judging: Observations | None = None


class Reservoir:
    """A uniform draw of bounded size from all messages of the healthy arm, and its rests."""

    def __init__(
        self,
        muscles: int,
        seed: int = 0,
        settings: Settings = DEFAULT,
        capacity: int = CAPACITY,
        radian: Array | float = 1.0,
    ) -> None:
        """Start empty; rests differ as samples do, `radian` as there."""
        self._rng = np.random.default_rng([seed, 0x4E])
        self._muscles, self._capacity = muscles, capacity
        self._kept: list[NDArray[np.float32]] = []
        self._seen, self._since = 0, 0.0
        self.time = 0.0  # healthy time seen [s]
        self._missing: frozenset[int] = frozenset()  # muscles that some messages lack
        self._rests = SampleStore(settings, radian=radian)

    def step(self, reading: Sample, dt: float) -> None:
        """Take a message, with θ where joint sensors read it."""
        self._since += dt
        if self._since < SPACING - 1e-9:
            return
        self.time += min(self._since, 2.0 * SPACING)
        self._since = 0.0
        self._missing |= frozenset(reading.isolated)
        self._seen += 1
        full = len(self._kept) == self._capacity
        place = int(self._rng.integers(self._seen)) if full else len(self._kept)
        if place < self._capacity:
            theta = reading.theta if reading.spread.size == 0 else np.nan * reading.theta
            muscles, when = reading[1:4], [self._rests.accepted, self.time]
            row = np.concatenate([*muscles, theta, when], dtype=np.float32)
            self._kept[place : place + 1] = [row]

    def rest(self, rest: Sample) -> None:
        """Count a rest if it differs from those before."""
        if self._rests.is_new(rest):
            self._rests.add(rest)

    def use_isolated(self, isolated: Iterable[int]) -> None:
        """Go on with these muscles isolated; forget all if messages lack another muscle."""
        if self._missing - frozenset(isolated):
            self.clear()

    def forget_newest(self, seconds: float) -> None:
        """Forget the messages of the last seconds."""
        self._kept = [row for row in self._kept if row[-1] <= self.time - seconds]

    def clear(self) -> None:
        """Forget all, as when the body has changed."""
        self._missing = frozenset()
        self._kept.clear()
        self._seen, self._since, self.time = 0, 0.0, 0.0
        self._rests.clear()

    def healthy(self) -> Healthy:
        """Return what was seen."""
        m, count = self._muscles, len(self._rests)
        if not self._kept:
            return Healthy(np.empty((0, 3 * m), np.float32), self.time, count)
        rows = np.array(self._kept)
        columns = np.split(rows.astype(float), [m, 2 * m, 3 * m, -2, -1], axis=1)
        tension, length, direction, theta, number, time = columns
        age = self._rests.accepted - number[:, 0]
        recent = (time[:, 0] > self.time - RECENT) & (age < RECENT_RESTS)
        # 0 N: it was isolated then, or slack.
        whole = recent & np.isfinite(theta).all(axis=1) & (tension > 0.0).all(axis=1)
        known = np.ones(tension.shape, dtype=bool)
        observed = Observations(theta, tension, length, direction, known, age=age)
        place, second = np.flatnonzero(whole), np.arange(len(rows))[whole] % 2
        parts = observed[place[second == 0]], observed[place[second == 1]]
        return Healthy(rows[:, : 3 * m], self.time, count, *parts)


def recalibrated(mae: Mae, before: AnomalyStatistics | None, healthy: Healthy, samples: int) -> Mae:
    """Return a network with statistics of its residuals, at least as trusted as those before.

    After a restart the messages are few, and the calibrated statistics of the network that was
    saved (`before`) serve its successors until there are enough. `samples` is the number learned.
    """
    statistics = calibrate(mae, healthy, samples)
    keep = before is not None and before.calibrated
    if statistics is None or (keep and not statistics.calibrated):
        statistics = before
    return replace(mae, anomaly=statistics)


def uncalibrated(mae: Mae) -> Mae:
    """Return a network that says that its statistics are not of the arm as it is now."""
    if mae.anomaly is None:
        return mae
    return replace(mae, anomaly=replace(mae.anomaly, calibrated=False))


def is_learned(mae: Mae) -> bool:
    """Return whether a network was learned from an arm, not only from its geometric model."""
    return mae.covariance is not None or is_calibrated(mae)


def is_calibrated(mae: Mae) -> bool:
    """Whether a network's statistics come from the real arm."""
    return mae.anomaly is not None and mae.anomaly.calibrated


def calibrate(mae: Mae, healthy: Healthy, samples: int) -> AnomalyStatistics | None:
    """Return statistics of a network's residuals, or None where there is too little."""
    if len(healthy.messages) < 2:
        return None
    tension, length, direction = np.split(healthy.messages.astype(float), 3, axis=1)
    tension = end_tension(mae.friction, tension, direction)
    state = mae.estimate(tension, length)
    error = residuals(state, tension, length, mae.isolated)
    sound = ~_glitches(error)
    known = min(samples, healthy.rests)
    calibrated = bool(healthy.time >= LEAST_TIME) and known >= LEAST_SAMPLES
    # Each message has its part whatever is left out, so that a glitch moves no other one.
    first = np.arange(len(error)) % 2 == 0
    part = _statistics(error[sound & first], calibrated)
    statistics = _statistics(error[sound], calibrated)
    largest = max(
        part.distances(error[sound & ~first]).max(initial=0.0),
        statistics.distances(error[sound]).max(),
    )
    margin = MARGIN * (1.0 + YOUNG / max(known, 1))
    thresholds = {
        DISTANCE: float(margin * largest),
        NORM: float(margin * anomaly(error[sound]).max()),
    }
    return replace(
        statistics, thresholds=thresholds, postures=_spread_out(state.theta[sound], POSTURES)
    )


def _spread_out(theta: Array, count: int) -> Array:
    """Return at most `count` of many θ (N, D), each the farthest from those before it."""
    share = theta / (np.ptp(theta, axis=0) + 1e-9)
    distance, chosen = np.full(len(theta), np.inf), [0]
    for _ in range(min(count, len(theta)) - 1):
        away = share - share[chosen[-1]]
        distance = np.minimum(distance, np.einsum('nd,nd->n', away, away))
        chosen.append(int(distance.argmax()))
    return theta[chosen]


def _glitches(error: Array) -> Bools:
    few = int(GLITCHES * len(error))
    if few == 0:
        return np.zeros(len(error), dtype=bool)
    # Statistics that glitches cannot spoil: of the others, first by each residual's own spread.
    middle = np.median(error, axis=0)
    spread = np.median(np.abs(error - middle), axis=0) + FLOOR
    order = np.argsort((np.abs(error - middle) / spread).max(axis=1))
    distance = _statistics(error[order[:-few]]).distances(error)
    return np.greater(distance, GLITCH * np.sort(distance)[-few - 1])


def _statistics(error: Array, calibrated: bool = False) -> AnomalyStatistics:
    statistics = AnomalyStatistics.of(error, calibrated)
    covariance = statistics.covariance
    mixed = (1.0 - DIAGONAL_SHARE) * covariance + DIAGONAL_SHARE * np.diag(np.diag(covariance))
    return replace(statistics, covariance=mixed)
