# SPDX-License-Identifier: Apache-2.0
"""Whatever the training process does, it is replaced, and the node goes on."""

import os
import queue
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest
import torch

from musculoskeletal_ae.learning import training
from musculoskeletal_ae.learning.training import Training, TrainingProcess

from .conftest import job

PATIENCE = 300.0  # [s] until a test is given up: a machine at work starts a process in minutes


@pytest.fixture
def process(arm26, monkeypatch):
    monkeypatch.setattr(training, 'FIRST_PAUSE', 0.0)
    process = TrainingProcess(arm26, 'default')
    yield process
    process.close()


def answer(process):
    """Return the next update, or None if a process was lost first."""
    deadline = time.monotonic() + PATIENCE
    losses = process.restarts
    while process.restarts == losses:
        assert time.monotonic() < deadline
        if (update := process.poll()) is not None:
            return update
        time.sleep(0.02)
    return None


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_it_learns_what_would_be_learned_here(process, arm26, initial, stage):
    work = job(stage.store(3), steps=3)
    here = Training(arm26, 'default')
    for place in (here, process):
        place.begin(initial)
        assert place.ready
        place.submit(work)
    there, expected = answer(process), here.poll()
    assert there.loss == expected.loss
    np.testing.assert_array_equal(there.mae.encoder[0][0], expected.mae.encoder[0][0])
    assert process.ready


@pytest.mark.skipif(torch.cuda.is_available(), reason='it learns there')
def test_without_a_gpu_it_learns_on_the_cpu_and_says_so(arm26, initial, stage, capfd):
    process = TrainingProcess(arm26, 'default', device='cuda')
    process.begin(initial)
    process.submit(job(stage.store(3), steps=1))
    assert answer(process).device == 'cpu'
    process.close()
    assert 'computes nothing there' in capfd.readouterr().err


def test_a_process_that_hangs_is_replaced_and_the_next_does_its_job(
    process, initial, stage, monkeypatch
):
    process.begin(initial)
    process.submit(job(stage.store(3), steps=1))
    assert answer(process)
    first = process.pid
    os.kill(first, signal.SIGSTOP)
    with monkeypatch.context() as patch:
        patch.setattr(training, 'PATIENCE', 0.3)
        process._patience = 0.3
        # More than a pipe holds, so that sending it hangs, too.
        process.submit(job(stage.store(300), steps=1))
        assert answer(process) is None
    assert 'did not answer in time' in process.trouble
    assert not alive(first)
    assert answer(process).mae.training.count('300 samples')
    assert process.trouble == ''
    assert process.pid != first


def test_a_process_that_dies_is_replaced_and_the_next_does_its_job(process, initial, stage):
    process.begin(initial)
    process.submit(job(stage.store(3), steps=1))
    os.kill(process.pid, signal.SIGKILL)
    assert answer(process) is None
    assert 'died (status -9)' in process.trouble
    assert answer(process)
    assert process.restarts == 1


def test_pauses_between_processes_grow(process, initial, monkeypatch):
    monkeypatch.setattr(training, 'FIRST_PAUSE', 1.0)
    process = TrainingProcess(process.robot, 'default')
    process.begin(initial)
    pauses = []
    for _ in range(9):
        process._lost('was lost')
        pauses.append(process._restart_at - time.monotonic())
    assert pauses == pytest.approx([1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0, 60.0], abs=0.5)


class Nonsense:
    """A connection to a process that answers nonsense."""

    def __init__(self, answer) -> None:
        self.answer = answer

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def send(self, _):
        pass

    def recv(self):
        return self.answer


@pytest.mark.parametrize('answer', [b'no checkpoint', (b'no checkpoint', 0.0, 0.0), None, 'text'])
def test_nonsense_is_no_answer(arm26, initial, answer):
    jobs, answers = queue.SimpleQueue(), queue.SimpleQueue()
    jobs.put('a job')
    training._talk(Nonsense(answer), None, initial, arm26, jobs, answers)
    assert isinstance(answers.get_nowait(), str)


def test_an_answer_that_cannot_be_taken_ends_the_process(process, initial, stage, monkeypatch):
    process.begin(initial)
    with monkeypatch.context() as patch:
        patch.setattr(training.Connection, 'recv', lambda _: None)
        process.submit(job(stage.store(3), steps=1))
        assert answer(process) is None
    assert 'died' in process.trouble
    assert answer(process)


def test_a_process_that_cannot_be_started_is_started_later(process, initial, stage, monkeypatch):
    def full(*_):
        raise OSError('Cannot allocate memory')

    with monkeypatch.context() as patch:
        patch.setattr(training.SpawnProcess, 'start', full)
        process.begin(initial)
    assert 'Cannot allocate memory' in process.trouble
    assert not process.ready
    process.poll()
    process.submit(job(stage.store(3), steps=1))
    assert answer(process)


NODE = """
    import signal, sys, time
    from pathlib import Path
    from musculoskeletal_ae.learning.learner import Learner
    from musculoskeletal_ae.learning.training import TrainingProcess
    from musculoskeletal_ae.mae import checkpoint
    from musculoskeletal_ae.robot.robot import Robot

    if __name__ == '__main__':
        # A shell's background jobs are born with it ignored.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        robot = Robot.load('arm26')
        mae = checkpoint.load(sys.argv[1], robot)
        process = Learner(robot, mae, training=TrainingProcess).training
        try:
            print(process.pid, 'torch' in sys.modules, flush=True)
            while True:
                time.sleep(0.1)
        except KeyboardInterrupt:
            time.sleep(2.0)
            print(process._process.is_alive(), flush=True)
"""


@pytest.fixture
def node(trained_file, tmp_path):
    file = tmp_path / 'node.py'
    file.write_text(textwrap.dedent(NODE))
    node = subprocess.Popen(
        [sys.executable, str(file), trained_file],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    yield node
    node.kill()
    node.communicate()


def test_it_ends_with_the_node_however_that_ends(node):
    pid, torch = node.stdout.readline().split()
    assert torch == 'False'  # the heavy imports are the process's own
    node.kill()
    deadline = time.monotonic() + PATIENCE
    while alive(int(pid)):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_ctrl_c_goes_to_the_node_only(node):
    node.stdout.readline()
    os.killpg(node.pid, signal.SIGINT)  # while the process comes up
    output, _ = node.communicate(timeout=PATIENCE)
    assert output == 'True\n'
