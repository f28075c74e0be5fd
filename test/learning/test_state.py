# SPDX-License-Identifier: Apache-2.0
"""What is on disk survives every way in which a learner or its disk can end."""

import os
import resource
import shutil
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import copy_robot, read_muscles, write_muscles

from musculoskeletal_ae.estimation.gate import Gate
from musculoskeletal_ae.exceptions import GateError, StateError
from musculoskeletal_ae.learning import state as states
from musculoskeletal_ae.learning.body import CorrectedBody
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.samples import Sample, SampleStore
from musculoskeletal_ae.learning.state import FILE, HEAD, MARK, State
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.robot.robot import Robot

from .conftest import Stage
from .test_learner import Prepared, accept


@pytest.fixture(autouse=True)
def no_pause(monkeypatch):
    monkeypatch.setattr(states, 'LOOK', 0.0)
    monkeypatch.setattr(states, 'PAUSE', 0.0)


def written(directory, robot, stage, count, network=None):
    store, state = SampleStore(), State(directory, robot)
    state.load(store)
    for _ in range(count):
        store.add(stage.sample())
        state.keep(store, network)
    state.close()
    return store


def read(directory, robot):
    """Return samples, network, and what was not used."""
    store, state = SampleStore(), State(directory, robot)
    mae = state.load(store)
    state.close()
    return store, mae, state.not_used


def same(one, two):
    assert len(one) == len(two)
    assert one.numbers == two.numbers
    for first, second in zip(one.samples, two.samples, strict=True):
        np.testing.assert_array_equal(np.concatenate(first), np.concatenate(second))
    np.testing.assert_array_equal(one.known, two.known)


