# SPDX-License-Identifier: Apache-2.0
"""Learning from the shipped recordings, and `train --from-bag`."""

import re
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from musculoskeletal_ae import progress_bar
from musculoskeletal_ae.bags.message_types import TYPESTORE
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.recorded_faults import find_faults
from musculoskeletal_ae.bags.streams import Pairs
from musculoskeletal_ae.bags.writer import BagWriter
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.estimation import estimator
from musculoskeletal_ae.estimation.finding import Finding
from musculoskeletal_ae.estimation.health import HealthMonitor
from musculoskeletal_ae.learning import convergence, recordings
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.recordings import error, learn
from musculoskeletal_ae.mae.checkpoint import load
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.process_signals import INTERRUPTED
from musculoskeletal_ae.robot.directories import find_robot
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools import model_training, network_cache, recording_learning
from musculoskeletal_ae.tools.network_cache import network_file
from musculoskeletal_ae.tools.recording_learning import anomaly_in, read, repetition
from musculoskeletal_ae.tools.train import main

BAGS = Path(__file__).resolve().parents[2] / 'bags'


@pytest.fixture(scope='module')
def robot():
    return Robot.load('musashi_left_arm')


def part(recording, start, end):
    inside = (recording.time >= start) & (recording.time < end)
    return Pairs(*(column[inside] for column in recording))


@pytest.fixture(scope='module')
def teaching(robot):
    return read(BAGS / 'teaching', robot)


def test_learning_from_one_recording_improves_the_estimate_of_another(robot, teaching):
    exploration = part(read(BAGS / 'rupture', robot), 0.0, 30.0)  # long before the rupture
    other = part(teaching, 0.0, 15.0)  # before the arm is pushed
    mae = initial_mae(robot, steps=150)
    learner = Learner(robot, mae, steps=20)
    reported = []
    learn(learner, exploration, reported.append)
    assert sum(reported) == pytest.approx(exploration.time[-1] - exploration.time[0])
    assert learner.updates > 0
    assert error(learner.mae, other) < 0.6 * error(mae, other)


def enough(*_, enough, **__):
    """Count the resting postures of a recording as enough to learn from."""
    return enough


def spoiled(path, kind, seconds=60.0):
    """Write the begin of a recording with false joint angles; return the bag."""
    bag = Bag.open(BAGS / 'exploration')
    changed, end = bag.topics['/joint_states'], bag.start + seconds * 1e9
    with BagWriter(path) as writer:
        for name, topic in bag.topics.items():
            writer.add_topic(name, topic.type, topic.qos)
        count = 0
        for message in bag.messages(stop=int(end)):
            data, at = message.data, (message.log_time - bag.start) / 1e9
            if message.topic == changed.name:
                count += 1
                zeros = bag.decode(message)
                zeros.position = np.zeros(len(zeros.position))
                false = bytes(TYPESTORE.serialize_cdr(zeros, changed.type))
                if kind == 'every second message' and count % 2:
                    data = false
                if kind == 'bursts' and at % 20.0 > 18.0:
                    data = false
                if kind == 'second publisher':
                    other = message.log_time + 20_000_000, message.publish_time + 20_000_000
                    writer.write(message.topic, *other, false)
            writer.write(message.topic, message.log_time, message.publish_time, data)
    return path


@pytest.mark.thorough
@pytest.mark.parametrize('kind', ['every second message', 'bursts', 'second publisher'])
def test_false_joint_angles_hardly_change_what_is_learned(kind, robot, teaching, tmp_path):
    errors = []
    for each in ('none', kind):
        recording = read(spoiled(tmp_path / each, each, 180.0), robot)
        learner = Learner(robot, initial_mae(robot, steps=600), steps=100)
        learn(learner, recording)
        errors.append(error(learner.mae, part(teaching, 0.0, 15.0)))
    assert errors[1] <= 1.1 * errors[0]


