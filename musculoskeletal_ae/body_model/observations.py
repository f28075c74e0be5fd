# SPDX-License-Identifier: Apache-2.0
"""Samples of an arm, to which a body is fitted: `Sample` is one of them, `Observations` are many.

A sample is the mean of θ, T and l over the messages of a rest. `learning/samples.py` says which
samples are kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.signals.friction import Transmission

NOTHING: Array = np.zeros(0)  # use this empty array for a quantity that was not measured


class Sample(NamedTuple):
    """One sample: the means of the measurements over a time in which the arm rested."""

    theta: Array  # θ [rad], (D,); NaN where it was not measured
    tension: Array  # T [N], (M,)
    length: Array  # l [m], (M,)
    direction: Array  # direction s of the last sliding: +1 wound in, −1 paid out, (M,)
    #: standard deviation of each θ [rad], (D,); 0 or empty if a joint sensor measured θ
    spread: Array = NOTHING
    #: direction of gravity in the frames of the tree's joints, (3J,); NaN or empty without an IMU
    gravity: Array = NOTHING


@dataclass(frozen=True)
class Observations:
    """N samples as arrays, the oldest first."""

    theta: Array  # θ [rad], (N, D); NaN where it was not measured
    tension: Array  # motor-side tension T [N], (N, M)
    length: Array  # l [m], (N, M)
    direction: Array  # s in [−1, 1], (N, M)
    known: Bools  # whether each sample describes each muscle, (N, M)
    spread: Array = field(default_factory=lambda: NOTHING)  # see `Sample`, (N, D)
    #: see `Sample`, (N, 3J); (N, 0) without an IMU
    gravity: Array = field(default_factory=lambda: NOTHING)
    #: number of samples that came after each one, (N,); 0 where creep cannot be estimated
    age: Array = field(default_factory=lambda: NOTHING)
    #: number of each sample in the order of acceptance (`StoredSample`), (N,)
    number: Ints = field(default_factory=lambda: np.zeros(0, dtype=int))

    def __post_init__(self) -> None:
        """Replace empty arrays by defaults."""
        if self.spread.size == 0:
            object.__setattr__(self, 'spread', np.zeros_like(self.theta))
        if self.gravity.size == 0:
            object.__setattr__(self, 'gravity', np.zeros((len(self.theta), 0)))
        if self.age.size == 0:
            object.__setattr__(self, 'age', np.zeros(len(self.theta)))
        if self.number.size == 0:
            object.__setattr__(self, 'number', 1 + np.arange(len(self.theta)))

    def __len__(self) -> int:
        return len(self.theta)

    def __getitem__(self, rows: slice | Ints) -> Observations:
        return Observations(*(values[rows] for values in vars(self).values()))

    def limb(self, joints: Ints, muscles: Ints) -> Observations:
        """Return the observations of one group of joints and muscles."""
        return replace(
            self,
            theta=self.theta[:, joints],
            spread=self.spread[:, joints],
            tension=self.tension[:, muscles],
            length=self.length[:, muscles],
            direction=self.direction[:, muscles],
            known=self.known[:, muscles],
        )

    def state(self) -> State:
        """Return the state (θ, T, l) of each sample, with motor-side tensions."""
        return State(self.theta, self.tension, self.length)

    def end_tension(self, transmission: Transmission) -> Array:
        """Return the bone-side tensions T_end [N], (N, M), which are the input of a network.

        Args:
            transmission: Converts tension readings to bone-side tensions.
        """
        return transmission.end(self.tension, self.direction)

    def with_all_angles(self) -> Observations:
        """Return the samples in which all joint angles were measured."""
        return self[np.flatnonzero(np.isfinite(self.theta).all(axis=1))]