@contextmanager
def full_disk():
    """Let every write fail that makes a file larger, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


# -- what comes back ------------------------------------------------------------------------------


def test_samples_and_network_come_back_to_the_bit(tmp_path, arm26, stage, initial):
    data = checkpoint.to_bytes(replace(initial, version=7))
    store = written(tmp_path, arm26, stage, 5, data)
    found, mae, _ = read(tmp_path, arm26)
    same(found, store)
    assert mae.version == 7
    np.testing.assert_array_equal(mae.encoder[0][0], initial.encoder[0][0])


def test_what_was_forgotten_stays_forgotten(tmp_path, arm26, stage):
    store, state = written(tmp_path, arm26, stage, 3), State(tmp_path, arm26)
    store.forget(1, 1)
    state.keep(store, None)
    state.close()
    for _ in range(2):
        found, _, _ = read(tmp_path, arm26)
        assert [bool(known[1]) for known in found.known] == [False, False, True]


def test_the_file_does_not_grow_without_end(tmp_path, arm26, stage):
    store, state = SampleStore(capacity=5), State(tmp_path, arm26)
    state.load(store)
    sizes = []
    for _ in range(60):
        store.add(stage.sample())
        state.keep(store, None)
        sizes.append((tmp_path / FILE).stat().st_size)
    state.close()
    assert max(sizes[30:]) <= max(sizes[:30])
    found, _, _ = read(tmp_path, arm26)
    same(found, store)
    assert found.accepted == 60


# -- damage ---------------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def sound(arm26, tmp_path_factory):
    """Return a file with five samples."""
    directory = tmp_path_factory.mktemp('sound')
    written(directory, arm26, Stage(CorrectedBody(arm26)), 5)
    return directory / FILE


@settings(max_examples=60)
@given(share=st.floats(0.0, 1.0, exclude_max=True), bit=st.integers(0, 7))
def test_a_damaged_bit_costs_the_sample_that_it_is_in_and_no_other(
    tmp_path_factory, arm26, sound, share, bit
):
    directory, data = tmp_path_factory.mktemp('damaged'), bytearray(sound.read_bytes())
    data[int(share * len(data))] ^= 1 << bit
    (directory / FILE).write_bytes(bytes(data))
    found, _, _ = read(directory, arm26)
    assert len(found) >= 4
    # What was found is sound from now on.
    again, _, not_used = read(directory, arm26)
    same(again, found)
    assert not_used == ''


def test_a_damaged_header_costs_no_sample(tmp_path, arm26, sound):
    for place in (0, 16, 18, 28, 100, 101, 103, 4096, 4099, 8192, 8195):
        directory = tmp_path / str(place)
        directory.mkdir()
        data = bytearray(sound.read_bytes())
        data[place] ^= 0xFF
        (directory / FILE).write_bytes(bytes(data))
        found, _, not_used = read(directory, arm26)
        assert len(found) == 5, place
        if not_used:
            assert (directory / 'backup-1' / FILE).read_bytes() == bytes(data)


def test_damaged_table_names_cost_no_sample(tmp_path, arm26, sound):
    data = sound.read_bytes()
    start = data.index(b'table')
    for place in range(start, data.rindex(b'NOT NULL', 0, 4096), 7):
        for flip in (1, 0x80):  # another letter, and none at all
            damaged = bytearray(data)
            damaged[place] ^= flip
            directory = tmp_path / f'{place}-{flip}'
            directory.mkdir()
            (directory / FILE).write_bytes(bytes(damaged))
            for _ in range(2):
                found, _, not_used = read(directory, arm26)
                assert len(found) == 5, place
            assert not_used == ''


def test_a_torn_file_costs_what_is_missing(tmp_path, arm26, sound):
    for cut in (1, 100, 5000):
        directory = tmp_path / str(cut)
        directory.mkdir()
        (directory / FILE).write_bytes(sound.read_bytes()[:-cut])
        found, _, _ = read(directory, arm26)
        assert len(found) >= (4 if cut < 5000 else 0)


def test_a_damaged_network_does_not_cost_the_samples(tmp_path, arm26, stage, initial):
    data = checkpoint.to_bytes(initial)
    store = written(tmp_path, arm26, stage, 3, data)
    file = tmp_path / FILE
    whole = bytearray(file.read_bytes())
    whole[len(whole) - 2000] ^= 1
    file.write_bytes(bytes(whole))
    found, mae, not_used = read(tmp_path, arm26)
    same(found, store)
    assert mae is None
    assert 'network' in not_used
    assert (tmp_path / 'backup-1' / FILE).read_bytes() == bytes(whole)
    same(read(tmp_path, arm26)[0], store)


def test_an_unfit_network_does_not_cost_the_samples(tmp_path, arm26, stage):
    store = written(tmp_path, arm26, stage, 3, b'no checkpoint')
    found, mae, not_used = read(tmp_path, arm26)
    same(found, store)
    assert mae is None
    assert 'not safetensors' in not_used


@pytest.mark.parametrize('content', [b'nonsense' * 1000, b'SQLite format 3\x00' + bytes(5000)])
def test_a_file_that_is_no_database_is_kept_and_not_used(tmp_path, arm26, content):
    (tmp_path / FILE).write_bytes(content)
    found, mae, not_used = read(tmp_path, arm26)
    assert (len(found), mae) == (0, None)
    assert 'damaged' in not_used
    assert (tmp_path / 'backup-1' / FILE).read_bytes() == content


def test_a_state_of_before_is_kept_and_not_used(tmp_path, arm26):
    (tmp_path / 'samples.log').write_bytes(b'MAESMPL1')
    found, mae, not_used = read(tmp_path, arm26)
    assert (len(found), mae) == (0, None)
    assert 'not read any more' in not_used
    assert (tmp_path / 'backup-1' / 'samples.log').read_bytes() == b'MAESMPL1'
    assert read(tmp_path, arm26)[2] == ''


def test_another_robots_state_is_kept_whole_and_not_used(tmp_path, arm26, stage):
    store = written(tmp_path, arm26, stage, 2)
    found, mae, not_used = read(tmp_path, Robot.load('musashi_left_arm'))
    assert (len(found), mae) == (0, None)
    assert 'other joints and muscles' in not_used
    same(read(tmp_path / 'backup-1', arm26)[0], store)


def test_a_robot_with_another_muscle_takes_the_samples_over(tmp_path, arm26, stage, initial):
    added = 2
    directory = copy_robot('arm26', tmp_path / 'small')
    document = read_muscles(directory)
    del document['muscles'][added]
    small = Robot.load(write_muscles(directory, document))
    kept = [m for m in range(arm26.muscle_count) if m != added]
    network = initial_mae(small, 'default', steps=2).mae
    store, state = SampleStore(), State(tmp_path, small)
    state.load(store)
    for _ in range(4):
        theta, *parts, _, _ = stage.sample()
        store.add(Sample(theta, *(part[kept] for part in parts)))
    store.forget(0, newest=1)
    state.keep(store, checkpoint.to_bytes(network))
    state.close()
    learner = Learner(arm26, initial, directory=tmp_path, training=Prepared)
    found = learner.samples
    assert found.numbers == store.numbers
    for one, other in zip(found.samples, store.samples, strict=True):
        np.testing.assert_array_equal(one.theta, other.theta)
        np.testing.assert_array_equal(one.length[kept], other.length)
        np.testing.assert_array_equal(one.direction[kept], other.direction)
    np.testing.assert_array_equal(np.array(found.known)[:, kept], store.known)
    assert not np.array(found.known)[:, added].any()
    told = learner.report().values['saved state not used']
    assert arm26.muscles[added] in told
    assert 'are learned from' in told
    # They bring as many updates as when they came; then all waits for new ones.
    for now in range(10):
        learner.poll(2.0 * now)
    assert learner.updates == 4
    learner.close()
    same(read(tmp_path / 'backup-1', small)[0], store)
    same(read(tmp_path, arm26)[0], found)


def test_a_file_that_is_damaged_while_it_is_used_is_written_anew(tmp_path, arm26, stage):
    state, store = State(tmp_path, arm26), SampleStore()
    state.load(store)
    for _ in range(3):
        store.add(stage.sample())
        state.keep(store, None)
    with (tmp_path / FILE).open('r+b') as file:
        file.write(bytes(200))
    state._connection.execute('PRAGMA cache_size = 0')
    state._connection.execute('PRAGMA shrink_memory')
    store.add(stage.sample())
    state.keep(store, None)
    state.keep(store, None)
    assert state.trouble == ''
    state.close()
    same(read(tmp_path, arm26)[0], store)


# -- one learner a directory ----------------------------------------------------------------------


def test_a_directory_serves_one_learner_at_a_time(tmp_path, arm26, stage):
    state = State(tmp_path, arm26)
    for _ in range(2):  # empty, and with a state
        with pytest.raises(StateError, match='another learner'):
            State(tmp_path, arm26)
        state.keep(stage.store(1), None)
    state.close()
    State(tmp_path, arm26).close()


@pytest.mark.parametrize('place', ['file/state', 'nul\0'])
def test_a_directory_that_cannot_be_made_is_named(tmp_path, arm26, place):
    (tmp_path / 'file').write_text('x')
    with pytest.raises(StateError, match='cannot be written'):
        State(tmp_path / place, arm26)


def test_a_home_that_is_not_known_is_told_with_what_to_give(arm26):
    with pytest.raises(StateError, match=r"'~nobody-here/state'.*give a whole path"):
        State('~nobody-here/state', arm26)


# -- a disk that fails ----------------------------------------------------------------------------


@pytest.fixture
def begun(arm26, initial, tmp_path):
    """Return what starts a learner in one directory, the last one's successor."""
    learners = []

    def begin():
        for learner in learners:
            learner.close()
        learners.append(Learner(arm26, initial, training=Prepared, directory=tmp_path / 'state'))
        return learners[-1]

    yield begin
    for learner in learners:
        learner.close()