def test_isolated_muscles_of_a_recording_are_neither_learned_nor_used(arm26, initial):
    count = 500
    theta = np.tile(0.5 * (arm26.lower + arm26.upper), (count, 1))
    tension = np.full((count, arm26.muscle_count), 60.0)
    length = initial.lengths(theta, tension)
    isolated = np.zeros(tension.shape, dtype=int)
    length[:450, 2], tension[:450, 2], isolated[:450, 2] = 0.1, 0.0, 1
    recording = Pairs(0.01 * np.arange(count), theta, length, tension, isolated)
    nothing_said = recording._replace(isolated=np.full_like(isolated, -1))
    assert error(initial, recording) < 0.1 * error(initial, nothing_said)
    learner = Learner(arm26, initial, steps=1)
    learn(learner, part(recording, 0.0, 4.0))
    assert learner.isolated == (2,)
    (stored,) = learner.samples.stored
    assert np.flatnonzero(~stored.known).tolist() == [2]
    learn(learner, part(recording, 4.0, 5.0))
    assert learner.isolated == ()
    learner.use_body(learner.body.with_isolated((1,)))
    learn(learner, nothing_said)
    assert learner.isolated == (1,)


def test_bad_messages_of_a_recording_are_left_out_and_reported(robot, capsys):
    recording = read(BAGS / 'faults', robot)
    assert len(recording.time) > 2000
    errors = capsys.readouterr().err
    assert '2 messages were rejected: /muscle_states: not finite' in errors
    assert '/muscle_states: wrong length' in errors


@pytest.mark.parametrize(
    ('arguments', 'status', 'expected'),
    [
        (['--from-bag', '/no/such/bag'], 1, '/no/such/bag'),
        (['--from-bag', str(BAGS / 'rupture'), '--robot', 'arm26'], 1, 'missing joint'),
        (['--hold-out', str(BAGS / 'rupture')], 2, '--from-bag'),
        (['--from-bag', 'a', '--checkpoint', 'b'], 2, 'do not use it with --checkpoint'),
        (
            ['--from-bag', str(BAGS / 'rupture'), '--out', str(BAGS / 'rupture/a')],
            2,
            'would overwrite a recording',
        ),
    ],
)
def test_wrong_bags_and_options_end_with_one_clear_error(
    tmp_path, capsys, arguments, status, expected
):
    out = tmp_path / 'out.safetensors'
    everything = ['--robot', 'musashi_left_arm', '--out', str(out), *arguments, '--quick']
    if status == 2:
        with pytest.raises(SystemExit) as ended:
            main(everything)
        assert ended.value.code == 2
    else:
        assert main(everything) == status
    assert expected in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize('fault', ['joint sensor', 'muscles'])
def test_progress_and_faults_of_the_readings_are_reported(
    fault, arm26, initial, monkeypatch, tmp_path, capsys
):
    time = 0.02 * np.arange(1000)
    # After the first reading, the arm never rests.
    waves = np.sin(np.outer(time, [1.7, 2.3]))
    theta = 0.5 * (arm26.lower + arm26.upper) + 0.3 * (arm26.upper - arm26.lower) * waves
    tension = np.full((1000, arm26.muscle_count), 60.0)
    length = arm26.muscle_lengths(theta, tension)
    unknown = np.full(tension.shape, -1)
    if fault == 'joint sensor':
        theta = theta * [-1.0, 1.0]
        expected = f'sign of these joint sensors is reversed: {arm26.joints[0]}. Publish θ'
    else:
        length = length[:, [1, 0, 2, 3, 4, 5]]
        expected = f'readings of {arm26.muscles[0]} and {arm26.muscles[1]} are exchanged; if this'
    recording = Pairs(time, theta, length, tension, unknown)

    def trained(_robot, _preset, _seed, progress, steps):
        for step in range(steps):
            progress(step, 0.5)
        return initial

    monkeypatch.setattr(progress_bar, 'REPORT_INTERVAL', 0.0)
    monkeypatch.setattr(convergence, 'MOST_UPDATES', 1)
    monkeypatch.setattr(recordings, 'STEPS', 1)
    monkeypatch.setattr(recording_learning, 'Learner', partial(Learner, steps=1))
    monkeypatch.setattr(model_training, 'initial_mae', trained)
    monkeypatch.setattr(recording_learning, 'read', lambda *_: recording)
    out = str(tmp_path / 'out.safetensors')
    assert main(['--robot', 'arm26', '--from-bag', 'BAG', '--out', out, '--quick']) == 0
    printed = capsys.readouterr()
    assert 'training: 50 %, loss 0.5' in printed.err
    assert 'learning from BAG, a recording of 20 s\n' in printed.err
    assert re.search(r'learning from BAG: \d+ %, \d+ samples, \d+ updates', printed.err)
    few = 'the recordings have 1 different resting postures, fewer than 20. The slowest moment of'
    said, trained_at = printed.err.index(few), printed.err.index('training: 50 %')
    assert said < trained_at
    assert Path(out).exists()
    (warning,) = {line for line in printed.err.splitlines() if line.startswith('warning: BAG: ')}
    assert expected in warning


