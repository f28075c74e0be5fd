# SPDX-License-Identifier: Apache-2.0
"""Parts of `experiment` on workers: equal results, killed workers, interrupted runs, folders."""

import os
import re
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments import online_learning, runner, workers
from musculoskeletal_ae.experiments.study import Measured, Study
from musculoskeletal_ae.tools import experiment

from .conftest import MINUTES

MEASURE = runner._measure
NAMES = 'online_learning', 'body_change', 'sensors'


def eigenvalues(_study, seed):
    """Return numbers whose last digits depend on the threads of the numeric libraries."""
    matrix = np.random.default_rng(seed).normal(size=(300, 300))
    return Measured({'error_rad': np.linalg.svd(matrix)[1][:3].tolist()}, {'matrix': matrix})


def measure_with(measure, study, part, identifier):
    """Measure a part of a run in which `measure` replaces all experiments; runs on a worker."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(online_learning, 'train_initial', lambda *_: None)
        for name, each in runner.EXPERIMENTS.items():
            patch.setitem(runner.EXPERIMENTS, name, each._replace(measure=measure))
        return MEASURE(study, part, identifier)


def measure_eigenvalues(*call):
    return measure_with(eigenvalues, *call)


def run(study, jobs, report=lambda _: None, names=NAMES):
    with workers.workers(jobs, None) as processes:
        return runner.run(study, names, processes, report)


@pytest.fixture
def study(arm26, tmp_path) -> Study:
    return Study(arm26, 'default', (0, 1), 1.0, True, tmp_path)


def test_the_results_are_the_same_to_the_last_bit_with_1_and_2_processes(
    study, tmp_path, monkeypatch
):
    monkeypatch.setattr(runner, '_measure', measure_eigenvalues)
    files = list[dict[str, bytes]]()
    for jobs in (1, 2):
        folder = tmp_path / str(jobs)
        folder.mkdir()
        measured = run(replace(study, folder=folder), jobs)
        assert set(measured) == set(NAMES) and set(measured['sensors']) == {0, 1}
        files.append({file.name: file.read_bytes() for file in folder.glob('*.npz')})
    one, two = files
    assert set(one) == set(two)
    assert {name for name in one if one[name] != two[name]} == set()


def is_killed(study, seed):
    """Kill the process that measures individual 0.

    At the first attempt, this happens while another process is measuring individual 1.
    """
    begun = study.folder / f'{seed}'
    first = not begun.exists()
    begun.touch()
    if first:  # opening both ends of a FIFO makes the two workers wait for each other
        (study.folder / 'fifo').open('rw'[seed]).close()
    if seed == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    if first:
        signal.pause()
    return Measured({'error_rad': 0.5}, {})


def kill_at_body_change(study, part, identifier):
    measure = is_killed if part.name == 'body_change' else eigenvalues
    return measure_with(measure, study, part, identifier)


def test_after_the_kill_of_a_worker_only_a_part_whose_worker_is_killed_again_fails(
    study, monkeypatch
):
    os.mkfifo(study.folder / 'fifo')
    monkeypatch.setattr(runner, '_measure', kill_at_body_change)
    measured = run(study, 2, names=NAMES[:2])
    told = measured['body_change'].pop(0)
    assert told.startswith('WorkerKilledError in body_change: ') and 'use fewer processes' in told
    assert all(isinstance(each, Measured) for rows in measured.values() for each in rows.values())


def reached_by_ctrl_c(_study, _seed):
    """Return whether this process would receive SIGINT."""
    status = Path(f'/proc/{os.getpid()}/status').read_text('utf-8')
    (blocked,) = re.findall(r'^SigBlk:\s*(\w+)$', status, re.M)
    return Measured({'reached': not int(blocked, 16) >> (signal.SIGINT - 1) & 1}, {})


def measure_reached(*call):
    return measure_with(reached_by_ctrl_c, *call)


def test_ctrl_c_in_a_terminal_reaches_no_worker_whose_traceback_it_would_print(study, monkeypatch):
    monkeypatch.setattr(runner, '_measure', measure_reached)
    measured = run(study, 2)
    assert all(row.numbers == {'reached': False} for row in measured['online_learning'].values())


def test_an_interrupted_run_measures_no_part_again_that_had_ended(study, monkeypatch):
    monkeypatch.setattr(runner, '_measure', measure_eigenvalues)
    ended = list[runner.Part]()

    def interrupt(outcome):
        ended.append(outcome.part)
        if outcome.part.name == 'sensors':
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(study, 1, interrupt)
    again = list[runner.Part]()

    def note(outcome):
        if outcome.seconds:
            again.append(outcome.part)

    run(study, 1, note)
    every = {part for stage in runner.stages(study, NAMES) for part in stage}
    assert 0 < len(ended) < len(every)
    assert set(again) == every - set(ended)


def measure_elsewhere(study, part, identifier):
    """Measure a part as a worker that does not see the folder of the run, or sees another one."""
    other = study.folder / 'other'
    if part.name == 'default':
        other.mkdir(exist_ok=True)
        (other / runner.RUN).write_text('another run')
    return MEASURE(replace(study, folder=other), part, identifier)


@pytest.mark.parametrize('jobs', [1, 2])
def test_a_worker_that_does_not_see_the_folder_ends_the_run_and_says_what_is_needed(
    study, monkeypatch, jobs
):
    monkeypatch.setattr(runner, '_measure', measure_elsewhere)
    needed = r'cannot use \S+/other, the folder of this run: .*a folder to which all workers can'
    with pytest.raises(MusculoskeletalError, match=needed):
        run(study, jobs)


def wait_for(begun, end):
    begun.set()
    return end.wait(20.0)


def test_a_second_call_in_a_process_at_the_same_time_is_refused():
    begun, end = threading.Event(), threading.Event()
    with workers.workers(1, None) as processes, ThreadPoolExecutor(1) as pool:
        first = pool.submit(list, processes.in_order(wait_for, [(begun, end)]))
        assert begun.wait(20.0)
        with pytest.raises(MusculoskeletalError, match='--nthreads 1'):
            list(processes.in_order(abs, [(-1.0,)]))
        end.set()
        assert first.result() == [True]


def test_a_cluster_needs_a_folder_that_its_workers_share(capsys):
    with pytest.raises(SystemExit) as ended:
        experiment.main(['all', '--scheduler', 'tcp://127.0.0.1:8786'])
    assert ended.value.code == 2
    assert '--scheduler: also name --keep DIR' in capsys.readouterr().err


def test_a_cluster_needs_dask(monkeypatch):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    command = r'--scheduler tcp://a:1 needs Dask.*: pip install "dask\[distributed\]"'
    with pytest.raises(MusculoskeletalError, match=command), workers.workers(1, 'tcp://a:1'):
        pass


@pytest.mark.thorough
@pytest.mark.parametrize(
    ('address', 'problem'),
    [('tcp://127.0.0.1:1', 'no Dask scheduler answers'), ('a', 'expected the address')],
)
def test_a_scheduler_that_does_not_answer_is_named(monkeypatch, address, problem):
    pytest.importorskip('distributed')
    monkeypatch.setattr(workers, 'PATIENCE', 0.2)
    with pytest.raises(MusculoskeletalError, match=problem), workers.workers(1, address):
        pass


def kill_busy_worker(cluster, client):
    """Kill a worker process of a Dask cluster as soon as one has begun to run a call."""
    pids = {worker.worker_address: worker.pid for worker in cluster.workers.values()}
    while True:
        for address, calls in client.processing().items():
            if calls:
                os.kill(pids[address], signal.SIGKILL)
                return
        time.sleep(0.01)


@pytest.mark.thorough
def test_a_cluster_has_the_same_results_although_one_of_three_workers_is_killed(quick, tmp_path):
    distributed = pytest.importorskip('distributed')
    names = 'online_learning', 'body_change', 'loss_change'
    options = f'{",".join(names)} --robot arm26 --quick --minutes {MINUTES}'
    out = tmp_path / 'out'
    with (
        distributed.LocalCluster(
            n_workers=3, threads_per_worker=1, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
        ThreadPoolExecutor() as pool,
    ):
        killed = pool.submit(kill_busy_worker, cluster, client)
        files = f'--out {out} --keep {tmp_path / "kept"} --scheduler {cluster.scheduler_address}'
        assert experiment.main([*options.split(), *files.split()]) == 0
        killed.result(timeout=1.0)
    for name in names:
        file = Path(name) / 'result.json'
        assert (out / file).read_bytes() == (quick / file).read_bytes()


def square_or_be_killed(number):
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


@pytest.mark.thorough
def test_a_call_that_kills_every_worker_of_a_cluster_fails_alone():
    distributed = pytest.importorskip('distributed')
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None
        ) as cluster,
        workers.workers(1, cluster.scheduler_address) as processes,
    ):
        calls = [(number,) for number in range(5)]
        results = dict(processes.as_they_end(square_or_be_killed, calls))
    assert isinstance(results.pop(2), workers.WorkerKilledError)
    assert results == {0: 0, 1: 1, 3: 9, 4: 16}