def test_samples_that_came_while_the_disk_was_full_are_written_when_it_is_not(begun, stage):
    learner = begun()
    accept(learner, stage, 3)
    with full_disk():
        accept(learner, stage, 4)
        learner.poll(0.0)
        assert 'cannot be saved' in learner.report().message
        with pytest.raises(StateError):
            learner.save()
    learner.poll(0.1)
    assert learner.report().level == 'ok'
    accept(learner, stage, 2)
    same(begun().samples, learner.samples)


def test_a_network_that_could_not_be_saved_is_saved_later(begun, stage):
    learner = begun()
    accept(learner, stage, 2)
    with full_disk():
        while not learner.updates:
            learner.poll(0.0)
        assert 'cannot be saved' in learner.report().message
    learner.poll(0.1)
    assert learner.report().level == 'ok'
    assert begun().mae.version == learner.mae.version


def test_a_learner_that_starts_with_a_full_disk_goes_on_with_what_it_has(begun, stage):
    before = begun()
    accept(before, stage, 5)
    before.close()
    with full_disk():
        learner = begun()
        same(learner.samples, before.samples)
        assert learner.mae.version == before.mae.version
        accept(learner, stage, 1)
        assert learner.report().level == 'error'
    learner.poll(0.0)
    assert learner.report().level == 'ok'
    same(begun().samples, learner.samples)