def test_an_arm_that_stands_still_is_refused_before_the_training(
    arm26, monkeypatch, tmp_path, capsys
):
    theta = np.tile(0.5 * (arm26.lower + arm26.upper), (1000, 1))
    tension = np.full((1000, arm26.muscle_count), 60.0)
    unknown = np.full(tension.shape, -1)
    length = arm26.muscle_lengths(theta, tension)
    recording = Pairs(0.01 * np.arange(1000), theta, length, tension, unknown)
    monkeypatch.setattr(recording_learning, 'read', lambda *_: recording)
    monkeypatch.setattr(recording_learning, '_initial_network', None)  # is not called
    out = tmp_path / 'out.safetensors'
    assert main(['--robot', 'arm26', '--from-bag', 'BAG', '--out', str(out)]) == 1
    error_text = capsys.readouterr().err
    assert 'error: nothing can be learned: the recordings have 1 different resting' in error_text
    assert 'from posture to posture' in error_text and not out.exists()


def test_an_arm_that_never_rests_is_learned_from_slow_moments(arm26, initial):
    arm, rng = EmulatedArm(arm26, seed=1), np.random.default_rng(0)
    rows, start = [], arm.sense().muscles.length
    for theta in arm26.random_postures(25, rng):
        tension = rng.uniform(40.0, 120.0, arm26.muscle_count)
        goal = arm26.muscle_lengths(theta[None], tension[None])[0]
        for share in np.linspace(0.0, 1.0, 100):
            arm.command_length(start + (goal - start) * share)
            arm.step(0.01)
            now = arm.sense()
            rows.append(
                (0.01 * len(rows), now.theta.copy(), now.muscles.length, now.muscles.tension)
            )
        start = goal
    time, theta, length, tension = map(np.array, zip(*rows))
    recording = Pairs(time, theta, length, tension, np.full(tension.shape, -1))
    assert recordings.count_postures(arm26, recording) < 3
    assert recordings.count_postures(arm26, recording, from_motion=True) > 10
    learner = Learner(arm26, initial, from_motion=True)
    learn(learner, recording.at(time < 18.0))
    rest = recording.at(time > 19.0)
    assert error(learner.mae, rest) < 0.6 * error(initial, rest)


def test_estimated_joint_sensor_offsets_are_shown_and_the_error_without_them(
    arm26, trained_file, initial, monkeypatch, tmp_path, capsys
):
    theta = np.tile(0.5 * (arm26.lower + arm26.upper), (500, 1))
    tension = np.full((500, arm26.muscle_count), 60.0)
    unknown = np.full(tension.shape, -1)
    read = theta + [0.03, 0.0]  # the sensor of the first joint has an offset
    time = 0.01 * np.arange(500)
    recording = Pairs(time, read, initial.lengths(theta, tension), tension, unknown)

    def learned(learner, *_):
        learner.trainer.body.zero[:] = [0.03, 0.0]
        learner.scheduler.updates = 1

    monkeypatch.setattr(recording_learning, 'read', lambda *_: recording)
    monkeypatch.setattr(recording_learning, 'count_postures', enough)
    monkeypatch.setattr(recording_learning, 'collect', learned)
    arguments = ['--robot', 'arm26', '--from-bag', 'BAG', '--out', str(tmp_path / 'x.safetensors')]
    assert main([*arguments, '--checkpoint', trained_file]) == 0
    printed = capsys.readouterr().out
    assert f'estimated joint-sensor offsets: {arm26.joints[0]} 0.0300 rad\n' in printed
    mae = load(Path(trained_file), arm26)
    corrected = error(mae, recording._replace(theta=theta))
    assert f'without their estimated offsets: {corrected:.4f} rad' in printed
    assert corrected != error(mae, recording)


