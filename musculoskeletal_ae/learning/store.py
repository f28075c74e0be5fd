# SPDX-License-Identifier: Apache-2.0
"""A budgeted store of samples that keeps coverage.

A sample is new when θ or T differs from every stored one by more than a threshold (paper, section
"Online Learning"). When the store is full, one of the two samples nearest to each other goes, the
older one, so that what remains is spread over the postures and tensions ever seen, and the newest
always stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.body_fit import Observations
from musculoskeletal_ae.learning.sample import Sample

CAPACITY = 400


@dataclass(frozen=True)
class Novelty:
    """By how much a sample has to differ from every stored one.

    Attributes:
        joint: In one joint [rad].
        tension: In one muscle [N].
    """

    joint: float = 0.05
    tension: float = 10.0


class SampleStore:
    """Samples in the order in which they came, at most `capacity`.

    Attributes:
        samples: The oldest first.
        known: For each sample the muscles that it says something about, shape (M,).
        accepted: How many were ever accepted.
    """

    def __init__(self, novelty: Novelty | None = None, capacity: int = CAPACITY) -> None:
        """Start empty."""
        self.novelty = novelty or Novelty()
        self.capacity = capacity
        self.samples: list[Sample] = []
        self.known: list[NDArray[np.bool_]] = []
        self.accepted = 0

    def __len__(self) -> int:
        """Samples stored."""
        return len(self.samples)

    def is_new(self, sample: Sample) -> bool:
        """Whether a sample differs enough from every stored one."""
        return not self.samples or bool(self._distances(sample).min() > 1.0)

    def add(self, sample: Sample, known: NDArray[np.bool_] | None = None) -> None:
        """Store a sample, as the newest."""
        self.samples.append(sample)
        self.known.append(np.ones(len(sample.tension), dtype=bool) if known is None else known)
        self.accepted += 1
        if len(self.samples) > self.capacity:
            worst = self._dispensable()
            del self.samples[worst], self.known[worst]

    def forget(self, muscle: int, newest: int = 0) -> None:
        """Let all samples but the newest ones say nothing about a muscle any more."""
        for known in self.known[: len(self.known) - newest]:
            known[muscle] = False

    def clear(self) -> None:
        """Forget all samples."""
        self.samples.clear()
        self.known.clear()
        self.accepted = 0

    def observations(self) -> Observations:
        """Return all samples as arrays."""
        theta, tension, length, sliding = map(np.array, zip(*self.samples, strict=True))
        return Observations(theta, tension, length, sliding, np.array(self.known))

    def _scaled(self, sample: Sample) -> Array:
        return np.concatenate(
            [sample.theta / self.novelty.joint, sample.tension / self.novelty.tension]
        )

    def _distances(self, sample: Sample) -> Array:
        stored = np.array([self._scaled(s) for s in self.samples])
        return np.abs(stored - self._scaled(sample)).max(axis=1)

    def _dispensable(self) -> int:
        points = np.array([self._scaled(s) for s in self.samples])
        square = np.sum(points**2, axis=1)
        distance = square[:, None] + square - 2.0 * points @ points.T
        distance[np.diag_indices_from(distance)] = np.inf
        # A sample that says nothing about some muscle any more goes before one that does.
        lost = 1.0 - np.array(self.known).mean(axis=1)
        distance /= 1.0 + lost[:, None] + lost
        return int(min(np.unravel_index(np.argmin(distance), distance.shape)))
