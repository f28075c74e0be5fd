# SPDX-License-Identifier: Apache-2.0
"""Rest samples, and the store that keeps them.

A rest sample is the mean of θ, T and l over the messages of a rest: a time in which the arm does
not move (`rest`), the length offsets are known, and no anomaly is detected shortly before or after
(`anomaly_margin`). Only new samples are kept (`collector`). A sample is new when θ or T differs
from every stored one by more than a threshold (paper, §III-C). Two samples of which one lacks an
angle are compared by l as well (`SampleStore.is_new`). When the store is full, it drops the
older of the two samples that are nearest to each other. The remaining samples then cover all
postures and tensions so far, and the newest sample always stays.

The estimator finds a fault some time after it has begun. The samples of this time are therefore
treated as doubtful when the finding arrives. All older samples stay as they are.

**Length offsets.** A finding may revoke the offsets, because lengths have jumped or disagree with
the joint sensors. The samples of the last seconds are held back until the next length calibration:

    same offsets         the finding was false, so the samples are used again
    other offsets        the samples are dropped, because it is unknown which of them are wrong

**Joint sensors.** If the estimator doubts a sensor, the samples since the beginning of the doubt
(`signals/joint_trust_message.py`) lose the angle of this joint. They keep tensions, lengths and the
other angles. What happens next depends on the estimator:

    trusted again        the sensor was false in the meantime, so these angles stay unknown
    confirmed by user    the doubt was wrong, so the samples get their angles back
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.body_model.observations import NOTHING, Observations, Sample
from musculoskeletal_ae.signals.joint_trust_message import JointTrust, SensorTrust

CAPACITY = 400  # keep at most this many samples by default, and drop the most similar ones
#: Estimate tendon creep once the number of accepted samples exceeds this share of the capacity, and
#: this share of the samples has all joint angles.
CREEP_SHARE = 0.5
#: divide lengths by this typical moment arm to compare them with angles, where a sample lacks an
#: angle [m]
MOMENT_ARM = 0.04
JOINT_DISTANCE = 0.05  # keep a sample if an angle differs from every stored one by more [rad]
TENSION_DISTANCE = 10.0  # keep a sample if a tension differs from every stored one by more [N]
#: conclude that length offsets have changed only if two calibrations differ by more than this [m]
CALIBRATION_SPREAD = 0.008
#: hold back samples taken up to this long before length offsets were revoked [s], because the
#: offsets may already have been wrong
HELD_TIME = 5.0


class StoredSample(NamedTuple):
    """A sample with its number in the order of acceptance, and the muscles that it describes."""

    sample: Sample
    known: Bools  # whether the sample describes each muscle, (M,)
    number: int  # position among all samples ever accepted, from 1
    #: when it was accepted [s]; NaN if that is unknown, as after a restart
    time: float = math.nan


class SampleStore:
    """Keeps up to `capacity` samples in the order in which they were accepted.

    Attributes:
        stored: The samples from which the learner learns, the oldest first.
        accepted: Number of samples ever accepted.
        held: Samples that are held back because their length offsets are in doubt.
        offset: Length offsets under which the newest samples were taken [m], (M,).
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        """Create an empty store for at most `capacity` samples."""
        self.capacity, self.accepted = capacity, 0
        self.stored: list[StoredSample] = []
        self.held: list[StoredSample] = []
        self.offset: Array = NOTHING
        #: angles that were removed [rad], by number of the sample, for each unused joint
        self._removed: dict[int, dict[int, float]] = {}

    def __len__(self) -> int:
        return len(self.stored)

    @property
    def samples(self) -> list[Sample]:
        """The samples from which the learner learns, the oldest first."""
        return [each.sample for each in self.stored]

    def is_new(self, sample: Sample) -> bool:
        """Return whether a sample is new: it differs from every stored sample.

        Two samples differ if an angle or a tension does. The thresholds are JOINT_DISTANCE and
        TENSION_DISTANCE. If one of the two lacks an angle, a length may differ instead. A sample
        also differs from one that lacks an angle which it has itself.
        """
        points = _Points.of([*self.samples, sample])
        differs = (np.abs(points.differences(-1)) > 1.0).any(axis=1)
        adds_angle = (np.isnan(points.theta) & np.isfinite(points.theta[-1])).any(axis=1)
        return bool((differs | adds_angle)[:-1].all())

    def add(
        self,
        sample: Sample,
        known: Bools | None = None,
        number: int | None = None,
        time: float = math.nan,
    ) -> None:
        """Add a sample as the newest one.

        Args:
            sample: The sample.
            known: Whether the sample describes each muscle, (M,); by default, it describes all.
            number: Number of a sample that is restored from disk; by default the next number.
            time: Time at which it is accepted [s].
        """
        self.accepted = number or self.accepted + 1
        described = np.ones(len(sample.tension), dtype=bool) if known is None else known
        self.stored.append(StoredSample(sample, described, self.accepted, time))
        if len(self.stored) > self.capacity:
            del self.stored[self._dispensable()]

    def forget(self, muscle: int, before: float = math.inf) -> None:
        """Forget what the samples with numbers below `before` say about a muscle."""
        for each in (*self.stored, *self.held):
            if each.number < before:
                each.known[muscle] = False

    def hold(self, now: float) -> None:
        """Hold back the samples of the last `HELD_TIME`, because offsets were revoked at `now` [s].

        `use_offset` later puts them back or drops them.
        """
        since = now - HELD_TIME
        self.held += [each for each in self.stored if since <= each.time <= now]
        self.stored = [each for each in self.stored if not since <= each.time <= now]

    def use_offset(self, offset: Array) -> int:
        """Use known length offsets [m] (M,) from now on; return the number of dropped samples.

        If they equal the previous offsets, samples that were held back are put back at their
        original positions. Otherwise they are dropped.
        """
        # The previous offset is NaN for a muscle that was added at a restart.
        change = np.nan_to_num(np.abs(offset - self.offset)).max()
        held, self.held, self.offset = self.held, [], offset
        if change > CALIBRATION_SPREAD:
            return len(held)
        self.stored = sorted([*self.stored, *held], key=attrgetter('number'))
        return 0

    def use_trust(self, before: JointTrust, trust: JointTrust) -> tuple[int, ...]:
        """Use another trust in the joint sensors: remove angles, or put them back.

        Args:
            before: The previous trust.
            trust: The trust from now on, with times on the clock of the samples.

        Returns:
            Indices of the joints whose sensors are not used from now on.
        """
        unused = tuple(j for j in trust.unused if before.is_used[j])
        for j in unused:
            self._removed[j] = self._remove_angles(j, trust.since[j])
        for j in [j for j in self._removed if trust.is_used[j]]:
            removed = self._removed.pop(j)
            if trust.trust[j] is SensorTrust.CONFIRMED and before.trust[j] is SensorTrust.DOUBTED:
                self._set_angles(j, removed)
        return unused

    def _remove_angles(self, joint: int, since: float) -> dict[int, float]:
        """Remove θ of a joint from the samples accepted at `since` [s] or later.

        Returns:
            The removed angles [rad] by number of the sample.
        """
        recent = {
            each.number: float(each.sample.theta[joint])
            for each in (*self.stored, *self.held)
            if each.time >= since
        }
        removed = {number: angle for number, angle in recent.items() if np.isfinite(angle)}
        self._set_angles(joint, dict.fromkeys(removed, np.nan))
        return removed

    def _set_angles(self, joint: int, angles: Mapping[int, float]) -> None:
        """Set θ of a joint [rad] in some samples, by number."""
        for samples in (self.stored, self.held):
            for place, each in enumerate(samples):
                if each.number in angles:
                    theta = each.sample.theta.copy()
                    theta[joint] = angles[each.number]
                    samples[place] = each._replace(sample=each.sample._replace(theta=theta))

    def clear(self) -> None:
        """Clear all samples, after which their numbers begin at 1 again."""
        self.stored, self.held, self.accepted = [], [], 0
        self._removed.clear()

    def observations(self) -> Observations:
        """Return all samples as arrays, except those that are held back."""
        columns = [*zip(*self.samples, strict=True)]
        theta, tension, length, direction = map(np.array, columns[:4])
        spread, gravity = _filled(columns[4], 0.0), _filled(columns[5], np.nan)
        known = np.array([each.known for each in self.stored])
        number = np.array([each.number for each in self.stored])
        age = (number[-1] - number).astype(float)
        # Do not estimate creep without joint angles, because a drift of the estimated postures
        # would look like creep.
        read = np.isfinite(theta).all(axis=1).mean()
        if self.accepted <= CREEP_SHARE * self.capacity or read < CREEP_SHARE:
            age[:] = 0.0
        return Observations(theta, tension, length, direction, known, spread, gravity, age, number)

    def _dispensable(self) -> int:
        """Return the index of the older one of the two most similar samples."""
        distance = _Points.of(self.samples).squared_distances()
        distance[np.diag_indices_from(distance)] = np.inf
        # Prefer to drop samples that no longer describe all muscles.
        lost = 1.0 - np.array([each.known for each in self.stored]).mean(axis=1)
        distance /= 1.0 + lost[:, None] + lost
        return int(min(np.unravel_index(np.argmin(distance), distance.shape)))


