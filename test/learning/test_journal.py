# SPDX-License-Identifier: Apache-2.0
"""What is on disk survives every way in which a learner can end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from musculoskeletal_ae.exceptions import StateError
from musculoskeletal_ae.learning.journal import Journal
from musculoskeletal_ae.learning.store import SampleStore
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.robot.robot import Robot

RECORD = 8 + 8 * (2 + 4 * 6)  # bytes


def written(directory, robot, stage, count):
    store, journal = SampleStore(), Journal(directory, robot)
    journal.load(store)
    for _ in range(count):
        sample = stage.sample()
        store.add(sample)
        journal.log.append(sample, store)
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
    for cut in (1, 9, RECORD - 1):
        (tmp_path / 'samples.log').write_bytes(whole[:-cut])
        found, _ = read(tmp_path, arm26)
        assert len(found) == 3
        del store.samples[3:]
        same(found, store)


@settings(max_examples=30)
@given(place=st.integers(0, 1000), bit=st.integers(0, 7))
def test_a_damaged_bit_costs_the_record_it_is_in_and_no_other(tmp_path_factory, arm26, place, bit):
    from musculoskeletal_ae.learning.body import CorrectedBody

    from .conftest import Stage

    directory = tmp_path_factory.mktemp('journal')
    written(directory, arm26, Stage(CorrectedBody(arm26)), 5)
    data = bytearray((directory / 'samples.log').read_bytes())
    data[place] ^= 1 << bit
    (directory / 'samples.log').write_bytes(bytes(data))
    header = len(data) - 5 * RECORD
    found, _ = read(directory, arm26)
    assert len(found) == (5 if place < header else 4)
    assert not list(directory.glob('backup-*'))


def test_what_was_forgotten_stays_forgotten(tmp_path, arm26, stage):
    store, journal = SampleStore(), Journal(tmp_path, arm26)
    journal.load(store)
    for _ in range(3):
        sample = stage.sample()
        store.add(sample)
        journal.log.append(sample, store)
    store.forget(1, 1)
    journal.log.forget(1, 1, store)
    journal.close()
    found, _ = read(tmp_path, arm26)
    assert [known[1] for known in found.known] == [False, False, True]
    again, _ = read(tmp_path, arm26)
    assert [known[1] for known in again.known] == [False, False, True]


def test_the_log_does_not_grow_without_end(tmp_path, arm26, stage, monkeypatch):
    monkeypatch.setattr('musculoskeletal_ae.learning.sample_log.SURPLUS', 5)
    store, journal = SampleStore(capacity=5), Journal(tmp_path, arm26)
    journal.load(store)
    sizes = []
    for _ in range(60):
        sample = stage.sample()
        store.add(sample)
        journal.log.append(sample, store)
        sizes.append((tmp_path / 'samples.log').stat().st_size)
    journal.close()
    assert max(sizes[30:]) <= max(sizes[:30])
    same(read(tmp_path, arm26)[0], store)


def test_another_robots_state_is_kept_whole_and_not_used(tmp_path, arm26, stage):
    written(tmp_path, arm26, stage, 2)
    before = (tmp_path / 'samples.log').read_bytes()
    store, journal = SampleStore(), Journal(tmp_path, Robot.load('musashi_left_arm'))
    assert journal.load(store) is None
    assert 'samples.log: not made by a learner of these joints' in journal.not_used
    journal.close()
    assert len(store) == 0
    assert (tmp_path / 'backup-1' / 'samples.log').read_bytes() == before


def test_a_damaged_network_does_not_cost_the_samples(tmp_path, arm26, stage):
    store = written(tmp_path, arm26, stage, 3)
    (tmp_path / 'checkpoint.safetensors').write_bytes(b'nonsense')
    found, mae = read(tmp_path, arm26)
    same(found, store)
    assert mae is None
    assert (tmp_path / 'backup-1' / 'checkpoint.safetensors').read_bytes() == b'nonsense'
    same(read(tmp_path, arm26)[0], store)


def test_an_unreadable_log_does_not_cost_the_network(tmp_path, arm26, initial):
    checkpoint.save(initial, tmp_path / 'checkpoint.safetensors')
    (tmp_path / 'samples.log').write_bytes(b'nonsense' * 100)
    found, mae = read(tmp_path, arm26)
    assert len(found) == 0
    assert mae.training == initial.training


def test_a_state_that_is_replaced_is_kept_whole(tmp_path, arm26, stage, initial):
    store = written(tmp_path, arm26, stage, 3)
    checkpoint.save(initial, tmp_path / 'checkpoint.safetensors')
    journal = Journal(tmp_path, arm26)
    journal.replace(replace(initial, version=7))
    sample = stage.sample()
    after = SampleStore()
    after.add(sample)
    journal.log.append(sample, after)
    journal.close()
    same(read(tmp_path / 'backup-1', arm26)[0], store)
    assert read(tmp_path / 'backup-1', arm26)[1].training == initial.training
    found, mae = read(tmp_path, arm26)
    same(found, after)
    assert mae.version == 7


def test_what_kills_have_left_unfinished_is_removed(tmp_path, arm26):
    (tmp_path / '.checkpoint.safetensors.abc').write_bytes(b'half of a network')
    (tmp_path / 'backup-1.tmp').mkdir()
    Journal(tmp_path, arm26).close()
    assert [file.name for file in tmp_path.iterdir()] == ['lock']


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
