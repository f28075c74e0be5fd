# SPDX-License-Identifier: Apache-2.0
"""A restarted estimator knows which lengths, muscles and joint sensors it must not rely on."""

import time
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from musculoskeletal_ae.estimation.body_memory import FILE, BodyMemory
from musculoskeletal_ae.estimation.detectors.joint_sensor_trust import SensorDoubt
from musculoskeletal_ae.estimation.lengths.length_trust import Evidence, LengthTrust
from musculoskeletal_ae.signals.body_state import BodyState, LengthOffsets, Trust

MUSCLES, JOINTS = ['biceps', 'triceps'], ['shoulder', 'elbow']
OFFSETS = LengthOffsets.of(np.array([0.05, -0.08]), np.full(2, 1e-3))
FOUND = BodyState(OFFSETS, (1,), generation=12)
HEALTHY = BodyState.healthy(2)


@pytest.fixture
def memory(tmp_path):
    return BodyMemory(tmp_path / 'new', MUSCLES)


def found_later(tmp_path, muscles=MUSCLES):
    return BodyMemory(tmp_path / 'new', muscles).found


def test_the_next_estimator_finds_the_body_by_the_names_of_the_muscles(memory, tmp_path):
    memory.note(FOUND)
    found = found_later(tmp_path, ['triceps', 'brachialis', 'biceps'])
    assert_array_equal(found.offsets.offset, [-0.08, 0.0, 0.05])
    assert found.isolated == (0,)
    assert found.generation == 12


def test_a_healthy_body_with_absolute_sensors_leaves_no_file(memory, tmp_path):
    memory.note(HEALTHY)
    assert found_later(tmp_path) is None


def test_absolute_sensors_keep_offsets_that_are_known_to_be_zero(memory, tmp_path):
    memory.note(replace(HEALTHY, isolated=(0,), generation=1))
    found = found_later(tmp_path)
    assert (found.offsets.known, found.isolated, found.generation) == (True, (0,), 1)
    trust = np.array([Trust.REVOKED, Trust.KNOWN])
    revoked = replace(HEALTHY, offsets=replace(HEALTHY.offsets, trust=trust), generation=2)
    memory.note(revoked)
    assert_array_equal(found_later(tmp_path).offsets.offset, np.zeros(2))
    assert not found_later(tmp_path).offsets.known
    memory.note(replace(HEALTHY, generation=3))  # calibrated
    found = found_later(tmp_path)
    assert (found.offsets.known, found.isolated, found.generation) == (True, (), 3)


def test_provisional_offsets_of_a_calibration_are_not_saved_but_isolated_muscles_are(
    memory, tmp_path
):
    memory.note(FOUND)
    memory.note(BodyState(LengthOffsets.unknown(2), (1,), generation=13))
    provisional = replace(OFFSETS, trust=np.full(2, Trust.UNKNOWN))
    memory.note(BodyState(provisional, (1,), generation=14))
    assert found_later(tmp_path).generation == 13
    memory.note(BodyState(provisional, (0, 1), generation=15))
    found = found_later(tmp_path)
    assert_array_equal(found.offsets.offset, np.zeros(2))
    assert not found.offsets.known
    assert found.isolated == (0, 1)


def test_the_next_estimator_finds_joint_sensors_in_doubt_by_their_names_until_the_doubt_ends(
    tmp_path,
):
    memory = BodyMemory(tmp_path, MUSCLES, JOINTS)
    doubts = {1: SensorDoubt(0.5, -0.04, 0.01), 0: SensorDoubt(0.9, 0.0, np.nan)}
    memory.note(HEALTHY, doubts)
    found = BodyMemory(tmp_path, MUSCLES, ['elbow', 'wrist', 'shoulder'])
    assert found.found.offsets.known
    assert found.doubts[0] == doubts[1]
    np.testing.assert_array_equal(found.doubts[2], doubts[0])
    memory.note(HEALTHY, {})
    assert BodyMemory(tmp_path, MUSCLES, JOINTS).doubts == {}


def test_a_length_that_changed_in_a_repair_is_unknown_after_a_restart_until_it_is_checked(tmp_path):
    memory, trust = BodyMemory(tmp_path, MUSCLES), LengthTrust(2)
    for evidence, is_known in ((Evidence.MOVED, False), (Evidence.CHECKED, True)):
        trust.take(evidence, [1])
        assert trust.offsets.known
        memory.note(BodyState(trust.after_restart, generation=1))
        assert BodyMemory(tmp_path, MUSCLES).found.offsets.known == is_known


def test_a_file_of_an_earlier_version_names_no_isolated_muscles(tmp_path):
    (tmp_path / FILE).write_text('{"generation": 5, "offset": {"biceps": 0.05}}')
    found = BodyMemory(tmp_path, MUSCLES).found
    assert_array_equal(found.offsets.offset, [0.05, 0.0])
    assert (found.isolated, found.generation) == ((), 5)


@pytest.mark.parametrize(
    'content', ['', 'null', '[1]', '{"generation": 1, "offset": {"biceps": 1e9}}', '\0']
)
def test_a_damaged_file_still_says_that_the_offsets_are_unknown(tmp_path, content):
    (tmp_path / FILE).write_text(content)
    found = BodyMemory(tmp_path, MUSCLES).found
    assert_array_equal(found.offsets.offset, np.zeros(2))
    assert not found.offsets.known


def test_a_body_that_cannot_be_saved_is_reported_and_changes_nothing_else(tmp_path):
    file = tmp_path / 'file'
    file.write_text('')
    memory = BodyMemory(file, MUSCLES)
    memory.note(FOUND)
    assert 'cannot be saved' in memory.problem
    assert BodyMemory(None, MUSCLES).found is None


def test_a_body_that_could_not_be_saved_in_time_is_saved_later(tmp_path, monkeypatch):
    """After a failed attempt, the memory waits; meanwhile, the body may return and change again."""
    monkeypatch.setattr('musculoskeletal_ae.remembered_text.RETRY_INTERVAL', 0.3)
    memory, away = BodyMemory(tmp_path / 'new', MUSCLES), tmp_path / 'away'
    memory.note(FOUND)
    (tmp_path / 'new').rename(away)
    (tmp_path / 'new').write_text('')
    memory.note(replace(FOUND, isolated=(0,), generation=13))
    assert memory.problem
    (tmp_path / 'new').unlink()
    away.rename(tmp_path / 'new')
    memory.note(replace(FOUND, generation=14))
    newest = replace(FOUND, isolated=(), generation=15)
    end = time.monotonic() + 30.0
    while found_later(tmp_path).isolated and time.monotonic() < end:
        memory.note(newest)
        time.sleep(0.05)
    assert found_later(tmp_path).isolated == () and not memory.problem
