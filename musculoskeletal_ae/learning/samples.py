# SPDX-License-Identifier: Apache-2.0
"""Samples: what the sensors said while the arm was at rest, and which of them are kept.

A sample is new when θ or T differs from every stored one by more than a threshold (paper,
§III-C). When the store is full, one of the two samples nearest to each other goes, the older one,
so that what remains is spread over the postures and tensions ever seen, and the newest always
stays.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.learning.settings import DEFAULT, Settings
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.signals.friction import end_tension

CAPACITY = 400
#: creep of wires is told from this share of a store on, if as many samples come with all angles
CREEPING = 0.5
NOTHING: Array = np.zeros(0)
#: length that counts as a joint angle where none was read, per radian: a usual moment arm [m]
MOMENT_ARM = 0.04
LEAST_DISTANCE = 1e-6  # [rad], [N] that 0 stands for: whatever differs is new


class Sample(NamedTuple):
    """Means over a rest."""

    theta: Array  # θ [rad], (D,); NaN where nothing was read
    tension: Array  # T [N], (M,)
    length: Array  # l [m], (M,)
    direction: Array  # s of every wire's friction: +1 wound in last, −1 paid out last, (M,)
    #: how far each θ may be off [rad], (D,); 0 or nothing: as a joint sensor, but for its zero
    spread: Array = NOTHING
    #: direction of gravity in the frames of the tree's joints, (3J,); NaN or nothing: no IMU there
    gravity: Array = NOTHING
    #: version of the `BodyState` under which it was taken, and the muscles that were isolated then
    body_version: int = 0
    isolated: tuple[int, ...] = ()


class StoredSample(NamedTuple):
    """A sample with what its store knows about it."""

    sample: Sample
    known: Bools  # which muscles it says something about, (M,)
    number: int  # its place among all that were ever accepted, from 1


@dataclass(frozen=True)
class Observations:
    """N samples as arrays."""

    theta: Array  # θ [rad], (N, D); NaN where nothing was read
    tension: Array  # T at the motors [N], (N, M)
    length: Array  # l [m], (N, M)
    direction: Array  # s in [−1, 1], (N, M)
    known: Bools  # which of them say something about which muscle, (N, M)
    spread: Array = field(default_factory=lambda: NOTHING)  # see `Sample`, (N, D)
    #: (N, 3J), or (N, 0): no IMU anywhere
    gravity: Array = field(default_factory=lambda: NOTHING)
    #: how many samples came after each, (N,); 0 where no creep of wires can be told
    age: Array = field(default_factory=lambda: NOTHING)

    def __post_init__(self) -> None:
        """Fill in what was left out."""
        if self.spread.size == 0:
            object.__setattr__(self, 'spread', np.zeros_like(self.theta))
        if self.gravity.size == 0:
            object.__setattr__(self, 'gravity', np.zeros((len(self.theta), 0)))
        if self.age.size == 0:
            object.__setattr__(self, 'age', np.zeros(len(self.theta)))

    def __len__(self) -> int:
        return len(self.theta)

    def __getitem__(self, rows: slice | Ints) -> Observations:
        return Observations(*(values[rows] for values in vars(self).values()))

    def limb(self, joints: Ints, muscles: Ints) -> Observations:
        """Return what they say of the joints and muscles of one group."""
        ours = {'theta': joints, 'spread': joints}
        ours |= dict.fromkeys(('tension', 'length', 'direction', 'known'), muscles)
        return replace(
            self, **{name: getattr(self, name)[:, which] for name, which in ours.items()}
        )

    def state(self) -> State:
        """Return (θ, T, l)."""
        return State(self.theta, self.tension, self.length)

    def end_tension(self, friction: Array) -> Array:
        """Return T at the elastic units [N] (N, M), by μ (M,): what networks take for T."""
        return end_tension(friction, self.tension, self.direction)

    def with_all_angles(self) -> Observations:
        """Return those of which all joint angles are known."""
        return self[np.flatnonzero(np.isfinite(self.theta).all(axis=1))]


class SampleStore:
    """Samples in the order in which they came, at most `capacity`."""

    def __init__(
        self,
        settings: Settings = DEFAULT,
        capacity: int = CAPACITY,
        radian: Array | float = 1.0,
    ) -> None:
        """Start empty; `radian` [rad or m] (D,) is what counts as a radian of each joint."""
        self._settings, self._radian = settings, radian
        self.capacity = capacity
        self.accepted = 0  # ever
        self.clear()

    def __len__(self) -> int:
        return len(self.samples)

    def is_new(self, sample: Sample) -> bool:
        """Whether a sample differs enough from every stored one."""
        points = self._scaled([*self.samples, sample])
        return bool((np.nanmax(np.abs(points[:-1] - points[-1]), axis=1) > 1.0).all())

    def add(self, sample: Sample, known: Bools | None = None, number: int | None = None) -> None:
        """Store a sample, as the newest; `known` and `number` are given to one stored before."""
        self.accepted = number or self.accepted + 1
        self.samples.append(sample)
        self.known.append(np.ones(len(sample.tension), dtype=bool) if known is None else known)
        self.numbers.append(self.accepted)
        if len(self.samples) > self.capacity:
            worst = self._dispensable()
            del self.samples[worst], self.known[worst], self.numbers[worst]

    def forget(self, muscle: int, newest: int = 0) -> None:
        """Let all samples but the newest ones say nothing about a muscle any more."""
        for known in self.known[: len(self.known) - newest]:
            known[muscle] = False

    def take_out(self, numbers: Set[int]) -> list[StoredSample]:
        """Remove the samples of these numbers; return them."""
        stored = [*map(StoredSample, self.samples, self.known, self.numbers)]
        for place in reversed(range(len(stored))):
            if stored[place].number in numbers:
                del self.samples[place], self.known[place], self.numbers[place]
        return [each for each in stored if each.number in numbers]

    def put_back(self, stored: Iterable[StoredSample]) -> None:
        """Add samples that were taken out, each at its place."""
        for each in stored:
            place = bisect(self.numbers, each.number)
            self.samples.insert(place, each.sample)
            self.known.insert(place, each.known)
            self.numbers.insert(place, each.number)

    def lengthen(self, by: Array, first: int) -> int:
        """Let the lengths of samples from a number on be more by so much [m] (M,); say how many."""
        places = [i for i, number in enumerate(self.numbers) if number >= first]
        for i in places:
            sample = self.samples[i]
            used = ~np.isin(np.arange(len(by)), sample.isolated)
            self.samples[i] = sample._replace(length=sample.length + by * used)
        return len(places)

    @property
    def body_version(self) -> int:
        """The newest version of the body state that a stored sample was taken under."""
        return max((sample.body_version for sample in self.samples), default=0)

    def clear(self) -> None:
        """Forget all samples."""
        self.samples: list[Sample] = []  # the oldest first
        self.known: list[Bools] = []  # the muscles that each says something about, (M,)
        self.numbers: list[int] = []  # each one's place among all ever accepted, from 1
        self.accepted = 0

    def observations(self) -> Observations:
        """Return all samples as arrays."""
        columns = [*zip(*self.samples, strict=True)]
        theta, tension, length, direction = map(np.array, columns[:4])
        spread, gravity = _filled(columns[4], 0.0), _filled(columns[5], np.nan)
        known, age = np.array(self.known), self.numbers[-1] - np.array(self.numbers, float)
        # Without angles, wires that creep look like postures that drift.
        read = np.isfinite(theta).all(axis=1).mean()
        if self.accepted <= CREEPING * self.capacity or read < CREEPING:
            age[:] = 0.0
        return Observations(theta, tension, length, direction, known, spread, gravity, age)

    def _scaled(self, samples: Sequence[Sample]) -> Array:
        """Return samples as points (N, D + 2 M), NaN where something does not count."""
        theta, tension, length = (np.array(part) for part in [*zip(*samples, strict=True)][:3])
        distances = self._settings.new_joint_distance, self._settings.new_tension_distance
        joint, pull = (max(distance, LEAST_DISTANCE) for distance in distances)
        unread = np.isnan(theta).any(axis=1, keepdims=True)
        # Of a posture that was not read the lengths tell whether it is another one.
        told = np.where(unread, length / (MOMENT_ARM * joint), np.nan)
        return np.concatenate([theta / (joint * self._radian), tension / pull, told], axis=1)

    def _dispensable(self) -> int:
        points = np.nan_to_num(self._scaled(self.samples))
        square = np.sum(points**2, axis=1)
        distance = square[:, None] + square - 2.0 * points @ points.T
        distance[np.diag_indices_from(distance)] = np.inf
        # A sample that says nothing about some muscle any more goes before one that does.
        lost = 1.0 - np.array(self.known).mean(axis=1)
        distance /= 1.0 + lost[:, None] + lost
        return int(min(np.unravel_index(np.argmin(distance), distance.shape)))


def _filled(parts: Sequence[Array], nothing: float) -> Array:
    """Return parts of equal size, or of none, as one array."""
    size = max(part.size for part in parts)
    return np.array([part if part.size else np.full(size, nothing) for part in parts])
