# SPDX-License-Identifier: Apache-2.0
"""The list of experiments, and their execution in parallel processes.

    train both presets → for each individual: record, learn → its other experiments

A part of the work is one experiment on one individual, or the initial training of one preset. The
experiments of an individual start as soon as its network is trained. Every part has its own random
seeds, so the results do not depend on the number of processes. If a part fails, only the parts that
need its results are skipped. If a worker process is killed, for example for lack of memory, all
parts that were running start again, one at a time. A part during which a worker is killed a second
time fails.
"""

import multiprocessing
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from typing import Any

from musculoskeletal_ae.experiments import NAMES, kept, online_learning
from musculoskeletal_ae.experiments.study import Measured, Study, round_numbers
from musculoskeletal_ae.presets.registry import PRESETS
from musculoskeletal_ae.process_signals import STOP, Reaction, interrupts_blocked

EXPERIMENTS = {
    name: import_module(f'musculoskeletal_ae.experiments.{name}').EXPERIMENT for name in NAMES
}
LEARNING = 'online_learning'
POLL = 0.5  # report after at most this time [s]
Part = tuple[str, int]  # an experiment and a seed, or a preset to train and -1

# Threads of the numeric libraries would compete with the processes for the cores.
SINGLE = {f'{library}_NUM_THREADS': '1' for library in ('OMP', 'OPENBLAS', 'MKL', 'NUMBA')}


def run(
    study: Study, names: Sequence[str], jobs: int, report: Callable[[float, str], None]
) -> dict[str, dict[int, Measured | str]]:
    """Measure experiments on all individuals; return results by experiment and seed.

    If an experiment fails for an individual, its result is the error message.

    Args:
        study: Options of the run.
        names: Names of the experiments.
        jobs: Number of processes.
        report: Function that is called regularly with the completed share of the work and the
            names of the running parts.
    """
    os.environ.update(SINGLE | dict(os.environ))
    schedule, workers = _Schedule(study, names), _Workers(study, jobs)
    try:
        while schedule.waiting or workers.is_busy:
            workers.start_from(schedule.waiting)
            for part, future in workers.ended():
                if error := future.exception():
                    schedule.on_failure(part, error)
                else:
                    schedule.on_result(part, future.result())
            report(schedule.completed, ', '.join(sorted({name for name, _ in workers.parts})))
    except BaseException:
        workers.abort()
        raise
    workers.close()
    return {name: {seed: rows[seed] for seed in study.seeds} for name, rows in schedule.results()}


class _Schedule:
    """The parts that may begin, and the results of the parts that have ended.

    Attributes:
        waiting: Parts that may begin, in this order.
    """

    def __init__(self, study: Study, names: Sequence[str]) -> None:
        self._study, self._names = study, names
        experiments = {name: experiment.weight for name, experiment in EXPERIMENTS.items()}
        self._weights = dict.fromkeys(PRESETS, 1.0) | experiments
        of_individual = sum(experiments[name] for name in {LEARNING, *names})
        self._total = len(PRESETS) + len(study.seeds) * of_individual
        self._done = 0.0
        # Start the longest experiments first, so that none of them runs alone at the end.
        others = set(names) - {LEARNING}
        self._others = sorted(others, key=experiments.__getitem__, reverse=True)
        self._untrained = set(PRESETS)
        self._measured: dict[str, dict[int, Measured | str]] = {name: {} for name in names}
        self.waiting: list[Part] = [(preset, -1) for preset in PRESETS]

    @property
    def completed(self) -> float:
        """Completed share of the work."""
        return self._done / self._total

    def results(self) -> Iterable[tuple[str, dict[int, Measured | str]]]:
        """Return the results, or error messages, of each experiment by seed."""
        return self._measured.items()

    def on_result(self, part: Part, result: Any) -> None:
        """Store the result of a part, and append the parts that need it to `waiting`."""
        name, seed = part
        self._done += self._weights[name]
        if name in self._measured:
            self._measured[name][seed] = result
        if name == LEARNING:
            self.waiting += [(other, seed) for other in self._others]
        elif name in PRESETS:
            self._untrained.remove(name)
            if not self._untrained:
                self.waiting += [(LEARNING, each) for each in self._study.seeds]

    def on_failure(self, part: Part, error: BaseException) -> None:
        """Store the error message as the result of a part and of all parts that need it."""
        name, seed = part
        self._done += self._weights[name]
        lost = self._names if name in (LEARNING, *PRESETS) else (name,)
        seeds = self._study.seeds if name in PRESETS else (seed,)
        for each in lost:
            message = f'{type(error).__name__} in {name}: {error}'
            self._measured[each] |= dict.fromkeys(seeds, message)


