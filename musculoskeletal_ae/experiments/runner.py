# SPDX-License-Identifier: Apache-2.0
"""The list of experiments, and their execution in parallel processes.

    train both presets → for each individual: record, learn → its other experiments

The experiments of an individual start as soon as its network is trained. Every part has its own
random seeds, so the results do not depend on the number of processes. If a part fails, only the
parts that need its results are skipped. If a worker process is killed, for example by lack of
memory, its parts run again, one at a time. A part that is running when a worker is killed for the
second time fails.
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
from musculoskeletal_ae.experiments.study import Measured, Study, round_numbers
from musculoskeletal_ae.presets.registry import PRESETS

EXPERIMENTS = {
    name: import_module(f'musculoskeletal_ae.experiments.{name}').EXPERIMENT for name in NAMES
}
LEARNING = 'online_learning'
POLL = 0.5  # time between two reports [s]
Part = tuple[str, int]  # an experiment and a seed, or a preset to train and -1

# Threads of the numeric libraries would compete with the processes for the cores.
SINGLE = {f'{library}_NUM_THREADS': '1' for library in ('OMP', 'OPENBLAS', 'MKL', 'NUMBA')}


def run(
    study: Study, names: Sequence[str], jobs: int, report: Callable[[float, str], None]
) -> dict[str, dict[int, Measured | str]]:
    """Measure experiments on all individuals; return results by experiment and seed.

    The result of a failed part is its error message.

    Args:
        study: Options of the run.
        names: Names of the experiments.
        jobs: Number of processes.
        report: Called regularly with the completed share of the work and the names of running
            parts.
    """
    os.environ.update(SINGLE | dict(os.environ))
    weights = {name: experiment.weight for name, experiment in EXPERIMENTS.items()}
    total = len(PRESETS) + len(study.seeds) * sum(weights[name] for name in {LEARNING, *names})
    # Start the longest experiments first, so that none of them runs alone at the end.
    others = sorted(set(names) - {LEARNING}, key=weights.__getitem__, reverse=True)
    measured: dict[str, dict[int, Measured | str]] = {name: {} for name in names}
    pool = _pool(jobs)
    waiting: list[Part] = [(preset, -1) for preset in PRESETS]
    # Parts that were running when a worker was killed. They run again, one at a time.
    suspects: list[Part] = []
    done, running, pool_broken = 0.0, dict[Future[Any], Part](), False

    def begin(name: str, seed: int) -> None:
        train = _train, online_learning.train_initial, study, name
        try:
            future = pool.submit(*(train if name in PRESETS else (_measure, name, study, seed)))
        except BrokenProcessPool as error:  # the pool broke after the last check
            future = Future()
            future.set_exception(error)
        running[future] = name, seed

    try:
        while waiting or suspects or running:
            if pool_broken and not running:
                pool.shutdown()
                pool, pool_broken = _pool(jobs), False
            if suspects and not running:
                begin(*suspects[0])
            while waiting and not suspects and not pool_broken and len(running) < jobs:
                begin(*waiting.pop(0))
            ended, _ = wait(running, POLL, FIRST_COMPLETED)
            for future in ended:
                (name, seed), error = running.pop(future), future.exception()
                pool_broken |= isinstance(error, BrokenProcessPool)
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
                    waiting += [(LEARNING, each) for each in study.seeds]  # both presets trained
            report(done / total, ', '.join(sorted({name for name, _ in running.values()})))
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    pool.shutdown()
    return {name: {seed: measured[name][seed] for seed in study.seeds} for name in names}


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

    result: Measured = study.remember(f'{name}_{seed}', measure)
    return result


def _start() -> None:
    # Ctrl-C reaches the whole process group, but the parent terminates its workers itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import torch

    torch.set_num_threads(1)
