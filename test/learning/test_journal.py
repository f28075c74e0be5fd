# SPDX-License-Identifier: Apache-2.0
"""What is on disk survives every way in which a learner can end."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from musculoskeletal_ae.exceptions import StateError
from musculoskeletal_ae.learning.journal import Journal
from musculoskeletal_ae.learning.store import SampleStore
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.robot.robot import Robot


def written(directory, robot, stage, count):
    store, journal = SampleStore(), Journal(directory, robot)
    journal.load(store)
    for _ in range(count):
        sample = stage.sample()
        store.add(sample)
        journal.append(sample, store)
    journal.close()
    return store


def read(directory, robot):
    store, journal = SampleStore(), Journal(directory, robot)
    mae = journal.load(store)
    journal.close()
    return store, mae


def same(one, two):
    for first, second in zip(one.samples, two.samples, strict=True):
        for a, b in zip(first, second, strict=True):
            np.testing.assert_array_equal(a, b)


def test_samples_come_back_to_the_bit(tmp_path, arm26, stage):
    store = written(tmp_path, arm26, stage, 5)
    same(read(tmp_path, arm26)[0], store)


def test_a_torn_tail_loses_only_the_record_that_was_being_written(tmp_path, arm26, stage):
    store = written(tmp_path, arm26, stage, 4)
    whole = (tmp_path / 'samples.log').read_bytes()
    size = 8 + 8 * (2 + 4 * 6)
    for cut in (1, 9, size - 1):
        (tmp_path / 'samples.log').write_bytes(whole[:-cut])
        found, _ = read(tmp_path, arm26)
        assert len(found) == 3
        del store.samples[3:]
        same(found, store)


@settings(max_examples=30)
@given(place=st.integers(150, 1000), bit=st.integers(0, 7))
def test_a_damaged_record_is_left_out_and_the_others_stay(tmp_path_factory, arm26, place, bit):
    from musculoskeletal_ae.learning.body import CorrectedBody

    from .conftest import Stage

    directory = tmp_path_factory.mktemp('journal')
    written(directory, arm26, Stage(CorrectedBody(arm26)), 5)
    data = bytearray((directory / 'samples.log').read_bytes())
    data[place] ^= 1 << bit
    (directory / 'samples.log').write_bytes(bytes(data))
    try:
        found, _ = read(directory, arm26)
    except StateError:
        return  # the header itself was hit
    assert len(found) == 4


def test_what_was_forgotten_stays_forgotten(tmp_path, arm26, stage):
    store, journal = SampleStore(), Journal(tmp_path, arm26)
    journal.load(store)
    for _ in range(3):
        sample = stage.sample()
        store.add(sample)
        journal.append(sample, store)
    journal.forget(1, 1)
    journal.close()
    found, _ = read(tmp_path, arm26)
    assert [known[1] for known in found.known] == [False, False, True]
    again, _ = read(tmp_path, arm26)
    assert [known[1] for known in again.known] == [False, False, True]


def test_the_log_does_not_grow_without_end(tmp_path, arm26, stage, monkeypatch):
    monkeypatch.setattr('musculoskeletal_ae.learning.journal.SURPLUS', 5)
    store, journal = SampleStore(capacity=5), Journal(tmp_path, arm26)
    journal.load(store)
    sizes = []
    for _ in range(60):
        sample = stage.sample()
        store.add(sample)
        journal.append(sample, store)
        sizes.append((tmp_path / 'samples.log').stat().st_size)
    journal.close()
    assert max(sizes[30:]) <= max(sizes[:30])
    same(read(tmp_path, arm26)[0], store)


def test_another_robots_state_is_refused_and_left_alone(tmp_path, arm26, stage):
    written(tmp_path, arm26, stage, 2)
    before = (tmp_path / 'samples.log').read_bytes()
    with pytest.raises(StateError, match=r'samples\.log'):
        read(tmp_path, Robot.load('musashi_left_arm'))
    assert (tmp_path / 'samples.log').read_bytes() == before


def test_a_state_that_is_set_aside_is_kept_whole(tmp_path, arm26, stage, initial):
    store = written(tmp_path, arm26, stage, 3)
    checkpoint.save(initial, tmp_path / 'checkpoint.safetensors')
    journal = Journal(tmp_path, arm26)
    backup = journal.set_aside()
    journal.close()
    same(read(backup, arm26)[0], store)
    assert read(backup, arm26)[1].training == initial.training
    assert len(read(tmp_path, arm26)[0]) == 0


def test_a_directory_serves_one_learner_at_a_time(tmp_path, arm26):
    journal = Journal(tmp_path, arm26)
    with pytest.raises(StateError, match='another learner'):
        Journal(tmp_path, arm26)
    journal.close()
    Journal(tmp_path, arm26).close()


def test_a_directory_that_cannot_be_made_is_named(tmp_path, arm26):
    (tmp_path / 'file').write_text('x')
    with pytest.raises(StateError, match='file'):
        Journal(tmp_path / 'file' / 'state', arm26)