def test_a_directory_that_is_deleted_is_noticed_at_once_and_made_again(begun, stage, tmp_path):
    learner = begun()
    accept(learner, stage, 3)
    shutil.rmtree(tmp_path / 'state')
    learner._state._next_look = 0.0
    states.PAUSE = 3600.0
    learner.poll(0.0)
    assert learner.report().level == 'error'
    accept(learner, stage, 1)
    assert learner.report().level == 'error'  # long enough to be seen
    states.PAUSE = learner._state._next_look = 0.0
    learner.poll(0.1)
    assert learner.report().level == 'ok'
    accept(learner, stage, 1)
    same(begun().samples, learner.samples)
    assert len(learner.samples) == 5


def test_a_directory_that_becomes_read_only_is_noticed_at_once(begun, stage, monkeypatch):
    learner = begun()
    accept(learner, stage, 3)
    with monkeypatch.context() as patch:  # root may write whatever the mode says
        patch.setattr(os, 'access', lambda *_: False)
        learner.poll(0.0)
        assert 'read-only' in learner.report().message
        accept(learner, stage, 1)
    learner.poll(0.1)
    assert learner.report().level == 'ok'
    same(begun().samples, learner.samples)


def test_a_muscle_that_was_relearned_with_a_full_disk_is_on_disk_when_that_is_not(begun, stage):
    learner = begun()
    accept(learner, stage, 3)
    with full_disk():
        learner.relearn([2])
        assert learner.report().level == 'error'
    learner.poll(0.0)
    assert learner.report().level == 'ok'
    assert not any(known[2] for known in begun().samples.known)


# -- replacing a state ----------------------------------------------------------------------------


def test_a_state_that_is_replaced_is_kept_whole(begun, stage, initial, arm26, tmp_path):
    learner = begun()
    accept(learner, stage, 3)
    before, version = read_copy(tmp_path / 'state', tmp_path / 'copy', arm26)
    learner.replace(initial)
    accept(learner, stage, 1)
    learner.close()
    kept, mae, _ = read(tmp_path / 'state' / 'backup-1', arm26)
    same(kept, before)
    assert mae.version == version
    found, mae, _ = read(tmp_path / 'state', arm26)
    same(found, learner.samples)
    assert mae.version == version + 1


def test_a_saved_network_that_is_refused_is_kept_whole_and_told(
    begun, stage, arm26, tmp_path, monkeypatch
):
    learner = begun()
    accept(learner, stage, 3)
    before, version = read_copy(tmp_path / 'state', tmp_path / 'copy', arm26)
    learner.close()
    check, refused = Gate.check, []

    def refuse_once(gate, mae):
        if not refused:
            refused.append(mae)
            raise GateError('it does not explain the arm')
        check(gate, mae)

    monkeypatch.setattr(Gate, 'check', refuse_once)
    learner = begun()
    told = learner.report().values['saved state not used']
    assert 'does not explain the arm' in told and 'backup-1' in told
    accept(learner, stage, 1)
    kept, mae, _ = read(tmp_path / 'state' / 'backup-1', arm26)
    same(kept, before)
    assert mae.version == version
    assert len(learner.samples) == 4
    assert learner._owed == 3  # what was learned of them is to be learned again


def test_a_saved_network_that_is_refused_becomes_one_backup(
    begun, stage, arm26, tmp_path, monkeypatch
):
    learner = begun()
    accept(learner, stage, 3)
    learner.close()

    def refuse(*_):
        raise GateError('it does not explain the arm')

    with monkeypatch.context() as patch:
        patch.setattr(Gate, 'check', refuse)
        for _ in range(2):  # nothing replaces it
            again = Learner(arm26, training=Prepared, directory=tmp_path / 'state')
            again.close()
            same(again.samples, learner.samples)
    assert len(list((tmp_path / 'state').glob('backup-*'))) == 1
    assert begun()._owed == 3


def read_copy(directory, copy, robot):
    shutil.copytree(directory, copy)
    store, mae, _ = read(copy, robot)
    return store, None if mae is None else mae.version


