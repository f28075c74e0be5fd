# SPDX-License-Identifier: Apache-2.0
"""What one call of `experiment` measures, and where its parts hand each other data.

An individual's sensor streams and learnt networks are made once (`suite.learning`) and kept in a
folder; the experiments read them there, each in its own process if cores allow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from musculoskeletal_ae.experiments.recording import Recording
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

#: told which share of an experiment's work has been done since it was told last
Progress = Callable[[float], None]

HEALTHY_HOUR = 3600.0  # [s] of motion for false alarms, over all individuals


@dataclass(frozen=True)
class Study:
    """Options of one call.

    Attributes:
        robot: Name or directory.
        preset: Of the networks that are shown as `before` and `after`.
        seeds: Individuals.
        minutes: Of exploration.
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
        from musculoskeletal_ae.learning.learner import STEPS

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
        """Return the file of a network: initial, or learnt on an individual."""
        return self.folder / f'{preset}_{"initial" if seed is None else seed}.safetensors'

    def initial(self, robot: Robot, preset: str | None = None) -> Mae:
        """Return the network before any learning."""
        return checkpoint.load(self.network_file(preset or self.preset, None), robot)

    def learnt(self, robot: Robot, seed: int, preset: str | None = None) -> Mae:
        """Return the network after exploration by an individual."""
        return checkpoint.load(self.network_file(preset or self.preset, seed), robot)

    def save_stream(self, seed: int, name: str, recording: Recording) -> None:
        """Keep a recording of an individual."""
        np.savez(self.folder / f'{name}_{seed}.npz', **recording._asdict())  # type: ignore[arg-type]

    def stream(self, seed: int, name: str) -> Recording:
        """Return a recording that was kept."""
        with np.load(self.folder / f'{name}_{seed}.npz') as arrays:
            return Recording(*(arrays[key] for key in Recording._fields))


@dataclass
class Measured:
    """What an experiment says of one individual.

    Attributes:
        numbers: For result.json; nested dictionaries of finite numbers, text or lists.
        traces: Arrays for the plots, by name.
    """

    numbers: dict[str, Any]
    traces: dict[str, Any] = field(default_factory=dict)
