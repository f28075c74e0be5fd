# SPDX-License-Identifier: Apache-2.0
"""The state of version 0.1 is converted once, and kept."""

from __future__ import annotations

import json
import struct
import zlib

import numpy as np
import pytest

from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.robot.robot import Robot

from .test_state import full_disk, read, same


def record(kind, values):
    payload = values.astype('<f8').tobytes()
    return struct.pack('<II', kind, zlib.crc32(struct.pack('<I', kind) + payload)) + payload


def write_old_state(directory, robot, samples, mae=None, forgotten=None):
    """Write what version 0.1 kept; `forgotten`: a muscle, and how many samples tell of it."""
    directory.mkdir(exist_ok=True)
    names = json.dumps({'joints': robot.joints, 'muscles': robot.muscles}).encode()
    data = b'MAESMPL1' + struct.pack('<II', len(names), zlib.crc32(names)) + names
    for sample in samples:
        data += record(1, np.concatenate([*sample, np.ones(robot.muscle_count)]))
    if forgotten is not None:
        values = np.zeros(robot.joint_count + 4 * robot.muscle_count)
        values[:2] = forgotten
        data += record(2, values)
    (directory / 'samples.log').write_bytes(data)
    (directory / 'lock').touch()
    if mae is not None:
        checkpoint.save(mae, directory / 'checkpoint.safetensors')
    return data


def store_of(samples):
    store = SampleStore()
    for sample in samples:
        store.add(sample)
    return store


@pytest.fixture
def samples(stage):
    return [stage.sample() for _ in range(5)]


def test_an_old_state_is_converted_once_and_kept(tmp_path, arm26, samples, initial):
    data = write_old_state(tmp_path, arm26, samples, initial, forgotten=(1, 2))
    store = store_of(samples)
    store.forget(1, 2)
    for _ in range(2):
        found, mae, not_used = read(tmp_path, arm26)
        same(found, store)
        assert mae.training == initial.training
        assert not_used == ''
    assert (tmp_path / 'backup-1' / 'samples.log').read_bytes() == data
    assert not (tmp_path / 'samples.log').exists()
    assert not (tmp_path / 'backup-2').exists()


def test_what_the_disk_has_damaged_of_an_old_state_is_left_out(tmp_path, arm26, samples):
    data = bytearray(write_old_state(tmp_path, arm26, samples))
    data[20] ^= 1  # the header
    data[-10] ^= 1
    (tmp_path / 'samples.log').write_bytes(bytes(data))
    found, mae, _ = read(tmp_path, arm26)
    same(found, store_of(samples[:4]))
    assert mae is None


def test_another_robots_old_state_is_kept_and_not_used(tmp_path, arm26, samples, initial):
    write_old_state(tmp_path, arm26, samples, initial)
    found, mae, not_used = read(tmp_path, Robot.load('musashi_left_arm'))
    assert (len(found), mae) == (0, None)
    assert 'samples.log: not made by a learner of these joints' in not_used
    same(read(tmp_path / 'backup-1', arm26)[0], store_of(samples))


def test_an_old_state_stays_until_the_disk_has_taken_it_over(tmp_path, arm26, samples, initial):
    write_old_state(tmp_path, arm26, samples, initial)
    with full_disk():
        found, mae, _ = read(tmp_path, arm26)
        same(found, store_of(samples))
        assert mae is not None
    assert (tmp_path / 'samples.log').exists()
    same(read(tmp_path, arm26)[0], store_of(samples))
    assert (tmp_path / 'backup-1' / 'samples.log').exists()
