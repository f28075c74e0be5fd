# SPDX-License-Identifier: Apache-2.0
"""Measuring everything: which part after which, spread over processes.

    train both presets → for each individual: record, learn → its experiments

An experiment of one individual starts as soon as that individual is learnt. Every part draws from
its own seeds, so that the numbers are the same however the parts are spread.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from typing import Any

from musculoskeletal_ae.experiments.suite.learning import learn_individual, train_initial
from musculoskeletal_ae.experiments.suite.registry import AFTERWARDS, LEARNING, LEARNING_WEIGHT
from musculoskeletal_ae.experiments.suite.study import Measured, Study
from musculoskeletal_ae.presets import PRESETS

TRAINING_WEIGHT = 1.0
POLL = 0.5  # [s] between looks at the progress

#: by name of the experiment, then by seed
Everything = dict[str, dict[int, Measured]]

# Threads of the numeric libraries would fight with the processes for the cores.
SINGLE = {f'{library}_NUM_THREADS': '1' for library in ('OMP', 'OPENBLAS', 'MKL', 'NUMBA')}

_done: Any = None  # shared counter of finished work, in a worker


def total_weight(study: Study, names: Sequence[str]) -> float:
    """Return the work of a call, in the units of the progress bar."""
    each = LEARNING_WEIGHT + sum(AFTERWARDS[name].weight for name in names if name in AFTERWARDS)
    return len(PRESETS) * TRAINING_WEIGHT + len(study.seeds) * each


def run(
    study: Study, names: Sequence[str], jobs: int, report: Callable[[float, str], None]
) -> Everything:
    """Measure experiments on all individuals.

    Args:
        study: What is measured.
        names: Of experiments.
        jobs: Processes.
        report: Told from time to time how much work is done, and what was finished last.
    """
    os.environ.update({name: os.environ.get(name, value) for name, value in SINGLE.items()})
    context = multiprocessing.get_context('spawn')
    done = context.Value('d', 0.0)
    pool = ProcessPoolExecutor(jobs, context, _start, (done,))
    try:
        found = _Schedule(study, names, pool).work(lambda text: report(done.value, text))
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    pool.shutdown()
    return found


class _Schedule:
    """Hands out the parts as soon as what they need is there."""

    def __init__(self, study: Study, names: Sequence[str], pool: Executor) -> None:
        self._study, self._pool = study, pool
        self._later = sorted((n for n in names if n in AFTERWARDS), key=lambda n: -_weight(n))
        self._untrained = len(PRESETS)
        self._running: dict[Future[Any], tuple[str, int]] = {}
        self._found: Everything = {name: {} for name in (LEARNING, *self._later)}

    def work(self, report: Callable[[str], None]) -> Everything:
        for preset in PRESETS:
            self._running[self._pool.submit(_train, self._study, preset)] = (preset, -1)
        while self._running:
            ended, _ = wait(self._running, POLL, FIRST_COMPLETED)
            for future in ended:
                self._finish(*self._running.pop(future), future.result())
            report(', '.join(sorted({name for name, _ in self._running.values()})))
        order = self._study.seeds
        return {name: {s: rows[s] for s in order} for name, rows in self._found.items()}

    def _finish(self, name: str, seed: int, result: Measured | None) -> None:
        if result is None:
            self._untrained -= 1
            if not self._untrained:
                for each in self._study.seeds:
                    self._submit(LEARNING, each)
            return
        self._found[name][seed] = result
        if name == LEARNING:
            for later in self._later:
                self._submit(later, seed)

    def _submit(self, name: str, seed: int) -> None:
        self._running[self._pool.submit(_measure, name, self._study, seed)] = (name, seed)


def _weight(name: str) -> float:
    return LEARNING_WEIGHT if name == LEARNING else AFTERWARDS[name].weight


# -- in a worker --------------------------------------------------------------------------------


def _start(done: Any) -> None:
    global _done  # a process pool hands its workers nothing else
    _done = done
    # Ctrl-C reaches the whole group; the parent ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import torch

    torch.set_num_threads(1)


def _count(work: float) -> None:
    with _done.get_lock():
        _done.value += work


def _train(study: Study, preset: str) -> None:
    train_initial(study, preset)
    _count(TRAINING_WEIGHT)


def _measure(name: str, study: Study, seed: int) -> Measured:
    weight, counted = _weight(name), 0.0

    def progress(share: float) -> None:
        nonlocal counted
        counted += share
        _count(share * weight)

    work = learn_individual if name == LEARNING else AFTERWARDS[name].measure
    result = work(study, seed, progress)
    _count((1.0 - counted) * weight)
    return result
