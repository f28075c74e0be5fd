# SPDX-License-Identifier: Apache-2.0
"""The experiments there are, and measuring them: which part after which, spread over processes.

    train both presets → for each individual: record, learn → its other experiments

An experiment of one individual starts as soon as that individual is learned. Every part draws from
its own seeds, so that the numbers are the same however the parts are spread. A part that fails
takes only those with it that need it. What runs as a worker is killed, as without memory, runs
again, one part at a time, and fails if its worker is killed then, too.
"""

import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from typing import Any

from musculoskeletal_ae.experiments import NAMES, online_learning
from musculoskeletal_ae.experiments.study import Measured, Study, rounded
from musculoskeletal_ae.presets.registry import PRESETS

EXPERIMENTS = {
    name: import_module(f'musculoskeletal_ae.experiments.{name}').EXPERIMENT for name in NAMES
}
LEARNING = 'online_learning'
POLL = 0.5  # [s] between two reports
Part = tuple[str, int]  # an experiment and a seed; or a preset to train

# Threads of the numeric libraries would fight with the processes for the cores.
SINGLE = {f'{library}_NUM_THREADS': '1' for library in ('OMP', 'OPENBLAS', 'MKL', 'NUMBA')}


def run(
    study: Study, names: Sequence[str], jobs: int, report: Callable[[float, str], None]
) -> dict[str, dict[int, Measured | str]]:
    """Measure experiments on all individuals; return what they say by experiment, then by seed.

    Of one that failed it is the error.

    Args:
        study: What is measured.
        names: Of experiments.
        jobs: Processes.
        report: Told from time to time which share of the work is done, and what is running.
    """
    os.environ.update(SINGLE | dict(os.environ))
    weights = {name: experiment.weight for name, experiment in EXPERIMENTS.items()}
    total = len(PRESETS) + len(study.seeds) * sum(weights[name] for name in {LEARNING, *names})
    # The longest first, so that none of them is alone at the end.
    others = sorted(set(names) - {LEARNING}, key=weights.__getitem__, reverse=True)
    measured: dict[str, dict[int, Measured | str]] = {name: {} for name in names}
    pool = _pool(jobs)
    waiting: list[Part] = [(preset, -1) for preset in PRESETS]
    suspects: list[Part] = []  # ran as a worker was killed; the first is next, or running, alone
    done, running, broken = 0.0, dict[Future[Any], Part](), False

    def begin(name: str, seed: int) -> None:
        train = online_learning.train_initial, study, name
        try:
            future = pool.submit(*(train if name in PRESETS else (_measure, name, study, seed)))
        except BrokenProcessPool as error:  # since the last look at it
            future = Future()
            future.set_exception(error)
        running[future] = name, seed

    try:
        while waiting or suspects or running:
            if broken and not running:
                pool.shutdown()
                pool, broken = _pool(jobs), False
            if suspects and not running:
                begin(*suspects[0])
            while waiting and not suspects and not broken and len(running) < jobs:
                begin(*waiting.pop(0))
            ended, _ = wait(running, POLL, FIRST_COMPLETED)
            for future in ended:
                (name, seed), error = running.pop(future), future.exception()
                broken |= isinstance(error, BrokenProcessPool)
                if (name, seed) in suspects:
                    suspects.remove((name, seed))
                elif isinstance(error, BrokenProcessPool):
                    suspects.append((name, seed))
                    continue
                done += weights.get(name, 1.0)  # initial training: 1
                if error:
                    for lost in names if name in (LEARNING, *PRESETS) else (name,):
                        for each in study.seeds if name in PRESETS else (seed,):
                            measured[lost][each] = f'{type(error).__name__} in {name}: {error}'
                    continue
                if name in measured:
                    measured[name][seed] = future.result()
                if name == LEARNING:
                    waiting += [(other, seed) for other in others]
                elif name in PRESETS and not (waiting or suspects or running or measured[names[0]]):
                    waiting += [(LEARNING, each) for each in study.seeds]  # both are trained
            report(done / total, ', '.join(sorted({name for name, _ in running.values()})))
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    pool.shutdown()
    return {name: {seed: measured[name][seed] for seed in study.seeds} for name in names}


def _pool(jobs: int) -> ProcessPoolExecutor:
    # What takes seconds to import is imported once, by the server from which workers are forked.
    context = multiprocessing.get_context('forkserver')
    context.set_forkserver_preload([__name__, 'torch'])
    return ProcessPoolExecutor(jobs, context, _start)


def _measure(name: str, study: Study, seed: int) -> Measured:
    measured = EXPERIMENTS[name].measure(study, seed)
    return measured._replace(numbers=rounded(measured.numbers))


def _start() -> None:
    # Ctrl-C reaches the whole group; the parent ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import torch

    torch.set_num_threads(1)
