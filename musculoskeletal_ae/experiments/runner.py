# SPDX-License-Identifier: Apache-2.0
"""The experiments there are, and measuring them: which part after which, spread over processes.

    train both presets → for each individual: record, learn → its other experiments

An experiment of one individual starts as soon as that individual is learned. Every part draws from
its own seeds, so that the numbers are the same however the parts are spread.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from typing import Any

from musculoskeletal_ae.experiments import (
    body_change,
    control,
    estimation,
    loss_change,
    online_learning,
    simulation,
)
from musculoskeletal_ae.experiments.study import Measured, Study
from musculoskeletal_ae.presets import PRESETS

#: in the order of the report; the first one makes what the others need
EXPERIMENTS = {
    'online_learning': online_learning.EXPERIMENT,
    'estimation': estimation.EXPERIMENT,
    'control': control.EXPERIMENT,
    'simulation': simulation.EXPERIMENT,
    'loss_change': loss_change.EXPERIMENT,
    'body_change': body_change.EXPERIMENT,
}
LEARNING = 'online_learning'
TRAINING_WEIGHT = 1.0
POLL = 0.5  # [s] between looks at the progress

#: by name of the experiment, then by seed
Everything = dict[str, dict[int, Measured]]

# Threads of the numeric libraries would fight with the processes for the cores.
SINGLE = {f'{library}_NUM_THREADS': '1' for library in ('OMP', 'OPENBLAS', 'MKL', 'NUMBA')}

_done: Any = None  # shared counter of finished work, in a worker


def total_weight(study: Study, names: Sequence[str]) -> float:
    """Return the work of a call, in the units of the progress bar."""
    each = sum(EXPERIMENTS[name].weight for name in {LEARNING, *names})
    return len(PRESETS) * TRAINING_WEIGHT + len(study.seeds) * each


def run(
    study: Study, names: Sequence[str], jobs: int, report: Callable[[float, str], None]
) -> Everything:
    """Measure experiments on all individuals.

    Args:
        study: What is measured.
        names: Of experiments.
        jobs: Processes.
        report: Told from time to time how much work is done, and what is running.
    """
    os.environ.update({name: os.environ.get(name, value) for name, value in SINGLE.items()})
    context = multiprocessing.get_context('spawn')
    done = context.Value('d', 0.0)
    pool = ProcessPoolExecutor(jobs, context, _start, (done,))
    # The longest first, so that none of them is alone at the end.
    later = sorted({*names} - {LEARNING}, key=lambda name: -EXPERIMENTS[name].weight)
    untrained = set(PRESETS)
    measured: Everything = {name: {} for name in names}
    running: dict[Future[Any], tuple[str, int]] = {}

    def submit(parts: Sequence[str], seed: int) -> None:
        running.update({pool.submit(_measure, study, name, seed): (name, seed) for name in parts})

    try:
        for preset in PRESETS:
            running[pool.submit(_train, study, preset)] = preset, -1
        while running:
            ended, _ = wait(running, POLL, FIRST_COMPLETED)
            for future in ended:
                (name, seed), result = running.pop(future), future.result()
                if name in untrained:
                    untrained.remove(name)
                    for each in () if untrained else study.seeds:
                        submit([LEARNING], each)
                    continue
                if name in measured:
                    measured[name][seed] = result
                if name == LEARNING:
                    submit(later, seed)
            report(done.value, ', '.join(sorted({name for name, _ in running.values()})))
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    pool.shutdown()
    return {name: {seed: measured[name][seed] for seed in study.seeds} for name in names}


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
    online_learning.train_initial(study, preset)
    _count(TRAINING_WEIGHT)


def _measure(study: Study, name: str, seed: int) -> Measured:
    experiment, counted = EXPERIMENTS[name], 0.0

    def progress(share: float) -> None:
        nonlocal counted
        counted += share
        _count(share * experiment.weight)

    measured = experiment.measure(study, seed, progress)
    _count((1.0 - counted) * experiment.weight)
    return measured