def test_ctrl_c_keeps_what_was_learned_and_leaves_the_earlier_network(
    arm26, trained_file, initial, monkeypatch, tmp_path, capsys
):
    theta = np.tile(0.5 * (arm26.lower + arm26.upper), (500, 1))
    tension = np.full((500, arm26.muscle_count), 60.0)
    unknown = np.full(tension.shape, -1)
    time = 0.01 * np.arange(500)
    recording = Pairs(time, theta, initial.lengths(theta, tension), tension, unknown)

    def interrupted(learner, *_):
        learner.scheduler.updates = 3
        raise KeyboardInterrupt

    monkeypatch.setattr(recording_learning, 'read', lambda *_: recording)
    monkeypatch.setattr(recording_learning, 'count_postures', enough)
    monkeypatch.setattr(recording_learning, 'collect', interrupted)
    out, kept = tmp_path / 'out.safetensors', tmp_path / 'out.interrupted.safetensors'
    out.write_text('an earlier network')
    arguments = ['--robot', 'arm26', '--from-bag', 'BAG', '--out', str(out)]
    assert main([*arguments, '--checkpoint', trained_file]) == INTERRUPTED
    assert load(kept, arm26).joints == tuple(arm26.joints)
    assert out.read_text() == 'an earlier network'
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith(f'interrupted: {kept} has the network learned so far (0 samples, 3 upd')
    assert f'{out} was not written' in line


@pytest.mark.thorough
def test_the_joint_sensors_of_a_recording_of_the_foreign_arm_are_correct(robot):
    assert not find_faults(robot, read(BAGS / 'foreign', robot)).joint_sensors


def test_a_joint_sensor_that_fails_during_a_recording_is_named_with_the_times(robot, teaching):
    assert not find_faults(robot, teaching).joint_sensors
    theta, fails = teaching.theta.copy(), (teaching.time > 15.0) & (teaching.time < 25.0)
    theta[fails, 3] = 0.0
    (warning,) = find_faults(robot, teaching._replace(theta=theta)).joint_sensors
    assert f'joint sensor {robot.joints[3]} repeats one reading from 15.' in warning


def test_an_anomaly_in_a_held_out_recording_is_reported_with_the_error_before_it(
    arm26, initial, monkeypatch
):
    class Monitor(HealthMonitor):
        """A health monitor that reports an anomaly of a muscle at the 301st message."""

        count = 0

        def step(self, _):
            self.count += 1
            return Finding(2, ConditionKind.SLACK_TENDON, '') if self.count > 300 else None

    count = 500
    theta = np.tile(0.5 * (arm26.lower + arm26.upper), (count, 1))
    tension = np.full((count, arm26.muscle_count), 60.0)
    length, nobody = initial.lengths(theta, tension), np.zeros(tension.shape, dtype=int)
    recording = Pairs(0.01 * np.arange(count), theta, length, tension, nobody)
    assert anomaly_in(arm26, recording, initial, 'default') == ''
    monkeypatch.setattr(estimator, 'HealthMonitor', Monitor)
    learner = Learner(arm26, initial)
    assert 'learning stopped 3.0 s after the start: an anomaly' in learn(learner, recording)
    text = anomaly_in(arm26, recording, initial, 'default')
    found = f'({arm26.muscles[2]}: {ConditionKind.SLACK_TENDON.identifier})'
    assert f'{found} begins 3.0 s after the start' in text
    assert f'until then the error is {error(initial, recording.at(slice(300))):.4f} rad' in text


def test_a_held_out_recording_of_the_learned_postures_is_reported(arm26):
    rng = np.random.default_rng(0)
    learned, others = arm26.random_postures(20, rng), arm26.random_postures(20, rng)
    noise = rng.normal(0.0, 0.005, (10, 20, 2))
    again, new = ((rests + noise).reshape(-1, 2) for rests in (learned, others))
    again[::7] = np.nan  # messages in which the joint angles are unknown
    assert 'controller:seed' in repetition(arm26, again, learned)
    assert repetition(arm26, new, learned) == ''
    assert repetition(arm26, again[:0], learned) == repetition(arm26, again, learned[:0]) == ''


