# SPDX-License-Identifier: Apache-2.0
"""Interfaces that all experiments share, and the options and intermediate files of one run.

The experiment `online_learning` creates the sensor streams and trained networks of each individual
and saves them in a folder. The other experiments load them from there and may run in separate
processes.

To add an experiment, add a file to this folder that ends in `EXPERIMENT = Experiment(__doc__, …)`,
add its name to `NAMES`, and add its rows to table.yaml.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments import saved_results
from musculoskeletal_ae.experiments.recording import Recording
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.presets.preset import PAPER_PRESET
from musculoskeletal_ae.robot.robot import Robot

HELD_OUT = 300.0  # let the held-out motion last this long [s]
#: in a shortened run, shorten a motion to this share of the whole one, and to at most this time [s]
QUICK_SHARE, QUICK_LIMIT = 0.25, 10.0
DIGITS = 6  # round results to this many significant digits; further digits are noise


@dataclass(frozen=True)
class Study:
    """Options of one run, and access to the files that its experiments share."""

    robot: Robot
    preset: str  # preset of the networks that plots show as `before` and `after`
    seeds: tuple[int, ...]  # seeds of the individuals
    minutes: float  # duration of the exploration [min]
    quick: bool  # whether to shorten everything, for a trial run
    folder: Path  # folder of the recorded streams and the networks
    reality: str = 'kin'  # emulator model of the individuals, see `make_arm`

    def remember(self, part: str, measure: Callable[[], Any]) -> Any:
        """Return the saved result of a part of the run; measure and save it first if needed.

        The result is read from the file (`saved_results`) in both cases, so a continued run cannot
        differ.
        """
        file = self.folder / f'{part}.npz'
        if not file.is_file():
            saved_results.write(file, measure())
        return saved_results.read(file)

    @property
    def presets(self) -> tuple[str, ...]:
        """The compared presets: `paper`, and the preset of the run if it is another one."""
        return tuple(dict.fromkeys((PAPER_PRESET, self.preset)))

    def number(self, whole: int) -> int:
        """Return a number of measurements: `whole`, or 1 in a shortened run."""
        return 1 if self.quick else whole

    def seconds(self, whole: float) -> float:
        """Return the duration of a motion [s]: `whole`, or a part of it in a shortened run."""
        return min(QUICK_SHARE * whole, QUICK_LIMIT) if self.quick else whole

    @property
    def held_out_time(self) -> float:
        """Duration of the held-out motion, which is never used for learning [s]."""
        return self.seconds(HELD_OUT)

    def arm(self, seed: int, friction: bool = True) -> Arm:
        """Return a new emulated arm at rest: the individual of a seed, with or without friction."""
        return make_arm(self.robot, seed, self.reality, friction)

    def network_file(self, preset: str, seed: int | None) -> Path:
        """Return the file of the network that a preset has after learning from an individual.

        Without a seed (None), it is the file of the preset's initial network.
        """
        return self.folder / f'{preset}_{"initial" if seed is None else seed}.safetensors'

    def network(self, seed: int | None, preset: str = '') -> Mae:
        """Load the initial network (seed None), or the network that learned from an individual.

        `preset` is by default the preset of this study.
        """
        return checkpoint.load(self.network_file(preset or self.preset, seed), self.robot)

    def networks(self, seed: int, preset: str = '') -> dict[str, Mae]:
        """Load the networks 'before' and 'after' learning from the individual of a seed."""
        return {'before': self.network(None, preset), 'after': self.network(seed, preset)}

    def save(self, seed: int, **arrays: Recording | State) -> None:
        """Save an individual's streams `exploring` and `held_out`, or the learner's `rests`."""
        for name, values in arrays.items():
            saved_results.write(self._stream_file(seed, name), values)

    def stream(self, seed: int, name: str) -> Recording:
        """Load a saved stream of an individual: `exploring` or `held_out`."""
        return Recording(**self._load(seed, name, Recording._fields))

    def rests(self, seed: int) -> State:
        """Load the rest samples that the learner of an individual stored."""
        return State(**self._load(seed, 'rests', State._fields))

    def _stream_file(self, seed: int, name: str) -> Path:
        return self.folder / f'{name}_{seed}.npz'

    def _load(self, seed: int, name: str, fields: Sequence[str]) -> dict[str, Array]:
        file = self._stream_file(seed, name)
        arrays = getattr(saved_results.read(file), '__dict__', {})
        if set(arrays) != set(fields):
            raise saved_results.unusable(
                file, f'expected arrays with the names {", ".join(fields)}'
            )
        return arrays

    def with_prefix(self, preset: str, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """Return a preset's numbers under their keys in result.json.

        The keys of preset `paper` begin with its name. If `paper` is the preset of the run, its
        numbers are also returned under keys without this prefix.
        """
        prefixed = dict[str, Any]()
        if preset == self.preset:
            prefixed |= numbers
        if preset == PAPER_PRESET:
            prefixed |= {f'{PAPER_PRESET}_{key}': value for key, value in numbers.items()}
        return prefixed


class Measured(NamedTuple):
    """The results of an experiment for one emulated individual."""

    #: contents of result.json: nested dictionaries of finite numbers, text, lists or None
    numbers: dict[str, Any]
    #: data of the plots, as `saved_results.read` returns them from a file: named tuples have become
    #: objects with the same attributes, and tuples have become lists
    traces: dict[str, Any]


def round_numbers(value: Any, path: str = '') -> Any:
    """Return a value with its floats rounded to `DIGITS` significant digits, ready for JSON.

    Args:
        value: A number, a text, or nested dictionaries and lists of them.
        path: Position of the value within the results, for the error message.

    Raises:
        MusculoskeletalError: If a number is not finite, which JSON cannot represent.
    """
    if isinstance(value, Mapping):
        return {key: round_numbers(part, f'{path}.{key}') for key, part in value.items()}
    if isinstance(value, list):
        return [round_numbers(part, f'{path}[{n}]') for n, part in enumerate(value)]
    if isinstance(value, float):
        if not math.isfinite(value):
            raise MusculoskeletalError(
                f'the result {path.removeprefix(".")} is {value}; expected a finite number'
            )
        return float(f'{value:.{DIGITS}g}')
    return value


Rows = Mapping[int, Measured]  # the results of an experiment, by the individuals' seeds
Plot = tuple[Any, str]  # a figure of matplotlib and its caption


def first_individual(rows: Rows) -> tuple[int, Measured]:
    """Return seed and results of the first individual, for plots that show only one individual."""
    return next(iter(rows.items()))


class Experiment(NamedTuple):
    """One experiment: its description, its measurement on an individual, and its plots."""

    #: the module's docstring: a heading, "Paper (section). …", "Here. …", and possibly a list of
    #: terms (lines that start with "- "), with an empty line between them
    text: str | None
    measure: Callable[[Study, int], Measured]  # measures the individual of a seed
    #: functions that draw one plot each, whose file has the name of the function; they return None
    #: if the results of an interrupted run have no data for the plot
    plots: tuple[Callable[[Study, Rows], Plot | None], ...]
    weight: float  # relative duration, for scheduling and the progress bar
