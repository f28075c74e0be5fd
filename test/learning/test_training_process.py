# SPDX-License-Identifier: Apache-2.0
"""However the training process fails, it is replaced, and the node continues."""

import os
import signal
import time

import numpy as np
import pytest
from processes import is_running

from musculoskeletal_ae.learning import training_process as trainers
from musculoskeletal_ae.learning.training_process import Trainer, TrainerProcess

from .conftest import job

PATIENCE = 300.0  # longest wait for an update [s]; a busy machine needs minutes to start a process


@pytest.fixture
def process(arm26, monkeypatch):
    monkeypatch.setattr(trainers, 'PAUSE', 0.0)
    process = TrainerProcess(arm26, 'default')
    yield process
    process.close()


def answer(process):
    """Wait for the next update and return it, or None if the process ends first."""
    deadline = time.monotonic() + PATIENCE
    losses = process.restarts
    while process.restarts == losses:
        assert time.monotonic() < deadline
        if (update := process.poll()) is not None:
            return update
        time.sleep(0.02)
    return None


def test_the_training_process_learns_the_same_network_as_training_in_this_process(
    process, arm26, initial, stage
):
    work = job(stage.store(3), steps=3)
    here = Trainer(arm26, 'default')
    for place in (here, process):
        place.begin(initial)
        assert place.ready
        place.submit(work)
    there, expected = answer(process), here.poll()
    assert there.loss == expected.loss
    np.testing.assert_array_equal(there.mae.encoder[0][0], expected.mae.encoder[0][0])
    assert process.ready


def test_a_training_process_that_cannot_start_dies_or_hangs_is_replaced_and_its_job_repeated(
    process, initial, stage, monkeypatch
):
    def full(*_):
        raise OSError('Cannot allocate memory')

    with monkeypatch.context() as patch:
        patch.setattr(trainers.SpawnProcess, 'start', full)
        process.begin(initial)
    assert 'Cannot allocate memory' in process.trouble
    assert not process.ready

    process.poll()
    process.submit(job(stage.store(3), steps=1))
    os.kill(process.pid, signal.SIGKILL)
    assert answer(process) is None
    assert 'died (status -9)' in process.trouble
    assert answer(process)
    assert process.trouble == ''
    assert process.restarts == 2

    first = process.pid
    os.kill(first, signal.SIGSTOP)
    with monkeypatch.context() as patch:
        patch.setattr(trainers, 'PATIENCE', 0.3)
        # The job is larger than the buffer of a pipe, so sending it to a suspended process blocks.
        process.submit(job(stage.store(4), stage.messages(20_000), steps=1))
        assert answer(process) is None
    assert 'did not answer in time' in process.trouble
    assert not is_running(first)
    assert answer(process).mae.training.count('4 samples')
    assert process.trouble == ''
    assert process.pid != first