@pytest.fixture
def learned_from_bag(arm26, initial, monkeypatch, tmp_path):
    """Return a function that runs `train --from-bag` for arm26, with a cache of its own.

    The function returns the exit status and the network that learning started from. Training on the
    geometric model returns `initial`, and is counted in the list `trainings`. Learning changes
    nothing.
    """
    count = 500
    theta = np.tile(0.5 * (arm26.lower + arm26.upper), (count, 1))
    tension = np.full((count, arm26.muscle_count), 60.0)
    length, unknown = initial.lengths(theta, tension), np.full(tension.shape, -1)
    recording = Pairs(0.01 * np.arange(count), theta, length, tension, unknown)
    started_from, trainings = [], []

    def trained(*_):
        trainings.append(1)
        return initial

    def learned(learner, *_):
        started_from.append(learner.mae)
        learner.scheduler.updates = 1

    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    monkeypatch.setattr(model_training, 'initial_mae', trained)
    monkeypatch.setattr(recording_learning, 'read', lambda *_: recording)
    monkeypatch.setattr(recording_learning, 'count_postures', enough)
    monkeypatch.setattr(recording_learning, 'collect', learned)

    def run(*options):
        out = str(tmp_path / 'out.safetensors')
        status = main(['--robot', 'arm26', '--from-bag', 'BAG', '--out', out, *options])
        return status, started_from[-1]

    run.trainings = trainings
    return run


def test_learning_starts_from_the_network_that_bringup_has_cached(
    learned_from_bag, trained_file, capsys
):
    file = network_file('arm26', 'default')
    file.parent.mkdir(parents=True)
    file.write_bytes(Path(trained_file).read_bytes())
    status, network = learned_from_bag()
    assert status == 0 and learned_from_bag.trainings == []
    np.testing.assert_array_equal(network.mean, load(file).mean)
    (line,) = (line for line in capsys.readouterr().out.splitlines() if 'initial network' in line)
    assert str(file) in line


def test_a_network_that_is_not_cached_is_trained_once_and_cached(learned_from_bag, arm26):
    for _ in range(2):
        assert learned_from_bag()[0] == 0
    assert learned_from_bag.trainings == [1]
    assert load(network_file('arm26', 'default'), arm26).joints == tuple(arm26.joints)


def test_a_damaged_network_in_the_cache_is_replaced(learned_from_bag, arm26, capsys):
    file = network_file('arm26', 'default')
    file.parent.mkdir(parents=True)
    file.write_text('damaged')
    assert learned_from_bag()[0] == 0
    assert learned_from_bag.trainings == [1] and load(file, arm26)
    assert 'will be trained again' in capsys.readouterr().err


@pytest.mark.parametrize('options', [['--seed', '1'], ['--quick']])
def test_only_the_network_that_bringup_would_train_is_cached(learned_from_bag, options):
    assert learned_from_bag(*options)[0] == 0
    assert not network_file('arm26', 'default').exists()


def test_a_changed_robot_preset_or_version_has_another_network_in_the_cache(monkeypatch, tmp_path):
    robot = tmp_path / 'here' / 'my_arm'
    shutil.copytree(find_robot('arm26'), robot)
    moved = shutil.copytree(robot, tmp_path / 'there' / 'my_arm')
    before = network_file(robot, 'default')
    assert network_file(moved, 'default') == before  # its place does not matter
    files = {before, network_file(robot, 'paper'), network_file('arm26', 'default')}
    for name in 'robot.urdf', 'muscles.yaml':
        with (robot / name).open('a', encoding='utf-8') as stream:
            stream.write('\n')
        files.add(network_file(robot, 'default'))
    ignore = shutil.ignore_patterns('__pycache__')
    package = shutil.copytree(network_cache.PACKAGE, tmp_path / 'package', ignore=ignore)
    monkeypatch.setattr(network_cache, 'PACKAGE', package)
    assert network_file(robot, 'default') in files
    for code in 'mae/network.py', 'presets/registry.py', 'tools/model_training.py':
        (package / code).write_text('')
        files.add(network_file(robot, 'default'))
    assert len(files) == 3 + 2 + 3
