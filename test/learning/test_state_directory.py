# SPDX-License-Identifier: Apache-2.0
"""The saved state survives a kill of the learner and failures of the disk at any moment."""

import errno
import resource
import shutil
from contextlib import closing, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from robots import copy_robot, read_muscles, write_muscles

from musculoskeletal_ae.body_model.observations import Sample
from musculoskeletal_ae.estimation.network_validation.validator import CheckpointValidator
from musculoskeletal_ae.exceptions import GateError, StateError
from musculoskeletal_ae.learning import state_directory as states
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.learning.state_directory import LOCK, NEWEST, PREVIOUS, StateStore
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.robot.robot import Robot

from .test_learner import IdleTrainer, accept

BACKUP = 'backup-1.state'


@pytest.fixture(autouse=True)
def no_pause(monkeypatch):
    monkeypatch.setattr(states, 'RETRY_INTERVAL', 0.0)


def written(directory, robot, stage, count, network=None):
    """Save one sample after another; return them."""
    store = SampleStore()
    with closing(StateStore(directory, robot)) as state:
        for _ in range(count):
            store.add(stage.sample())
            state.save(store, network)
    return store


def read(directory, robot):
    """Return the samples and the network that a learner reads, and a text about unusable files.

    The text is '' if all files were usable.
    """
    store = SampleStore()
    with closing(StateStore(directory, robot)) as state:
        mae = state.load(store)
        return store, mae, state.not_used


def read_backup(directory, robot, scratch):
    """Read the backup in `directory` as a learner would; return its samples and network."""
    scratch.mkdir()
    shutil.copy(directory / BACKUP, scratch / NEWEST)
    store, mae, not_used = read(scratch, robot)
    assert not_used == ''
    return store, mae


def numbers(store):
    return [each.number for each in store.stored]


def assert_same(one, two):
    assert numbers(one) == numbers(two)
    for first, second in zip(one.stored, two.stored, strict=True):
        for part, other in zip(first.sample, second.sample, strict=True):
            np.testing.assert_array_equal(part, other)
        np.testing.assert_array_equal(first.known, second.known)