def test_a_state_that_a_full_disk_does_not_let_be_replaced_stays(begun, stage, initial, tmp_path):
    learner = begun()
    accept(learner, stage, 3)
    data, samples = learner.checkpoint, list(learner.samples.samples)
    with full_disk(), pytest.raises(StateError, match='no backup can be made'):
        learner.replace(initial)
    assert learner.checkpoint == data
    assert learner.samples.samples == samples
    assert not list((tmp_path / 'state').glob('backup-*'))
    learner.poll(0.0)
    same(begun().samples, learner.samples)


def test_a_copy_made_at_any_moment_of_a_replacement_is_all_of_one_state(
    begun, stage, initial, arm26, tmp_path, monkeypatch
):
    learner = begun()
    accept(learner, stage, 3)
    version = learner.mae.version
    copies = []

    def copied(*_):
        copies.append(tmp_path / f'copy-{len(copies)}')
        shutil.copytree(tmp_path / 'state', copies[-1])
        return 0

    connect = states._connect

    def watched(file):
        connection = connect(file)
        connection.set_progress_handler(copied, 4)
        return connection

    monkeypatch.setattr(states, '_connect', watched)
    learner._state._connection.set_progress_handler(copied, 4)
    for name in ('mkdir', 'rename', 'unlink'):
        done = getattr(Path, name)

        def step(self, *arguments, done=done, **options):
            copied()
            done(self, *arguments, **options)
            copied()

        monkeypatch.setattr(Path, name, step)
    learner.replace(initial)
    monkeypatch.undo()
    outcomes = []
    for copy in copies:
        found, mae, _ = read(copy, arm26)
        outcomes.append((len(found), mae.version))
    assert set(outcomes) <= {(3, version), (0, version + 1)}
    assert outcomes == sorted(outcomes, reverse=True)
    assert len(outcomes) > 20
    assert not list(copies[-1].glob('*.tmp'))


@pytest.mark.parametrize('name', [FILE, 'samples.log', 'checkpoint.safetensors'])
@pytest.mark.parametrize('kind', ['fifo', 'endless', 'huge', 'folder'])
def test_no_file_of_a_state_can_be_anything_else(tmp_path, arm26, stage, name, kind):
    file, state = tmp_path / name, None
    if kind == 'fifo':
        os.mkfifo(file)
    elif kind == 'endless':
        file.symlink_to('/dev/zero')
    elif kind == 'folder':
        file.mkdir()
    else:
        with file.open('wb') as stream:
            stream.truncate(1 << 31)
    try:
        state, store = State(tmp_path, arm26), SampleStore()
        state.load(store)
        store.add(stage.sample())
        state.keep(store, None)
        assert not state.trouble or str(file) in state.trouble
    except StateError:  # in one line, which the learner ends with
        pass
    finally:
        if state is not None:
            state.close()


def test_what_a_camera_and_an_accelerometer_said_survives(arm26, tmp_path):
    gravity = np.full(3 * len(arm26.kinematics.parent), np.nan)
    gravity[3:6] = 0.0, 0.6, -0.8
    plain = Sample(np.array([0.1, np.nan]), np.full(6, 50.0), np.zeros(6), np.ones(6))
    told = plain._replace(spread=np.full(2, 0.02), gravity=gravity)
    store, again = SampleStore(), SampleStore()
    for sample in (plain, told, plain._replace(gravity=gravity)):
        store.add(sample)
    with closing(State(tmp_path, arm26)) as state:
        state.save(store, None)
    with closing(State(tmp_path, arm26)) as state:
        state.load(again)
    for before, after in zip(store.samples, again.samples, strict=True):
        for one, two in zip(before, after, strict=True):
            np.testing.assert_array_equal(one, two)


def test_samples_from_before_they_told_their_spread_are_read(arm26, tmp_path, monkeypatch):
    store, again = SampleStore(), SampleStore()
    store.add(Sample(np.array([0.1, 0.2]), np.full(6, 50.0), np.zeros(6), np.ones(6)))
    with closing(State(tmp_path, arm26)) as state:
        record = state._packed(1, store.samples[0], store.known[0])
        values = record[HEAD.size : state._sizes(arm26.muscles)[1]]
        old = HEAD.pack(MARK, state._checksum(values, arm26.muscles)) + values
        monkeypatch.setattr(state, '_packed', lambda *_: old)
        state.save(store, None)
    with closing(State(tmp_path, arm26)) as state:
        state.load(again)
        assert not state.not_used
    np.testing.assert_array_equal(again.samples[0].theta, store.samples[0].theta)
