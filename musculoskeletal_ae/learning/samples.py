# SPDX-License-Identifier: Apache-2.0
"""Rest samples, and the store that keeps them.

A rest sample is the mean of θ, T and l over the messages of a rest: a time in which the arm does
not move (`rest`), the length offsets are known, and no anomaly is detected shortly before or after
(`anomaly_margin`). Only new samples are kept (`collector`). A sample is new when θ or T differs
from every stored one by more than a threshold (paper, §III-C). When the store is full, it drops the
older of the two samples that are nearest to each other. The remaining samples then cover all
postures and tensions so far, and the newest sample always stays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.body_model.observations import NOTHING, Observations, Sample

CAPACITY = 400  # keep at most this many samples by default, and drop the most similar ones
#: Estimate tendon creep once the number of accepted samples exceeds this share of the capacity, and
#: this share of the samples has all joint angles.
CREEP_SHARE = 0.5
#: divide lengths by this typical moment arm to compare them with angles, where not all joint angles
#: were measured [m]
MOMENT_ARM = 0.04
JOINT_DISTANCE = 0.05  # keep a sample if an angle differs from every stored one by more [rad]
TENSION_DISTANCE = 10.0  # keep a sample if a tension differs from every stored one by more [N]


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
        held_offset: These length offsets [m], (M,).
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        """Create an empty store for at most `capacity` samples."""
        self.capacity, self.accepted = capacity, 0
        self.stored: list[StoredSample] = []
        self.held: list[StoredSample] = []
        self.held_offset: Array = NOTHING

    def __len__(self) -> int:
        return len(self.stored)

    @property
    def samples(self) -> list[Sample]:
        """The samples from which the learner learns, the oldest first."""
        return [each.sample for each in self.stored]

    def is_new(self, sample: Sample) -> bool:
        """Return whether a sample is new: an angle or tension differs from every stored sample.

        The thresholds are JOINT_DISTANCE and TENSION_DISTANCE.
        """
        points = self._scaled([*self.samples, sample])
        return bool((np.nanmax(np.abs(points[:-1] - points[-1]), axis=1) > 1.0).all())

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

    def all(self) -> list[Sample]:
        """Return all samples, including the held ones."""
        return [each.sample for each in (*self.stored, *self.held)]

    def forget(self, muscle: int, newest: int = 0) -> None:
        """Forget what all but the last `newest` samples say about a muscle."""
        for each in (*self.stored[: len(self.stored) - newest], *self.held):
            each.known[muscle] = False

    def hold(self, since: float, now: float, offset: Array) -> None:
        """Hold back the samples of some time until it is known whether they are correct.

        Args:
            since: Beginning of this time [s].
            now: End of this time [s].
            offset: Length offsets under which they were taken [m], (M,).
        """
        self.held += [each for each in self.stored if since <= each.time <= now]
        self.stored = [each for each in self.stored if not since <= each.time <= now]
        self.held_offset = offset

    def put_back_held(self) -> None:
        """Put back the held samples at their original positions."""
        self.stored = sorted([*self.stored, *self.held], key=attrgetter('number'))
        self.held = []

    def drop_held(self) -> int:
        """Drop the held samples; return their number."""
        count, self.held = len(self.held), []
        return count

    def remove_angles(self, joint: int, since: float) -> dict[int, float]:
        """Remove θ of a joint from the samples accepted at `since` [s] or later.

        Returns:
            The removed angles [rad] by number of the sample.
        """
        recent = {
            each.number: float(each.sample.theta[joint])
            for each in self.stored
            if each.time >= since
        }
        removed = {number: angle for number, angle in recent.items() if np.isfinite(angle)}
        self.set_angles(joint, dict.fromkeys(removed, np.nan))
        return removed

    def set_angles(self, joint: int, angles: Mapping[int, float]) -> None:
        """Set θ of a joint [rad] in some samples, by number."""
        for place, each in enumerate(self.stored):
            if each.number in angles:
                theta = each.sample.theta.copy()
                theta[joint] = angles[each.number]
                self.stored[place] = each._replace(sample=each.sample._replace(theta=theta))

    def lengthen(self, by: Array, first: int) -> int:
        """Add `by` [m] (M,) to the lengths of all samples with number `first` or above.

        Lengths of muscles that were isolated in a sample are not changed.

        Returns:
            The number of changed samples.
        """
        count = 0
        for place, each in enumerate(self.stored):
            if each.number >= first:
                used = ~np.isin(np.arange(len(by)), each.sample.isolated)
                longer = each.sample._replace(length=each.sample.length + by * used)
                self.stored[place] = each._replace(sample=longer)
                count += 1
        return count

    def clear(self) -> None:
        """Clear all samples."""
        self.stored, self.held, self.accepted = [], [], 0

    def observations(self) -> Observations:
        """Return all samples as arrays, except those that are held back."""
        columns = [*zip(*self.samples, strict=True)]
        theta, tension, length, direction = map(np.array, columns[:4])
        spread, gravity = _filled(columns[4], 0.0), _filled(columns[5], np.nan)
        known = np.array([each.known for each in self.stored])
        age = self.stored[-1].number - np.array([each.number for each in self.stored], float)
        # Do not estimate creep without joint angles, because a drift of the estimated postures
        # would look like creep.
        read = np.isfinite(theta).all(axis=1).mean()
        if self.accepted <= CREEP_SHARE * self.capacity or read < CREEP_SHARE:
            age[:] = 0.0
        return Observations(theta, tension, length, direction, known, spread, gravity, age)

    def _scaled(self, samples: Sequence[Sample]) -> Array:
        """Return samples as points (N, D + 2 M) in units of the thresholds.

        The coordinates are θ, T and l. Samples with all joint angles are compared without l, and
        samples without some angle also by l. Coordinates that are unmeasured or not compared are
        NaN.
        """
        theta, tension, length = (np.array(part) for part in [*zip(*samples, strict=True)][:3])
        unread = np.isnan(theta).any(axis=1, keepdims=True)
        # Where not all joint angles were measured, compare samples by muscle lengths as well.
        by_length = np.where(unread, length / (MOMENT_ARM * JOINT_DISTANCE), np.nan)
        by_angle, by_tension = theta / JOINT_DISTANCE, tension / TENSION_DISTANCE
        return np.concatenate([by_angle, by_tension, by_length], axis=1)

    def _dispensable(self) -> int:
        points = np.nan_to_num(self._scaled(self.samples))
        square = np.sum(points**2, axis=1)
        distance = square[:, None] + square - 2.0 * points @ points.T
        distance[np.diag_indices_from(distance)] = np.inf
        # Prefer to drop samples that no longer describe all muscles.
        lost = 1.0 - np.array([each.known for each in self.stored]).mean(axis=1)
        distance /= 1.0 + lost[:, None] + lost
        return int(min(np.unravel_index(np.argmin(distance), distance.shape)))


def _filled(parts: Sequence[Array], nothing: float) -> Array:
    """Stack arrays, of which all have the same size or are empty, as the rows of one array.

    The row of an empty array is filled with the value `nothing`.
    """
    size = max(part.size for part in parts)
    return np.array([part if part.size else np.full(size, nothing) for part in parts])
