# SPDX-License-Identifier: Apache-2.0
"""A full disk, and a kill between any two steps on the disk: all of a state is there, or none."""

from __future__ import annotations

import errno
import os
from dataclasses import replace

import numpy as np
import pytest

from musculoskeletal_ae.learning import network_file, sample_log, session
from musculoskeletal_ae.learning.collector import Collector
from musculoskeletal_ae.learning.journal import Journal
from musculoskeletal_ae.learning.session import Session
from musculoskeletal_ae.learning.store import SampleStore
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.residuals import AnomalyStatistics

STEPS = ('mkdir', 'link', 'replace', 'rename', 'unlink', 'rmdir', 'fsync')


class Killed(BaseException):
    """Nothing runs after a kill, no `except Exception` and no clean-up."""


class Disk:
    """From its `at`-th step on, every step on the disk fails; none where `at` is 0."""

    def __init__(self, monkeypatch) -> None:
        self.at, self.step, self.error = 0, 0, OSError(errno.ENOSPC, 'No space left on device')
        for name in STEPS:
            monkeypatch.setattr(os, name, self._counted(getattr(os, name)))
        monkeypatch.setattr(sample_log, '_write', self._torn(sample_log._write))

    def fail(self, at: int, error: BaseException | None = None) -> None:
        self.at, self.step, self.error = at, 0, error or self.error

    def _due(self) -> bool:
        self.step += 1
        return 0 < self.at <= self.step

    def _counted(self, function):
        def call(*args, **options):
            if self._due():
                raise self.error
            return function(*args, **options)

        return call

    def _torn(self, function):
        def write(file, data):
            if self._due():
                file.write(data[: len(data) // 2])
                raise self.error
            return function(file, data)

        return write


@pytest.fixture
def disk(monkeypatch):
    monkeypatch.setattr(sample_log, 'PAUSE', 0.0)
    monkeypatch.setattr(network_file, 'PAUSE', 0.0)
    return Disk(monkeypatch)


class Idle:
    """In the place of a training process."""

    trouble, busy, restarts, pid = '', False, 0, None

    def __init__(self, begin_with) -> None:
        self.running, self.begin_with = False, begin_with

    def start(self) -> None:
        self.begin_with()
        self.running, self.busy = True, False

    def stop(self) -> None:
        self.running = self.busy = False

    def poll(self) -> None:
        return None

    def can_take(self, _) -> bool:
        return False


@pytest.fixture
def begun(arm26, initial, tmp_path, monkeypatch):
    """Return what starts a session in one directory, with a network and a stage's samples."""
    monkeypatch.setattr(session, 'Supervisor', Idle)
    file = tmp_path / 'initial.safetensors'
    checkpoint.save(initial, file)
    open_ones = []

    def begin():
        for one in open_ones:
            one.close()
        collector = Collector(arm26)
        new = Session(arm26, collector, 'default', 0, 1, tmp_path / 'state', begin.published.append)
        if new.data is None:
            new.begin(file)
        open_ones.append(new)
        return new, collector.store

    begin.file, begin.published = file, []
    yield begin
    for one in open_ones:
        one.close()


def accept(learning, store, stage, count):
    for _ in range(count):
        sample = stage.sample()
        store.add(sample)
        learning.accept(sample)


def same(one, two):
    assert len(one) == len(two)
    for first, second in zip(one.samples, two.samples, strict=True):
        np.testing.assert_array_equal(np.concatenate(first), np.concatenate(second))


@pytest.mark.parametrize('at', [1, 2, 3, 4])
def test_samples_that_came_while_the_disk_was_full_are_written_when_it_is_not(
    begun, stage, disk, at
):
    learning, store = begun()
    accept(learning, store, stage, 3)
    disk.fail(at)
    accept(learning, store, stage, 4)
    learning.poll(True)
    assert 'samples cannot be saved' in learning.trouble
    disk.fail(0)
    learning.poll(True)
    assert learning.trouble == ''
    accept(learning, store, stage, 2)
    same(begun()[1], store)


def test_a_learner_that_starts_with_a_full_disk_goes_on_with_what_it_has(begun, stage, disk):
    learning, store = begun()
    accept(learning, store, stage, 5)
    disk.fail(1)
    learning, found = begun()
    same(found, store)
    assert learning.data is not None
    assert 'No space left' in learning.trouble
    disk.fail(0)
    accept(learning, found, stage, 1)
    assert learning.trouble == ''
    same(begun()[1], found)


def test_a_network_that_could_not_be_saved_is_saved_later(begun, disk, tmp_path):
    learning, _ = begun()
    file = tmp_path / 'state' / 'checkpoint.safetensors'
    file.unlink()
    # As the training process says it.
    learning._journal.network.outcome('No space left on device')
    disk.fail(1)
    learning.poll(True)
    assert 'network cannot be saved' in learning.trouble
    assert not file.exists()
    disk.fail(0)
    learning.poll(True)
    assert learning.trouble == ''
    assert file.exists()


def test_a_checkpoint_that_is_refused_by_a_full_disk_leaves_the_one_in_use(begun, stage, disk):
    for at in range(1, 30):
        learning, store = begun()
        store_before, data = SampleStore(), learning.data
        accept(learning, store, stage, 2)
        for sample in store.samples:
            store_before.add(sample)
        disk.fail(at)
        try:
            learning.replace(begun.file)
        except OSError:
            disk.fail(0)
            assert learning.data == data
            assert learning._training.running
            same(store, store_before)
            learning.save()
            same(begun()[1], store_before)
            continue
        disk.fail(0)
        learning.poll(True)
        assert len(store) == 0
        assert len(begun()[1]) == 0
        return
    raise AssertionError('never done')


def test_a_kill_while_a_state_is_replaced_leaves_all_of_one(tmp_path, arm26, initial, stage, disk):
    outcomes = []
    for at in range(1, 60):
        directory = tmp_path / str(at)
        journal, store = Journal(directory, arm26), SampleStore()
        journal.load(store)
        for _ in range(3):
            store.add(stage.sample())
            journal.log.append(store.samples[-1], store)
        journal.network.save(replace(initial, version=5))
        disk.fail(at, Killed())
        try:
            journal.replace(replace(initial, version=9))
        except Killed:
            finished = False
        else:
            finished = True
        disk.fail(0)
        journal.close()
        found = SampleStore()
        journal = Journal(directory, arm26)
        mae = journal.load(found)
        journal.close()
        outcomes.append((len(found), mae.version))
        assert not list(directory.glob('*.tmp'))
        if finished:
            break
    assert set(outcomes) == {(3, 5), (0, 9)}
    assert outcomes == sorted(outcomes, reverse=True)
    assert outcomes[-1] == (0, 9)


def test_a_muscle_relearned_while_it_trains_leaves_no_calibrated_detector_anywhere(
    begun, arm26, initial, stage, tmp_path
):
    learning, store = begun()
    accept(learning, store, stage, 3)
    calibrated = AnomalyStatistics(np.zeros(12), np.eye(12), True, 100)
    # The training process has saved what it learned, and is killed with its answer.
    file = tmp_path / 'state' / 'checkpoint.safetensors'
    before = checkpoint.from_bytes(learning.data, arm26).version
    checkpoint.save(replace(initial, version=before + 1, anomaly=calibrated), file)
    learning._version, learning._training.busy = before + 1, True
    learning.relearn(2)
    assert learning._training.running
    assert not learning._training.busy
    on_disk = checkpoint.load(file, arm26)
    assert on_disk.version == before + 2
    assert on_disk.anomaly is None or not on_disk.anomaly.calibrated
    found, samples = begun()
    assert checkpoint.from_bytes(found.data, arm26).version == on_disk.version
    assert not any(known[2] for known in samples.known)


def test_a_muscle_that_a_full_disk_does_not_let_be_relearned_stays_known(begun, stage, disk):
    learning, store = begun()
    accept(learning, store, stage, 3)
    learning._training.busy = True
    disk.fail(1)
    with pytest.raises(OSError, match='No space left'):
        learning.relearn(2)
    assert all(known[2] for known in store.known)
    assert learning._training.running
