# SPDX-License-Identifier: Apache-2.0
"""Whatever the training process does, it is replaced, and the node goes on."""

from __future__ import annotations

import os
import signal
import time

import pytest

from musculoskeletal_ae.learning import handout, supervisor, worker_process
from musculoskeletal_ae.learning.handout import Handout
from musculoskeletal_ae.learning.supervisor import Supervisor
from musculoskeletal_ae.learning.worker_process import Start
from musculoskeletal_ae.mae import checkpoint

from .test_learning import job

PATIENCE = 60.0  # [s] until a test is given up


@pytest.fixture
def supervised(arm26, initial, monkeypatch):
    monkeypatch.setattr(supervisor, 'FIRST_PAUSE', 0.0)
    start = Start(arm26.description.directory, checkpoint.to_bytes(initial), 'default', 0, None)
    found = Supervisor(lambda: start)
    found._pause = 0.0
    found.start()
    yield found
    found.stop()


def wait(supervised, condition):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        if (answer := supervised.poll()) is not None:
            return answer
        time.sleep(0.02)
    return None


def test_a_process_that_hangs_is_replaced(supervised, stage, monkeypatch):
    work = job(stage.store(3), steps=1)
    wait(supervised, lambda: supervised.can_take(3))
    monkeypatch.setattr(supervisor, 'PATIENCE', 0.5)
    first = supervised.pid
    os.kill(first, signal.SIGSTOP)
    supervised.submit(work)
    wait(supervised, lambda: supervised.trouble)
    assert 'did not answer in time' in supervised.trouble
    monkeypatch.setattr(supervisor, 'PATIENCE', PATIENCE)
    wait(supervised, lambda: supervised.can_take(3))
    assert supervised.pid != first
    supervised.submit(work)
    assert wait(supervised, lambda: False).version == work.version
    assert supervised.trouble == ''


def test_an_answer_that_cannot_be_taken_ends_the_process(supervised, stage, monkeypatch):
    wait(supervised, lambda: supervised.can_take(3))

    def torn(_):
        raise ValueError('a torn answer')

    monkeypatch.setattr(worker_process.Connection, 'recv', torn)
    supervised.submit(job(stage.store(3), steps=1))
    wait(supervised, lambda: supervised.trouble)
    assert 'a torn answer' in supervised.trouble
    assert not supervised.busy


def test_a_process_that_cannot_be_started_is_started_later(supervised, monkeypatch):
    def full(*_):
        raise OSError('No space left on device')

    with monkeypatch.context() as patch:
        patch.setattr(worker_process.tempfile, 'TemporaryFile', full)
        supervised.start()
    assert 'No space left' in supervised.trouble
    wait(supervised, lambda: supervised.can_take(3))


def test_checkpoints_are_handed_out_at_one_hertz_the_latest_of_several(monkeypatch):
    now, told = [100.0], []
    monkeypatch.setattr(handout.time, 'monotonic', lambda: now[0])
    out = Handout(told.append)
    for data in (b'1', b'2', b'3'):
        out.give(data)
    out.poll()
    assert told == [b'1']
    now[0] += 1.0
    out.poll()
    out.poll()
    assert told == [b'1', b'3']
    assert out.count == 2
