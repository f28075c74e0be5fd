# SPDX-License-Identifier: Apache-2.0
"""What one call of `experiment` measures, what an experiment is, and what its parts hand on.

An individual's sensor streams and learned networks are made once (`online_learning`) and kept in a
folder; the other experiments read them there, each in its own process if cores allow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.experiments.plots import Plot
from musculoskeletal_ae.experiments.recording import Recording
from musculoskeletal_ae.learning.settings import STEPS
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

HEALTHY_HOUR = 3600.0  # [s] of motion for false alarms, over all individuals

Stream = Literal['exploring', 'held_out']
#: told which share of an experiment's work has been done since it was told last
Progress = Callable[[float], None]


class Rests(NamedTuple):
    """The samples at rest that a learner stored: θ [rad] (N, D), T [N] (N, M), l [m] (N, M)."""

    theta: Array
    tension: Array
    length: Array


@dataclass(frozen=True)
class Study:
    """Options of one call.

    Attributes:
        robot: Name or directory.
        preset: Of the networks that are shown as `before` and `after`.
        seeds: Individuals.
        minutes: Duration of the exploration.
        quick: A fraction of everything, to try things out.
        folder: Where streams and networks are kept.
    """

    robot: str
    preset: str
    seeds: tuple[int, ...]
    minutes: float
    quick: bool
    folder: Path

    @property
    def held_out_time(self) -> float:
        """Duration of the motion never used for learning [s]."""
        return 20.0 if self.quick else 300.0

    @property
    def healthy_time(self) -> float:
        """Healthy motion of each individual [s]; an hour in all."""
        return 20.0 if self.quick else HEALTHY_HOUR / len(self.seeds)

    @property
    def initial_steps(self) -> int | None:
        """Mini-batches of initial training; None for the preset's own number."""
        return 300 if self.quick else None

    @property
    def update_steps(self) -> int:
        """Training steps of one online update."""
        return STEPS // 5 if self.quick else STEPS

    @property
    def approaches(self) -> int:
        """How many θ_eval, and how many starts for each."""
        return 1 if self.quick else 5

    def body(self) -> Robot:
        """Return the geometric model."""
        return Robot.load(self.robot)

    # -- what parts hand each other -------------------------------------------------------------

    def network_file(self, preset: str, seed: int | None) -> Path:
        """Return the file of a network: initial, or learned on an individual."""
        return self.folder / f'{preset}_{"initial" if seed is None else seed}.safetensors'

    def initial(self, robot: Robot, preset: str | None = None) -> Mae:
        """Return the network before any learning."""
        return checkpoint.load(self.network_file(preset or self.preset, None), robot)

    def learned(self, robot: Robot, seed: int, preset: str | None = None) -> Mae:
        """Return the network after exploration by an individual."""
        return checkpoint.load(self.network_file(preset or self.preset, seed), robot)

    def keep_stream(self, seed: int, name: Stream, recording: Recording) -> None:
        """Keep a recording of an individual."""
        np.savez(self.folder / f'{name}_{seed}.npz', *recording)

    def stream(self, seed: int, name: Stream) -> Recording:
        """Return a recording that was kept."""
        with np.load(self.folder / f'{name}_{seed}.npz') as arrays:
            return Recording(*arrays.values())

    def keep_rests(self, seed: int, rests: Rests) -> None:
        """Keep what a learner stored of an individual."""
        np.savez(self.folder / f'rests_{seed}.npz', *rests)

    def rests(self, seed: int) -> Rests:
        """Return what the learner stored."""
        with np.load(self.folder / f'rests_{seed}.npz') as arrays:
            return Rests(*arrays.values())


@dataclass
class Measured:
    """What an experiment says of one individual.

    Attributes:
        numbers: For result.json; nested dictionaries of finite numbers, text or lists.
        traces: Arrays for the plots, by name.
    """

    numbers: dict[str, Any]
    traces: dict[str, Any] = field(default_factory=dict)


class Individuals(NamedTuple):
    """What an experiment says of all individuals, for its plots.

    Attributes:
        study: Which call measured it.
        robot: The geometric model.
        rows: By seed.
    """

    study: Study
    robot: Robot
    rows: Mapping[int, Measured]

    @property
    def first(self) -> tuple[int, Measured]:
        """Seed and measurements of the individual that plots of a single one show."""
        return next(iter(self.rows.items()))

    @property
    def numbers(self) -> list[dict[str, Any]]:
        """Numbers of every individual."""
        return [row.numbers for row in self.rows.values()]


class Experiment(NamedTuple):
    """One experiment: how it is measured on an individual, drawn and explained.

    Attributes:
        description: Its heading in the report and how it is measured: its module's docstring.
        paper: What the paper did and found, on Musashi.
        weight: How long it takes beside the others; for order and progress bar only.
        measure: Returns numbers and traces of the individual of a seed.
        plot: Draws them.
    """

    description: str | None
    paper: str
    weight: float
    measure: Callable[[Study, int, Progress], Measured]
    plot: Callable[[Individuals], list[Plot]]

    @property
    def title(self) -> str:
        """Heading in the report."""
        return (self.description or '').partition('\n')[0].rstrip('.')

    @property
    def here(self) -> str:
        """How it is measured here."""
        return (self.description or '').partition('\n')[2].strip()