class _Points(NamedTuple):
    """Samples as points, in units of the distances from which on two samples differ."""

    theta: Array  # (N, D); NaN where it was not measured
    tension: Array  # (N, M)
    length: Array  # (N, M)

    @classmethod
    def of(cls, samples: Sequence[Sample]) -> _Points:
        """Return the points of some samples."""
        theta, tension, length = (np.array(part) for part in [*zip(*samples, strict=True)][:3])
        unit = MOMENT_ARM * JOINT_DISTANCE
        return cls(theta / JOINT_DISTANCE, tension / TENSION_DISTANCE, length / unit)

    @property
    def is_complete(self) -> Bools:
        """Whether all angles of each sample were measured, (N,)."""
        return np.asarray(np.isfinite(self.theta).all(axis=1))

    def differences(self, place: int) -> Array:
        """Return how θ, T and l of all samples differ from those of one, (N, D + 2 M).

        They are NaN where they are not compared: angles that one of both samples lacks, and the
        lengths of two samples that have all angles.
        """
        theta, tension, length = (part - part[place] for part in self)
        complete = self.is_complete
        length[complete & complete[place]] = np.nan
        return np.concatenate([theta, tension, length], axis=1)

    def squared_distances(self) -> Array:
        """Return the squared distances between all samples, (N, N)."""
        # Compare all samples that have all angles at once, because that is much faster.
        parts = self.theta, self.tension, np.zeros_like(self.length)
        points = np.nan_to_num(np.concatenate(parts, axis=1))
        square = np.sum(points**2, axis=1)
        distance: Array = square[:, None] + square - 2.0 * points @ points.T
        for place in np.flatnonzero(~self.is_complete):
            to_others = np.nansum(self.differences(int(place)) ** 2, axis=1)
            distance[place] = distance[:, place] = to_others
        return distance


def _filled(parts: Sequence[Array], nothing: float) -> Array:
    """Stack arrays, of which all have the same size or are empty, as the rows of one array.

    The row of an empty array is filled with the value `nothing`.
    """
    size = max(part.size for part in parts)
    return np.array([part if part.size else np.full(size, nothing) for part in parts])