@contextmanager
def full_disk():
    """Make every write to a file fail in this context, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


# -- loading --------------------------------------------------------------------------------------


def test_samples_and_network_come_back_to_the_bit(tmp_path, arm26, initial):
    gravity = np.full(3 * len(arm26.kinematics.tree.parent), np.nan)
    gravity[3:6] = 0.0, 0.6, -0.8
    plain = Sample(np.array([0.1, np.nan]), np.full(6, 50.0), np.zeros(6), np.ones(6))
    store = SampleStore()
    for sample in (
        plain,
        plain._replace(spread=np.full(2, 0.02), gravity=gravity),
    ):
        store.add(sample)
    store.forget(1, before=2)
    with closing(StateStore(tmp_path, arm26)) as state:
        state.save(store, checkpoint.to_bytes(replace(initial, version=7)))
    loaded, mae, not_used = read(tmp_path, arm26)
    assert not_used == ''
    assert_same(loaded, store)
    assert mae.version == 7
    np.testing.assert_array_equal(mae.encoder[0][0], initial.encoder[0][0])


def test_a_full_store_comes_back_and_counts_on(tmp_path, arm26, stage):
    store = SampleStore(capacity=5)
    for _ in range(12):
        store.add(stage.sample())
    with closing(StateStore(tmp_path, arm26)) as state:
        state.save(store, None)
    loaded, _, _ = read(tmp_path, arm26)
    assert_same(loaded, store)
    assert loaded.accepted == 12


@pytest.mark.parametrize('renames', [0, 1, 2])
def test_a_learner_killed_while_it_saves_has_the_state_before_or_after(
    tmp_path, arm26, stage, monkeypatch, renames
):
    before = written(tmp_path, arm26, stage, 3)

    class Killed(BaseException):
        pass

    replace_file, done = Path.replace, []

    def replace_or_die(file, target):
        if len(done) == renames:
            raise Killed
        done.append(target)
        return replace_file(file, target)

    def die(*_, **__):  # a killed process does not remove its temporary files
        raise Killed

    with closing(StateStore(tmp_path, arm26)) as state, monkeypatch.context() as patch:
        after = SampleStore()
        state.load(after)
        after.add(stage.sample())
        patch.setattr(Path, 'replace', replace_or_die)
        patch.setattr(Path, 'unlink', die)
        with pytest.raises(Killed) if renames < 2 else nullcontext():
            state.save(after, None)
    loaded, _, not_used = read(tmp_path, arm26)
    assert not_used == ''
    assert_same(loaded, before if renames < 2 else after)
    assert {file.name for file in tmp_path.iterdir()} <= {NEWEST, PREVIOUS, LOCK}


# -- files that cannot be used --------------------------------------------------------------------


def damage(file):
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(bytes(data))


def truncate(file):
    file.write_bytes(file.read_bytes()[:-100])


def empty(file):
    file.write_bytes(b'')


def be_foreign(file):
    file.write_bytes(b'SQLite format 3\x00' + bytes(5000))


def be_huge(file):
    with file.open('wb') as stream:
        stream.truncate(1 << 31)


def be_a_folder(file):
    file.unlink()
    file.mkdir()


@pytest.mark.parametrize('spoil', [damage, truncate, empty, be_foreign, be_huge, be_a_folder])
def test_a_file_that_cannot_be_used_is_kept_and_the_one_before_it_is_used(
    tmp_path, arm26, stage, spoil
):
    store = written(tmp_path, arm26, stage, 4)
    spoil(tmp_path / NEWEST)
    loaded, _, not_used = read(tmp_path, arm26)
    assert numbers(loaded) == numbers(store)[:-1]
    assert NEWEST in not_used and BACKUP in not_used
    assert (tmp_path / BACKUP).exists()
    again, _, not_used = read(tmp_path, arm26)
    assert_same(again, loaded)
    assert not_used == ''


def test_without_a_usable_state_learning_restarts_with_a_report(tmp_path, arm26, stage, initial):
    written(tmp_path, arm26, stage, 3)
    for name in (NEWEST, PREVIOUS):
        damage(tmp_path / name)
    with closing(Learner(arm26, initial, trainer=IdleTrainer, directory=tmp_path)) as learner:
        message = learner.report().values['saved state not used']
        assert 'learning starts again' in message
        assert 'backup-1.state' in message and 'backup-2.state' in message
        assert len(learner.samples) == 0
        accept(learner, stage, 2)
    assert_same(read(tmp_path, arm26)[0], learner.samples)
    assert len(list(tmp_path.glob('backup-*'))) == 2


def test_another_robots_state_is_kept_whole_and_not_used(tmp_path, arm26, stage):
    store = written(tmp_path, arm26, stage, 1)
    loaded, mae, not_used = read(tmp_path, Robot.load('musashi_left_arm'))
    assert (len(loaded), mae) == (0, None)
    assert arm26.muscles[0] in not_used
    assert_same(read_backup(tmp_path, arm26, tmp_path / 'scratch')[0], store)


def test_a_network_that_cannot_be_used_does_not_cost_the_samples(tmp_path, arm26, stage):
    store = written(tmp_path, arm26, stage, 3, b'no checkpoint')
    loaded, mae, not_used = read(tmp_path, arm26)
    assert_same(loaded, store)
    assert mae is None
    assert 'reason: not safetensors' in not_used and BACKUP in not_used
    assert 'make one with `train`' not in not_used
    again, _, not_used = read(tmp_path, arm26)
    assert_same(again, store)
    assert not_used == ''


def test_a_robot_with_another_muscle_takes_the_samples_over(tmp_path, arm26, stage, initial):
    added = 2
    directory = copy_robot('arm26', tmp_path / 'small')
    document = read_muscles(directory)
    del document['muscles'][added]
    small = Robot.load(write_muscles(directory, document))
    kept = [m for m in range(arm26.muscle_count) if m != added]
    network = initial_mae(small, 'default', steps=2)
    store = SampleStore()
    for _ in range(4):
        theta, *parts, spread, gravity = stage.sample()
        store.add(Sample(theta, *(part[kept] for part in parts), spread, gravity))
    store.forget(0, before=4)
    with closing(StateStore(tmp_path, small)) as state:
        state.save(store, checkpoint.to_bytes(network))
    with closing(Learner(arm26, initial, directory=tmp_path, trainer=IdleTrainer)) as learner:
        loaded = learner.samples
        assert numbers(loaded) == numbers(store)
        for one, other in zip(loaded.samples, store.samples, strict=True):
            np.testing.assert_array_equal(one.theta, other.theta)
            np.testing.assert_array_equal(one.length[kept], other.length)
            np.testing.assert_array_equal(one.direction[kept], other.direction)
        for one, other in zip(loaded.stored, store.stored, strict=True):
            np.testing.assert_array_equal(one.known[kept], other.known)
            assert not one.known[added]
        assert arm26.muscles[added] in learner.report().values['saved state not used']
        # The four loaded samples cause four updates, as new ones do. Then the learner waits.
        for now in range(10):
            learner.poll(2.0 * now)
        assert learner.updates == 4
    assert_same(read(tmp_path, arm26)[0], loaded)
    (tmp_path / BACKUP).rename(tmp_path / NEWEST)
    assert_same(read(tmp_path, small)[0], store)


# -- one learner per directory --------------------------------------------------------------------


def test_a_directory_serves_one_learner_at_a_time(tmp_path, arm26):
    with closing(StateStore(tmp_path, arm26)), pytest.raises(StateError, match='another learner'):
        StateStore(tmp_path, arm26)
    StateStore(tmp_path, arm26).close()


@pytest.mark.parametrize('place', ['file/state', 'nul\0'])
def test_a_directory_that_cannot_be_created_is_reported_with_a_remedy(tmp_path, arm26, place):
    (tmp_path / 'file').write_text('x')
    with pytest.raises(
        StateError, match=r'state_directory.*cannot be written.*to a writable directory'
    ):
        StateStore(tmp_path / place, arm26)


# -- a disk that fails ----------------------------------------------------------------------------


@pytest.fixture
def begun(arm26, initial, tmp_path):
    """Return a function that ends the last learner, and starts another in the same directory."""
    learners = []

    def begin():
        for learner in learners:
            learner.close()
        learners.append(Learner(arm26, initial, trainer=IdleTrainer, directory=tmp_path / 'state'))
        return learners[-1]

    yield begin
    for learner in learners:
        learner.close()


def test_what_came_while_the_disk_was_full_is_counted_and_saved_when_it_is_not(begun, stage):
    learner = begun()
    accept(learner, stage, 3)
    with full_disk():
        accept(learner, stage, 4)
        learner.relearn([2])
        while not learner.updates:
            learner.poll(0.0)
        assert learner.report().level == 'error'
        assert 'samples not on disk yet: 4;' in learner.report().message
        with pytest.raises(StateError, match='not on disk yet: 4;'):
            learner.save()
    learner.poll(0.1)
    assert learner.report().level == 'ok'
    again = begun()
    assert_same(again.samples, learner.samples)
    assert again.mae.version == learner.mae.version


def test_a_learner_that_starts_with_a_full_disk_goes_on_with_what_it_has(begun, stage):
    before = begun()
    accept(before, stage, 5)
    before.close()
    with full_disk():
        learner = begun()
        assert_same(learner.samples, before.samples)
        assert learner.mae.version == before.mae.version
        accept(learner, stage, 1)
        assert 'not on disk yet: 1;' in learner.report().message
    learner.poll(0.0)
    assert learner.report().level == 'ok'
    assert_same(begun().samples, learner.samples)


def test_a_directory_that_became_read_only_is_an_error_until_it_is_not(begun, stage, monkeypatch):
    learner = begun()
    accept(learner, stage, 3)

    def read_only(*_):
        raise OSError(errno.EROFS, 'Read-only file system')

    # The test may run as root, whom the mode of a file does not restrict. Replace the function that
    # writes instead.
    with monkeypatch.context() as patch:
        patch.setattr(states, 'write_whole', read_only)
        accept(learner, stage, 1)
        assert 'Read-only' in learner.report().message
    learner.poll(0.1)
    assert learner.report().level == 'ok'
    assert_same(begun().samples, learner.samples)


def test_a_directory_that_is_deleted_is_made_again_with_the_next_sample(begun, stage, tmp_path):
    learner = begun()
    accept(learner, stage, 1)  # one sample does not cause an update, which would save the state
    shutil.rmtree(tmp_path / 'state')
    accept(learner, stage, 2)
    assert learner.report().level == 'ok'
    with pytest.raises(StateError, match='another learner'):
        StateStore(tmp_path / 'state', learner.robot)
    assert_same(begun().samples, learner.samples)
    assert len(learner.samples) == 3


# -- replacing a state ----------------------------------------------------------------------------


def test_a_state_that_is_replaced_is_kept_whole(begun, stage, initial, arm26, tmp_path):
    learner = begun()
    accept(learner, stage, 3)
    learner.close()
    before, mae, _ = read(tmp_path / 'state', arm26)
    learner = begun()
    version = learner.mae.version
    learner.replace(initial)
    accept(learner, stage, 1)
    kept, backed_up = read_backup(tmp_path / 'state', arm26, tmp_path / 'scratch')
    assert_same(kept, before)
    assert mae.version <= backed_up.version == version
    again = begun()
    assert_same(again.samples, learner.samples)
    assert again.mae.version > version


def test_a_saved_network_that_is_refused_becomes_one_backup_and_its_samples_stay(
    begun, stage, arm26, tmp_path, monkeypatch
):
    before = begun()
    accept(before, stage, 3)
    before.close()

    def refuse(*_):
        raise GateError('it does not explain the arm')

    with monkeypatch.context() as patch:
        patch.setattr(CheckpointValidator, 'check', refuse)
        messages = []
        # The first start rejects the saved network; the second start finds none.
        for _ in range(2):
            with closing(
                Learner(arm26, trainer=IdleTrainer, directory=tmp_path / 'state')
            ) as again:
                assert_same(again.samples, before.samples)
                messages.append(again.report().values.get('saved state not used', ''))
    assert 'does not explain the arm' in messages[0] and BACKUP in messages[0]
    assert messages[1] == ''
    assert len(list((tmp_path / 'state').glob('backup-*'))) == 1
    assert_same(read_backup(tmp_path / 'state', arm26, tmp_path / 'scratch')[0], before.samples)
    learner = begun()  # this learner starts without a network, and learns from the saved samples
    for now in range(10):
        learner.poll(2.0 * now)
    assert learner.updates == 3


def test_a_state_that_a_full_disk_does_not_let_be_replaced_stays(begun, stage, initial, tmp_path):
    learner = begun()
    accept(learner, stage, 3)
    data, samples = learner.checkpoint, list(learner.samples.samples)
    with full_disk(), pytest.raises(StateError, match='no backup can be made'):
        learner.replace(initial)
    assert learner.checkpoint == data
    assert learner.samples.samples == samples
    assert not list((tmp_path / 'state').glob('backup-*'))
    assert_same(begun().samples, learner.samples)
