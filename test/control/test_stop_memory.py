# SPDX-License-Identifier: Apache-2.0
"""A stop is stored in a file, so the next controller begins with it."""

import shutil

import pytest

from musculoskeletal_ae.conditions import ConditionKind, stop_causes
from musculoskeletal_ae.control.stop_memory import FILE, StopMemory
from musculoskeletal_ae.exceptions import MusculoskeletalError

STOP = ConditionKind.OPERATOR.condition()


def killed(directory):
    """Return a copy of the directory, as it would be if the controller were killed now."""
    copy = directory.with_name(f'{directory.name}_of_killed')
    return shutil.copytree(directory, copy, dirs_exist_ok=True)


def found(directory):
    """Return the stop cause with which the next controller begins, or None without a stop."""
    memory = StopMemory(directory)
    memory.close()
    return memory.found and memory.found.kind


def test_a_controller_that_never_commanded_the_arm_leaves_nothing(tmp_path):
    StopMemory(tmp_path / 'arm').close()
    assert found(tmp_path / 'arm') is None


@pytest.mark.parametrize('cause', stop_causes())
def test_every_latched_stop_outlives_a_kill_and_a_proper_end(tmp_path, cause):
    arm = tmp_path / 'arm'
    memory = StopMemory(arm)
    memory.note(None)
    memory.note(cause.condition('a detail\nof two lines'))
    assert found(killed(arm)) is cause
    memory.close()
    assert found(arm) is cause
    assert found(arm) is cause  # starting and ending a controller does not end the stop


def test_a_killed_controller_counts_as_a_stop_and_a_proper_end_does_not(tmp_path):
    arm = tmp_path / 'arm'
    memory = StopMemory(arm)
    memory.note(None)
    assert found(killed(arm)) is ConditionKind.RESTARTED
    memory.close()
    assert found(arm) is None


def test_a_killed_controller_counts_as_a_stop_also_after_the_next_one_has_ended(tmp_path):
    arm = tmp_path / 'arm'
    StopMemory(arm).note(None)
    copy = killed(arm)
    assert found(copy) is ConditionKind.RESTARTED
    assert found(copy) is ConditionKind.RESTARTED


def test_a_reset_ends_a_stop_for_the_next_controller_too(tmp_path):
    arm = tmp_path / 'arm'
    first = StopMemory(arm)
    first.note(STOP)
    first.close()
    second = StopMemory(arm)
    second.note(second.found)
    second.note(None)
    second.close()
    assert found(arm) is None


@pytest.mark.parametrize('data', [b'', b'\xff\x00', b'no_such_cause\n', b'x' * 20_000])
def test_a_damaged_file_counts_as_a_stop(tmp_path, data):
    (tmp_path / FILE).write_bytes(data)
    assert found(tmp_path) is ConditionKind.RESTARTED


def test_a_second_controller_of_the_same_arm_is_refused(tmp_path):
    first = StopMemory(tmp_path)
    first.note(STOP)
    with pytest.raises(MusculoskeletalError, match='in use by a controller; stop that controller'):
        StopMemory(tmp_path)
    first.close()
    assert found(tmp_path) is ConditionKind.OPERATOR


@pytest.mark.parametrize('name', ['file/arm', 'nul\0'])
def test_a_directory_that_cannot_be_used_is_refused_with_a_remedy(tmp_path, name):
    (tmp_path / 'file').touch()
    with pytest.raises(MusculoskeletalError, match=r'cannot be used .* to a writable directory'):
        StopMemory(tmp_path / name)


def test_a_stop_that_cannot_be_written_is_reported(tmp_path):
    arm = tmp_path / 'arm'
    memory = StopMemory(arm)
    shutil.rmtree(arm)
    arm.write_text('')  # a file in place of the directory
    memory.note(STOP)
    assert 'the stop cannot be saved' in memory.problem


def test_without_a_directory_nothing_is_kept():
    memory = StopMemory(None)
    memory.note(STOP)
    memory.close()
    assert memory.found is None and memory.problem == ''
