# SPDX-License-Identifier: Apache-2.0
"""Calibrates the anomaly detector with the residuals of messages of the healthy arm.

    d = √((e − μ)ᵀ Σ⁻¹ (e − μ)),   threshold of d = margin · (1 + n_few/samples) · max d
                                   threshold of A = margin · (1 + n_few/samples) · max A

e are the residuals of a message: the tensions and lengths that the network reconstructs from it,
minus the measured ones. A is one number for the magnitude of e (`mae.residuals`). μ and Σ are mean
and covariance of e, margin is `MARGIN`, and n_few is `FEW_SAMPLES`.

A reservoir keeps a uniform random selection of all messages, from motion and from rest. Each new
network gets the statistics of its own residuals on these messages. The thresholds use the maximum,
because friction gives d heavy tails. The maximum is also taken over messages that were
not used to compute Σ, so that it is not too low for new messages. Single messages far beyond all
others are regarded as sensor glitches and excluded.

If joint sensors read all angles, the network also learns from every second recent message
(`body_updater`). The other recent messages serve to validate its estimates.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.body_model.observations import Observations, Sample
from musculoskeletal_ae.estimation.detectors.residual_distance import DISTANCE
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import FLOOR, NORM, AnomalyStatistics, anomaly, residuals

CAPACITY = 4000  # keep a random selection of at most this many healthy messages by default
SPACING = 0.1  # consider at most one message in this time for the selection [s]
LEAST_TIME = 60.0  # calibrate a detector only after the arm has been healthy for this long [s]
#: calibrate a detector only if the healthy arm has rested in at least this many distinct postures,
#: and if the network has learned at least as many samples
LEAST_SAMPLES = 20
#: Multiply the largest residual distance d of healthy messages by this to get the threshold, once
#: the body is well known. An unknown load of 3.6 kg doubles d; a ruptured tendon multiplies it by
#: six to ten within 0.3 s.
MARGIN = 3.5
#: n_few: multiply the threshold by 1 + n_few/samples, and thus double it at this number of samples,
#: because few samples determine the body poorly
FEW_SAMPLES = 20.0
#: Mix this share of the diagonal of Σ into the covariance Σ of the residuals. Otherwise residuals
#: that combine muscles in ways not seen in the messages would look impossible.
DIAGONAL_SHARE = 0.1
GLITCH_SHARE = 0.002  # exclude at most this share of the messages as glitches
#: exclude a message as a glitch if its residual distance d exceeds the largest d of all others by
#: this factor
GLITCH_RATIO = 3.0
POSTURES = 200  # store this many postures in the checkpoint; far from them, the threshold is raised
# Messages from which the network learns must be recent, because tendons creep and bed in.
RECENT_TIME = 3600.0  # learn from a message only if it is younger than this [s]
RECENT_RESTS = 200  # learn from a message only if fewer rest samples than this came after it


class Healthy(NamedTuple):
    """Messages of the healthy arm since its body last changed."""

    messages: NDArray[np.float32]  # tensions T, lengths l and sliding directions s, (N, 3M)
    time: float  # healthy time from which the messages were drawn [s]
    rests: int  # number of distinct rests in the healthy time
    #: half of the recent messages with all joint angles, from motion and rest, for training
    learned: Observations | None = None
    judging: Observations | None = None  # the other half of the recent messages, for validation


class Reservoir:
    """Keeps a bounded random selection of healthy messages, and counts distinct rests."""

    def __init__(
        self,
        muscles: int,
        seed: int = 0,
        capacity: int = CAPACITY,
        *,
        of_currents: bool = False,
    ) -> None:
        """Create an empty reservoir.

        Args:
            muscles: Number of muscles.
            seed: Seed of the random selection.
            capacity: Largest number of messages.
            of_currents: Whether tensions are converted motor currents, which may be negative.
        """
        self._of_currents = of_currents
        self._rng = np.random.default_rng([seed, 0x4E])
        self._muscles, self._capacity = muscles, capacity
        self._kept: list[NDArray[np.float32]] = []
        self._offered, self._since = 0, 0.0
        self.time = 0.0  # healthy time [s]
        self._missing: frozenset[int] = frozenset()  # muscles that were isolated in some messages
        self._rests = SampleStore()

    def step(self, reading: Sample, dt: float, isolated: Iterable[int] = ()) -> None:
        """Add a message to the selection with a probability that keeps the selection uniform.

        Only one message in 0.1 s (SPACING) is considered; all others are ignored.

        Args:
            reading: The message, with NaN for unmeasured θ.
            dt: Time since the previous message [s].
            isolated: Indices of the muscles that are isolated, so that the message lacks them.
        """
        self._since += dt
        if self._since < SPACING - 1e-9:
            return
        self.time += min(self._since, 2.0 * SPACING)
        self._since = 0.0
        self._missing |= frozenset(isolated)
        self._offered += 1
        full = len(self._kept) == self._capacity
        place = int(self._rng.integers(self._offered)) if full else len(self._kept)
        if place < self._capacity:
            theta = reading.theta if reading.spread.size == 0 else np.nan * reading.theta
            muscles, when = reading[1:4], [self._rests.accepted, self.time]
            row = np.concatenate([*muscles, theta, when], dtype=np.float32)
            self._kept[place : place + 1] = [row]

    def rest(self, rest: Sample) -> None:
        """Count a rest sample if its posture or tension differs from those of all earlier ones."""
        if self._rests.is_new(rest):
            self._rests.add(rest)

    def use_isolated(self, isolated: Iterable[int]) -> None:
        """Forget all messages if some lack the values of a muscle that is used from now on.

        `isolated` are the muscles that are isolated from now on.
        """
        if self._missing - frozenset(isolated):
            self.clear()

    def forget_newest(self, seconds: float) -> None:
        """Forget the messages of the last `seconds` in which the arm was considered healthy."""
        self._kept = [row for row in self._kept if row[-1] <= self.time - seconds]

    def remove_angles(self, joint: int, seconds: float) -> None:
        """Remove θ of a joint from the messages of the last `seconds`."""
        place = 3 * self._muscles + joint
        for row in self._kept:
            if row[-1] > self.time - seconds:
                row[place] = np.nan

    def clear(self) -> None:
        """Clear all messages and rests, for example after the body has changed."""
        self._missing = frozenset()
        self._kept.clear()
        self._offered, self._since, self.time = 0, 0.0, 0.0
        self._rests.clear()

    def healthy(self) -> Healthy:
        """Return the healthy messages that were kept, with healthy time and number of rests."""
        m, count = self._muscles, len(self._rests)
        if not self._kept:
            return Healthy(np.empty((0, 3 * m), np.float32), self.time, count)
        rows = np.array(self._kept)
        columns = np.split(rows.astype(float), [m, 2 * m, 3 * m, -2, -1], axis=1)
        tension, length, direction, theta, number, time = columns
        age = self._rests.accepted - number[:, 0]
        recent = (time[:, 0] > self.time - RECENT_TIME) & (age < RECENT_RESTS)
        # Exclude tensions of 0 N, which mean that the muscle was isolated or slack.
        pulls = tension != 0.0 if self._of_currents else tension > 0.0
        whole = recent & np.isfinite(theta).all(axis=1) & pulls.all(axis=1)
        known = np.ones(tension.shape, dtype=bool)
        observed = Observations(theta, tension, length, direction, known, age=age)
        place, second = np.flatnonzero(whole), np.arange(len(rows))[whole] % 2
        parts = observed[place[second == 0]], observed[place[second == 1]]
        return Healthy(rows[:, : 3 * m], self.time, count, *parts)


def recalibrated(mae: Mae, before: AnomalyStatistics | None, healthy: Healthy, samples: int) -> Mae:
    """Return a recalibrated network: with statistics of its residuals on healthy messages.

    Calibrated statistics are not replaced by uncalibrated ones. After a restart, the statistics of
    the saved network therefore stay in use until there are enough messages.

    Args:
        mae: The network.
        before: Statistics of the preceding network; None if it had none.
        healthy: Messages of the healthy arm.
        samples: Number of samples that the network has learned.
    """
    statistics = calibrate(mae, healthy, samples)
    keep = before is not None and before.calibrated
    if statistics is None or (keep and not statistics.calibrated):
        statistics = before
    return replace(mae, anomaly=statistics)


def uncalibrated(mae: Mae) -> Mae:
    """Return the network with its statistics marked as uncalibrated."""
    if mae.anomaly is None:
        return mae
    return replace(mae, anomaly=replace(mae.anomaly, calibrated=False))


def is_learned(mae: Mae) -> bool:
    """Return whether a network has learned from an arm, not only from its geometric model."""
    return mae.covariance is not None or mae.is_calibrated


def calibrate(mae: Mae, healthy: Healthy, samples: int) -> AnomalyStatistics | None:
    """Calibrate on healthy messages: return statistics of residuals, None below two messages."""
    if len(healthy.messages) < 2:
        return None
    tension, length, direction = np.split(healthy.messages.astype(float), 3, axis=1)
    tension = mae.transmission.end(tension, direction)
    state = mae.estimate(tension, length)
    error = residuals(state, tension, length, mae.isolated)
    sound = ~_glitches(error)
    known = min(samples, healthy.rests)
    calibrated = bool(healthy.time >= LEAST_TIME) and known >= LEAST_SAMPLES
    # Split the messages before glitches are excluded. Otherwise a single glitch would move all
    # later messages to the other half.
    first = np.arange(len(error)) % 2 == 0
    part = _statistics(error[sound & first], calibrated)
    statistics = _statistics(error[sound], calibrated)
    largest = max(
        part.distances(error[sound & ~first]).max(initial=0.0),
        statistics.distances(error[sound]).max(),
    )
    margin = MARGIN * (1.0 + FEW_SAMPLES / max(known, 1))
    thresholds = {
        DISTANCE: float(margin * largest),
        NORM: float(margin * anomaly(error[sound]).max()),
    }
    return replace(
        statistics, thresholds=thresholds, postures=_spread_out(state.theta[sound], POSTURES)
    )


def _spread_out(theta: Array, count: int) -> Array:
    """Return at most `count` rows of θ (N, D), each the farthest from all rows chosen before it."""
    share = theta / (np.ptp(theta, axis=0) + 1e-9)
    distance, chosen = np.full(len(theta), np.inf), [0]
    for _ in range(min(count, len(theta)) - 1):
        away = share - share[chosen[-1]]
        distance = np.minimum(distance, np.einsum('nd,nd->n', away, away))
        chosen.append(int(distance.argmax()))
    return theta[chosen]


def _glitches(error: Array) -> Bools:
    few = int(GLITCH_SHARE * len(error))
    if few == 0:
        return np.zeros(len(error), dtype=bool)
    # Compute the statistics without the most extreme messages, ranked by robust deviation, so that
    # glitches do not affect them.
    middle = np.median(error, axis=0)
    spread = np.median(np.abs(error - middle), axis=0) + FLOOR
    order = np.argsort((np.abs(error - middle) / spread).max(axis=1))
    distance = _statistics(error[order[:-few]]).distances(error)
    return np.greater(distance, GLITCH_RATIO * np.sort(distance)[-few - 1])


def _statistics(error: Array, calibrated: bool = False) -> AnomalyStatistics:
    statistics = AnomalyStatistics.of(error, calibrated)
    covariance = statistics.covariance
    mixed = (1.0 - DIAGONAL_SHARE) * covariance + DIAGONAL_SHARE * np.diag(np.diag(covariance))
    return replace(statistics, covariance=mixed)
