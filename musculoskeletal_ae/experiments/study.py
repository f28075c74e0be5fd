# SPDX-License-Identifier: Apache-2.0
"""What one call of `experiment` measures, what an experiment is, and what experiments share.

An individual's sensor streams and learned networks are made once (`online_learning`) and kept in a
folder; the other experiments read them there, each in its own process if cores allow.

A new experiment is a file beside this one that ends in `EXPERIMENT = Experiment(__doc__, …)`, its
name in `NAMES`, and what table.yaml says of it.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.recording import Recording
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.presets.registry import AS_PRINTED
from musculoskeletal_ae.robot.robot import Robot

DIGITS = 6  # significant, of numbers; more is noise


class Rests(NamedTuple):
    """The N samples at rest that a learner stored."""

    theta: Array  # [rad], (N, D)
    tension: Array  # [N], (N, M)
    length: Array  # [m], (N, M)


@dataclass(frozen=True)
class Study:
    """Options of one call, and what its experiments hand each other."""

    robot: Robot
    preset: str  # of the networks that are shown as `before` and `after`
    seeds: tuple[int, ...]  # individuals
    minutes: float  # duration of the exploration
    quick: bool  # a fraction of everything, to try things out
    folder: Path  # where streams and networks are kept
    reality: str = 'kin'  # the body of the individuals, see `make_arm`

    @property
    def held_out_time(self) -> float:
        """Duration of the motion never used for learning [s]."""
        return 10.0 if self.quick else 300.0

    def arm(self, seed: int, friction: bool = True) -> Arm:
        """Return an individual at rest; without friction it is the same body otherwise."""
        return make_arm(self.robot, seed, self.reality, friction)

    def network_file(self, preset: str, seed: int | None) -> Path:
        """Return the file of a network: initial (None), or learned on an individual."""
        return self.folder / f'{preset}_{"initial" if seed is None else seed}.safetensors'

    def numbers_file(self, seed: int) -> Path:
        """Return the file of what `online_learning` measured of an individual."""
        return self.folder / f'online_learning_{seed}.json'

    def network(self, seed: int | None, preset: str = '') -> Mae:
        """Return a network: initial (None), or learned on an individual."""
        return checkpoint.load(self.network_file(preset or self.preset, seed), self.robot)

    def networks(self, seed: int, preset: str = '') -> dict[str, Mae]:
        """Return the networks `before` and `after` learning on an individual."""
        return {'before': self.network(None, preset), 'after': self.network(seed, preset)}

    def keep(self, seed: int, **arrays: Recording | Rests) -> None:
        """Keep an individual's streams `exploring` and `held_out`, or the learner's `rests`."""
        for name, values in arrays.items():
            np.savez(self.folder / f'{name}_{seed}.npz', *values)

    def stream(self, seed: int, name: str) -> Recording:
        """Return a stream that was kept."""
        return Recording(*self._kept(seed, name))

    def rests(self, seed: int) -> Rests:
        """Return the samples at rest that were kept."""
        return Rests(*self._kept(seed, 'rests'))

    def _kept(self, seed: int, name: str) -> list[Array]:
        with np.load(self.folder / f'{name}_{seed}.npz') as arrays:
            return list(arrays.values())

    def keyed(self, preset: str, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """Return a preset's numbers as result.json names them: those as printed get a prefix."""
        named = ('', self.preset), (f'{AS_PRINTED}_', AS_PRINTED)
        prefixes = [prefix for prefix, name in named if name == preset]
        return {prefix + key: value for prefix in prefixes for key, value in numbers.items()}


class Measured(NamedTuple):
    """What an experiment says of one individual."""

    numbers: dict[str, Any]  # for result.json: nested dictionaries of finite numbers, text or lists
    traces: dict[str, Any]  # for the plots


def rounded(value: Any) -> Any:
    """Return the same with floats shortened; JSON cannot say what is not finite."""
    if isinstance(value, Mapping):
        return {key: rounded(part) for key, part in value.items()}
    if isinstance(value, list):
        return [rounded(part) for part in value]
    if isinstance(value, float):
        if not math.isfinite(value):
            raise MusculoskeletalError('an experiment brought a number that is not finite')
        return float(f'{value:.{DIGITS}g}')
    return value


Rows = Mapping[int, Measured]  # what an experiment says of its individuals, by seed
Plot = tuple[Figure, str]  # and its caption


def first(rows: Rows) -> tuple[int, Measured]:
    """Return the individual that plots of a single one show, with its seed."""
    return next(iter(rows.items()))


class Experiment(NamedTuple):
    """One experiment: how it is measured on an individual, drawn and explained."""

    #: the module's docstring: heading; "Paper (section). …", what it did and found; "Here. …"
    text: str | None
    measure: Callable[[Study, int], Measured]  # of the individual of a seed
    plots: tuple[Callable[[Study, Rows], Plot], ...]  # functions named as the files they draw
    weight: float  # how long it takes beside the others; for order and progress bar only
