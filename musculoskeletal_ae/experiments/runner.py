# SPDX-License-Identifier: Apache-2.0
"""The list of experiments, and their execution in three stages.

    train both presets → for each individual: record, learn → its other experiments

A part of the work is one experiment on one individual, or the initial training of one preset. The
parts of a stage run in parallel on workers. The next stage begins when all of them have ended.
Every part has its own random seeds, so the results do not depend on the workers. If a part fails,
only the parts that need its results are left out.

Parts exchange files only, in a folder that all workers share. A part's result is in a file as soon
as the part ends, so an interrupted run can be continued.
"""

import os
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryFile
from typing import NamedTuple
from uuid import uuid4

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments import NAMES, online_learning, saved_results
from musculoskeletal_ae.experiments.study import Measured, Study, round_numbers
from musculoskeletal_ae.experiments.workers import WorkerKilledError, Workers
from musculoskeletal_ae.presets.registry import PRESETS

EXPERIMENTS = {
    name: import_module(f'musculoskeletal_ae.experiments.{name}').EXPERIMENT for name in NAMES
}
LEARNING = 'online_learning'
RUN = 'run'  # file with the identifier of the run, by which a worker recognises the folder


class Part(NamedTuple):
    """One experiment on one individual, or the initial training of one preset."""

    name: str  # name of the experiment or of the preset
    seed: int | None = None  # seed of the individual; None for the training

    @property
    def stem(self) -> str:
        """Name of the part's files, without suffix."""
        return f'{self.name}_{"initial" if self.seed is None else self.seed}'

    @property
    def weight(self) -> float:
        """Relative duration of the part; longer parts start first."""
        return 1.0 if self.seed is None else EXPERIMENTS[self.name].weight

    @property
    def needs(self) -> tuple['Part', ...]:
        """The parts whose results this part needs."""
        if self.seed is None:
            return ()
        if self.name == LEARNING:
            return tuple(map(Part, PRESETS))
        return (Part(LEARNING, self.seed),)


class Outcome(NamedTuple):
    """How a part ended: with an error or not, and how much processor time it took."""

    part: Part
    failure: str = ''  # error message; '' if the result is in the folder of the run
    seconds: float = 0.0  # processor time of the part [s]; 0 if it was not measured in this run


def stages(study: Study, names: Sequence[str]) -> tuple[list[Part], ...]:
    """Return the parts of a run, in stages: a part needs only results of earlier stages."""
    others = set(names) - {LEARNING}
    # Start the longest experiments first, so that none of them runs alone at the end.
    longest_first = sorted(others, key=lambda name: EXPERIMENTS[name].weight, reverse=True)
    return (
        [Part(preset) for preset in PRESETS],
        [Part(LEARNING, seed) for seed in study.seeds],
        [Part(name, seed) for name in longest_first for seed in study.seeds],
    )


def run(
    study: Study, names: Sequence[str], workers: Workers, report: Callable[[Outcome], None]
) -> dict[str, dict[int, Measured | str]]:
    """Measure experiments on all individuals; return results by experiment and seed.

    If an experiment fails for an individual, its result is the error message.

    Args:
        study: Options of the run.
        names: Names of the experiments.
        workers: The workers that measure the parts.
        report: Function that is called whenever a part has ended.

    Raises:
        MusculoskeletalError: If a worker does not see the folder of the study.
    """
    identifier, failures = uuid4().hex, dict[Part, str]()
    (study.folder / RUN).write_text(identifier, encoding='utf-8')
    for parts in stages(study, names):
        to_measure = list[Part]()
        for part in parts:
            lack = next((failures[needed] for needed in part.needs if needed in failures), '')
            if lack:
                failures[part] = lack
            if lack or _result_file(study, part).is_file():
                report(Outcome(part, lack))
            else:
                to_measure.append(part)
        calls = [(study, part, identifier) for part in to_measure]
        for index, outcome in workers.as_they_end(_measure, calls):
            if isinstance(outcome, WorkerKilledError):
                outcome = _failed(to_measure[index], outcome)
            if outcome.failure:
                failures[outcome.part] = outcome.failure
            report(outcome)
    return {
        name: {seed: _result(study, Part(name, seed), failures) for seed in study.seeds}
        for name in names
    }


def _measure(study: Study, part: Part, identifier: str) -> Outcome:
    """Measure a part, and put its result into the folder of the study; runs on a worker.

    `identifier` is that of the run, to which the folder has to belong.
    """
    _check_folder(study.folder, identifier)
    begun = time.process_time()
    try:
        study.remember(part.stem, lambda: _value(study, part))
    except Exception as error:  # noqa: BLE001 - whatever ends a part, the others continue
        return _failed(part, error)
    return Outcome(part, seconds=time.process_time() - begun)


def _failed(part: Part, error: Exception) -> Outcome:
    return Outcome(part, f'{type(error).__name__} in {part.name}: {error}')


def _check_folder(folder: Path, identifier: str) -> None:
    """Raise a MusculoskeletalError unless the folder is that of the run, and can be written to."""
    try:
        found = (folder / RUN).read_text('utf-8')
        problem = '' if found == identifier else 'it is another folder, or another run uses it'
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        problem = str(error)
    if problem:
        raise MusculoskeletalError(
            f'process {os.getpid()} on {socket.gethostname()} cannot use {folder}, the folder of '
            f'this run: {problem}; let --keep name a folder to which all workers can write under '
            'the same path, for example on NFS'
        )


def _value(study: Study, part: Part) -> Measured | None:
    if part.seed is None:
        online_learning.train_initial(study, part.name)
        return None
    measured = EXPERIMENTS[part.name].measure(study, part.seed)
    return measured._replace(numbers=round_numbers(measured.numbers))


def _result(study: Study, part: Part, failures: Mapping[Part, str]) -> Measured | str:
    """Return the result of a part from the folder of the study, or why there is none.

    `failures` says for each failed part why it has failed.
    """
    if part in failures:
        return failures[part]
    file = _result_file(study, part)
    try:
        result = saved_results.read(file)
        numbers, traces = (getattr(result, key, None) for key in Measured._fields)
        if not isinstance(numbers, dict) or not isinstance(traces, dict):
            raise saved_results.unusable(file, 'expected numbers and traces')
    except MusculoskeletalError as error:
        return _failed(part, error).failure
    return Measured(numbers, traces)


def _result_file(study: Study, part: Part) -> Path:
    return study.folder / f'{part.stem}.npz'
