# SPDX-License-Identifier: Apache-2.0
"""A restarted estimator knows that its length offsets have been calibrated or revoked."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from musculoskeletal_ae.estimation.lengths.offset_memory import FILE, OffsetMemory
from musculoskeletal_ae.signals.body_state import LengthOffsets, Trust

MUSCLES = ['biceps', 'triceps']
FOUND = LengthOffsets(np.array([0.05, -0.08]), np.full(2, 1e-3), generation=12)
ASSUMED = LengthOffsets.none(2)


@pytest.fixture
def memory(tmp_path):
    return OffsetMemory(tmp_path / 'new', MUSCLES)


def found_later(tmp_path, muscles=MUSCLES):
    return OffsetMemory(tmp_path / 'new', muscles).found


def test_the_next_estimator_finds_calibrated_offsets_by_the_names_of_the_muscles(memory, tmp_path):
    memory.note(FOUND)
    found = found_later(tmp_path, ['triceps', 'brachialis', 'biceps'])
    assert_array_equal(found.offset, [-0.08, 0.0, 0.05])
    assert found.generation == 12


def test_absolute_sensors_leave_no_file(memory, tmp_path):
    memory.note(ASSUMED)
    assert found_later(tmp_path) is None
    revoked = replace(ASSUMED, trust=np.array([Trust.REVOKED, Trust.KNOWN]), generation=2)
    memory.note(revoked)
    assert found_later(tmp_path) is not None
    memory.note(replace(ASSUMED, generation=3))  # joint sensors agree with the lengths again
    assert found_later(tmp_path) is None


def test_provisional_offsets_of_a_calibration_are_not_saved(memory, tmp_path):
    memory.note(FOUND)
    memory.note(replace(LengthOffsets.unknown(2), generation=13))
    for generation in (14, 15):
        provisional = replace(FOUND, trust=np.full(2, Trust.UNKNOWN), generation=generation)
        memory.note(provisional)
    assert found_later(tmp_path).generation == 13


@pytest.mark.parametrize(
    'content', ['', 'null', '[1]', '{"generation": 1, "offset": {"biceps": 1e9}}', '\0']
)
def test_a_damaged_file_still_says_that_the_offsets_are_unknown(tmp_path, content):
    (tmp_path / FILE).write_text(content)
    found = OffsetMemory(tmp_path, MUSCLES).found
    assert_array_equal(found.offset, np.zeros(2))


def test_offsets_that_cannot_be_saved_are_reported_and_change_nothing_else(tmp_path):
    file = tmp_path / 'file'
    file.write_text('')
    memory = OffsetMemory(file, MUSCLES)
    memory.note(FOUND)
    assert 'cannot be saved' in memory.problem
    assert OffsetMemory(None, MUSCLES).found is None