class _Workers:
    """Processes that run parts; a killed process is replaced, and its parts run again."""

    def __init__(self, study: Study, jobs: int) -> None:
        self._study, self._jobs = study, jobs
        self._pool = _pool(jobs)
        self._is_broken = False
        self._running = dict[Future[Any], Part]()
        #: parts that were running when a process was killed; they run again, one at a time
        self._suspects: list[Part] = []

    @property
    def is_busy(self) -> bool:
        """Whether a part is running or has to run again."""
        return bool(self._running or self._suspects)

    @property
    def parts(self) -> Iterable[Part]:
        """The parts that are running."""
        return self._running.values()

    def start_from(self, waiting: list[Part]) -> None:
        """Start as many parts as may run now, and remove them from `waiting`."""
        if self._is_broken and not self._running:
            self._pool.shutdown()
            self._pool, self._is_broken = _pool(self._jobs), False
        if self._suspects and not self._running:
            self._begin(self._suspects[0])
        while waiting and not (self._suspects or self._is_broken) and self._is_free:
            self._begin(waiting.pop(0))

    @property
    def _is_free(self) -> bool:
        return len(self._running) < self._jobs

    def _begin(self, part: Part) -> None:
        name, seed = part
        task: tuple[Any, ...] = _measure, name, self._study, seed
        if name in PRESETS:
            task = _train, online_learning.train_initial, self._study, name
        try:
            # This may start a worker and the fork server. A worker whose start is interrupted could
            # not be ended, and would print a traceback.
            with interrupts_blocked(), STOP.reacting(Reaction.REMEMBER):
                future = self._pool.submit(*task)
        except BrokenProcessPool as error:  # the pool broke after the last check
            future = Future()
            future.set_exception(error)
        self._running[future] = part
        STOP.raise_if_received()

    def ended(self) -> list[tuple[Part, Future[Any]]]:
        """Wait until a part ends, but at most POLL [s]; return the ended parts and their futures.

        Parts that were running for the first time when a process was killed are not returned,
        because they run again.
        """
        ended = list[tuple[Part, Future[Any]]]()
        for future in wait(self._running, POLL, FIRST_COMPLETED).done:
            part, was_killed = self._running.pop(future), _was_killed(future)
            self._is_broken |= was_killed
            if part in self._suspects:
                self._suspects.remove(part)
            elif was_killed:
                self._suspects.append(part)
                continue
            ended.append((part, future))
        return ended

    def abort(self) -> None:
        """End all processes immediately, without waiting for running parts."""
        # End the processes before the pool. Otherwise, a process that is just starting would print
        # a traceback.
        for child in multiprocessing.active_children():
            child.terminate()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        """End the processes after the last part has ended."""
        self._pool.shutdown()


def _was_killed(future: Future[Any]) -> bool:
    return isinstance(future.exception(), BrokenProcessPool)


def _pool(jobs: int) -> ProcessPoolExecutor:
    # The fork server imports slow modules once, for all workers.
    context = multiprocessing.get_context('forkserver')
    context.set_forkserver_preload([__name__, 'torch'])
    return ProcessPoolExecutor(jobs, context, _start)


def _train(train: Callable[[Study, str], None], study: Study, preset: str) -> None:
    study.remember(f'{preset}_initial', lambda: train(study, preset))


def _measure(name: str, study: Study, seed: int) -> Measured:
    def measure() -> Measured:
        measured = EXPERIMENTS[name].measure(study, seed)
        return measured._replace(numbers=round_numbers(measured.numbers))

    part = f'{name}_{seed}'
    result = study.remember(part, measure)
    numbers, traces = (getattr(result, key, None) for key in Measured._fields)
    if not isinstance(numbers, dict) or not isinstance(traces, dict):
        raise kept.unusable(study.folder / part, 'expected numbers and traces')
    return Measured(numbers, traces)


def _start() -> None:
    import torch

    torch.set_num_threads(1)
