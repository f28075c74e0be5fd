# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from robots import with_modules

from bags import bag_samples as samples
from bags.arm_bag import ARRAY, JOINTS, Arm, array, joints
from musculoskeletal_ae.bags.check import check_bag, motion_text
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.recorded_faults import find_faults
from musculoskeletal_ae.bags.streams import Pairs, read_streams
from musculoskeletal_ae.exceptions import BagError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import Anomaly, BodyState, LengthOffsets


@pytest.fixture(scope='module')
def robot():
    return Robot.load('arm26')


@pytest.fixture
def arm(robot):
    return Arm(robot)


def streams(arm, robot, tmp_path):
    return read_streams(Bag.open(arm.write(tmp_path / 'bag')), robot)


def test_streams_are_what_was_recorded(arm, robot, tmp_path):
    result = streams(arm, robot, tmp_path)
    assert_array_equal(result.joints.values, arm.theta)
    assert_array_equal(result.muscles.length, arm.length)
    assert_array_equal(result.muscles.tension, arm.tension)
    assert_allclose(result.muscle_times, arm.time, atol=1e-9)
    assert not result.rejected


def test_two_motions_at_the_same_times_are_no_recording(arm, tmp_path):
    content = sorted(arm.content, key=lambda sample: sample.log_time)
    samples.write_ours(tmp_path / 'bag', content * 2)
    with pytest.raises(BagError, match=r'log times of .* go back by 1\.\d* s'):
        Bag.open(tmp_path / 'bag')


def test_theta_is_paired_with_the_nearest_muscle_state(arm, robot, tmp_path):
    pairs = streams(arm, robot, tmp_path).pairs()
    assert_array_equal(pairs.theta, arm.theta)
    assert_array_equal(pairs.length, arm.length)
    assert_array_equal(pairs.tension, arm.tension)


@pytest.mark.parametrize(('late', 'paired'), [(0.0049, 20), (0.006, 19), (0.051, 15)])
def test_pairs_are_no_further_apart_than_half_a_period(late, paired, robot, tmp_path):
    result = streams(Arm(robot, count=20, late=late), robot, tmp_path)
    pairs = result.pairs()
    assert len(pairs.time) == paired
    nearest = np.abs(result.joints.time[:, None] - pairs.time).min(axis=0)
    assert (nearest <= 0.005).all()


def test_without_joint_sensors_there_are_no_pairs(arm, robot, tmp_path):
    arm.content = [sample for sample in arm.content if sample.type != JOINTS]
    result = streams(arm, robot, tmp_path)
    assert len(result.muscle_times) == 200
    assert result.pairs().theta.shape == (0, robot.joint_count)


def test_invalid_messages_are_left_out_and_counted_by_reason(arm, robot, tmp_path):
    bad = np.full(3 * robot.muscle_count, np.nan)
    arm.add('/muscle_states', ARRAY, 0.0051, array(bad))
    arm.add('/muscle_states', ARRAY, 0.0052, array(bad[1:]))
    arm.add('/joint_states', JOINTS, 0.0053, joints(['other'], [0.0]))
    # A message may also name joints of another arm. The order of the names does not matter.
    names = ['other', *reversed(robot.joints)]
    arm.add('/joint_states', JOINTS, 0.0054, joints(names, [9.0, *arm.theta[0, ::-1]]))
    result = streams(arm, robot, tmp_path)
    assert result.rejected == {
        '/muscle_states: not finite': 1,
        '/muscle_states: wrong length': 1,
        '/joint_states: missing joint': 1,
    }
    assert len(result.muscle_times) == 200
    assert_array_equal(result.joints.values[1], arm.theta[0])


def test_lengths_count_from_their_zeros_and_not_while_these_are_sought(arm, robot, tmp_path):
    offset = np.linspace(-0.08, 0.08, robot.muscle_count)
    sought, found = LengthOffsets.unknown(len(offset)), LengthOffsets.of(offset, 0.0)
    for generation, (at, offsets) in enumerate([(0.5, sought), (1.0, found)], 1):
        body = BodyState(offsets, generation=generation)
        arm.add('/body_state', ARRAY, at - 0.001, array(body.rows))
    result = streams(arm, robot, tmp_path)
    assert result.rejected == {'/muscle_states: length offsets unknown': 50}
    assert_allclose(result.muscle_times, [*arm.time[:50], *arm.time[100:]], atol=1e-9)
    assert_array_equal(result.muscles.length[:50], arm.length[:50])
    assert_allclose(result.muscles.length[50:], arm.length[100:] - offset)


def test_zeros_that_were_known_before_count_from_the_beginning(arm, robot, tmp_path):
    offset = np.linspace(-0.08, 0.08, robot.muscle_count)
    body = BodyState(LengthOffsets.of(offset, 1e-3), generation=1)
    arm.add('/body_state', ARRAY, 0.501, array(body.rows))
    result = streams(arm, robot, tmp_path)
    assert not result.rejected
    assert_allclose(result.muscles.length, arm.length - offset)


def test_of_isolated_muscles_nothing_counts_while_they_are(arm, robot, tmp_path):
    count = robot.muscle_count
    for i in range(0, len(arm.content), 2):
        lost = 0 if i < 200 else 1
        rows = [arm.length[i // 2], arm.tension[i // 2].copy(), np.full(count, 30.0)]
        rows[1][lost] = np.nan
        arm.content[i] = arm.content[i]._replace(data=array(rows))
    # The first message arrives after the first muscle states, as a latched message may.
    healthy = BodyState.healthy(count)
    for muscle, at in ((0, 0.501), (1, 0.999)):
        body = replace(healthy, isolated=(muscle,), generation=muscle + 1)
        arm.add('/body_state', ARRAY, at, array(body.rows))
    result = streams(arm, robot, tmp_path)
    assert not result.rejected
    pairs = result.pairs()
    assert_array_equal(pairs.isolated[:, :3], [[1, 0, 0]] * 100 + [[0, 1, 0]] * 100)
    assert (pairs.tension[:100, 0] == 0.0).all() and (pairs.tension[100:, 1] == 0.0).all()
    assert_array_equal(pairs.tension[:100, 1:], arm.tension[:100, 1:])
    swapped = pairs._replace(length=pairs.length[:, [1, 0, *range(2, count)]])
    # Muscles that were isolated at any time are not compared, so no column counts as misplaced.
    assert not find_faults(robot, swapped).wiring.faulty


def test_a_muscle_in_which_the_estimator_found_a_fault_does_not_count(arm, robot, tmp_path):
    """Otherwise `replay --check` says of a ruptured muscle that its length has the wrong sign."""
    count = robot.muscle_count
    arm.length[20:, 1] = 2.0 * arm.length[20, 1] - arm.length[20:, 1]  # it goes the wrong way
    for i in range(40, len(arm.content), 2):
        rows = [arm.length[i // 2], arm.tension[i // 2], np.full(count, 30.0)]
        arm.content[i] = arm.content[i]._replace(data=array(rows))
    assert find_faults(robot, streams(arm, robot, tmp_path).pairs()).wiring.faulty
    healthy = BodyState.healthy(count)
    for n, body in enumerate((healthy, healthy.with_anomaly(Anomaly.FOUND, 1))):
        rows = replace(body, generation=n + 1).rows
        arm.add('/body_state', ARRAY, 0.501 + 0.497 * n, array(rows))
    result = read_streams(Bag.open(arm.write(tmp_path / 'with_state')), robot)
    pairs = result.pairs()
    assert_array_equal(pairs.isolated[:, :3], [[0, 0, 0]] * 100 + [[0, 1, 0]] * 100)
    assert not find_faults(robot, pairs).wiring.faulty
    (note,) = result.notes
    assert f'fault of {robot.muscles[1]} 1.0 s after the start' in note


def test_isolated_muscles_are_unknown_if_the_bag_does_not_contain_them(arm, robot, tmp_path):
    assert (streams(arm, robot, tmp_path).pairs().isolated == -1).all()


def test_some_joint_sensors_will_do(robot, tmp_path):
    arm = Arm(robot, order=[1, 0, *range(2, robot.muscle_count)])
    for i, sample in enumerate(arm.content):
        if sample.type == JOINTS:
            read = joints(robot.joints[1:], arm.theta[i // 2, 1:])
            arm.content[i] = sample._replace(data=read)
    pairs = streams(arm, robot, tmp_path).pairs()
    assert_array_equal(pairs.theta[:, 1:], arm.theta[:, 1:])
    assert np.isnan(pairs.theta[:, 0]).all()
    assert not find_faults(robot, pairs).wiring.faulty  # rows that lack an angle are not compared


def test_a_message_that_was_sent_before_the_last_one_is_left_out(arm, robot, tmp_path):
    late = arm.content[40]
    arm.content.append(late._replace(log_time=late.log_time + 30_000_000))
    assert streams(arm, robot, tmp_path).rejected == {f'{late.topic}: repeated or reordered': 1}


def test_a_recording_of_another_arm_is_refused(arm, tmp_path):
    other = Robot.load('musashi_left_arm')
    with pytest.raises(BagError, match=r'joint_states fits the robot \(missing joint'):
        streams(arm, other, tmp_path)


def test_muscles_in_another_order_are_named(robot, tmp_path):
    order = [1, 0, *range(2, robot.muscle_count)]
    result = streams(Arm(robot, order=order), robot, tmp_path)
    assert find_faults(robot, result.pairs()).wiring.misplaced == {0: 1, 1: 0}


@pytest.mark.parametrize('joint', [0, 1])
def test_a_reversed_joint_sensor_is_named_and_no_muscle_of_a_symmetric_arm(joint, robot, tmp_path):
    arm = Arm(robot)
    sign = np.ones(robot.joint_count)
    sign[joint] = -1.0
    theta = iter(arm.theta * sign)
    arm.content = [
        each._replace(data=joints(robot.joints, next(theta))) if each.type == JOINTS else each
        for each in arm.content
    ]
    (fault,) = check_bag(arm.write(tmp_path / 'bag'), 'arm26').faults
    assert f'the sign of these joint sensors is reversed: {robot.joints[joint]}. Publish' in fault


@pytest.mark.parametrize('order', [[5, 4, 3, 2, 1, 0], [3, 2, 0, 4, 5, 1]])
def test_exchanged_muscles_are_named_and_no_joint_sensor(order, robot, tmp_path):
    arm = Arm(robot, order=order)
    wiring, joint_sensors = find_faults(robot, streams(arm, robot, tmp_path).pairs())
    assert len(wiring.faulty) > 3 and not joint_sensors


def test_muscles_in_their_order_are_not_doubted_for_noise_and_offsets(arm, robot, tmp_path):
    rng = np.random.default_rng(1)
    pairs = streams(arm, robot, tmp_path).pairs()
    scale = rng.uniform(0.8, 1.2, robot.muscle_count)
    length = pairs.length * scale + rng.normal(0.0, 0.002, pairs.length.shape) + 0.05
    assert not find_faults(robot, pairs._replace(length=length)).wiring.faulty


def test_the_check_says_what_is_in_a_bag_and_what_it_fits(arm, tmp_path):
    check = check_bag(arm.write(tmp_path / 'bag'))
    text = '\n'.join(check.lines)
    assert check.faults == []
    assert '400 messages, 1.992 s' in text
    assert 'checksums: for all messages' in text
    assert any(
        line.split()[:4] == ['/muscle_states', '200', '100.00', '0.010'] for line in check.lines
    )
    assert 'fits: arm26' in text


@pytest.mark.parametrize('postures', [1, 3])
def test_the_check_counts_the_resting_postures_that_can_be_learned_from(robot, postures):
    time = 0.02 * np.arange(200 * postures)
    posture = 0.5 * (robot.lower + robot.upper)
    theta = posture + 0.1 * (time // 4.0)[:, None]
    tension = np.full((len(time), robot.muscle_count), 60.0)
    length = robot.muscle_lengths(theta, tension)
    text = motion_text(robot, Pairs(time, theta, length, tension, np.full(tension.shape, -1)))
    assert f'resting postures to learn from: {postures}' in text
    assert ('needs at least' in text) == (postures == 1)


def test_the_check_of_a_bag_of_another_arm_fails(arm, tmp_path):
    check = check_bag(arm.write(tmp_path / 'bag'), 'musashi_left_arm')
    assert any('does not fit musashi_left_arm' in fault for fault in check.faults)


def test_the_check_of_muscles_in_another_order_fails(robot, tmp_path):
    arm = Arm(robot, order=[*range(1, robot.muscle_count), 0])
    faults = check_bag(arm.write(tmp_path / 'bag'), 'arm26').faults
    assert any('the muscles do not have the order of arm26' in fault for fault in faults)


def test_the_check_of_a_damaged_bag_fails_and_names_the_place(arm, tmp_path):
    file = arm.write(tmp_path / 'bag') / 'bag_0.mcap'
    data = bytearray(file.read_bytes())
    data[2000] ^= 1
    file.write_bytes(data)
    (fault,) = check_bag(tmp_path / 'bag').faults
    assert 'bag_0.mcap: cannot be read' in fault


def test_who_publishes_some_joints_has_a_clock_of_its_own(robot, tmp_path):
    arm = Arm(robot)
    for i, sample in enumerate([*arm.content]):
        if sample.type == JOINTS:
            theta = arm.theta[i // 2]
            one, other = (joints([name], theta[[j]]) for j, name in enumerate(robot.joints))
            arm.content[i] = sample._replace(data=one)
            behind = sample._replace(data=other, publish_time=sample.publish_time - 20_000_000)
            arm.content.append(behind)
    result = streams(arm, robot, tmp_path)
    assert not result.rejected
    assert np.isfinite(result.joints.values).sum(axis=0).tolist() == [200, 200]


@pytest.mark.parametrize('period', [0.5, 0.2])
def test_a_recorder_that_wrote_in_bunches_costs_no_pairs(robot, tmp_path, period):
    arm = Arm(robot)
    regular = streams(arm, robot, tmp_path).pairs()

    def bunched(sample):
        late = -(-(sample.log_time - samples.START) // round(period * 1e9))
        return sample._replace(log_time=samples.START + late * round(period * 1e9))

    content = [bunched(sample) for sample in arm.content]
    samples.write_ours(tmp_path / 'bunched', content, 'zstd', True)
    result = read_streams(Bag.open(tmp_path / 'bunched'), robot)
    assert any('in bunches' in note for note in result.notes)
    pairs = result.pairs()
    assert len(pairs.time) >= len(regular.time) - 1
    assert_allclose(np.diff(pairs.time), 0.01, atol=1e-6)


def with_false_angles(robot, kind):
    """Return a recording of 10 s in which some joint angles are false."""
    arm = Arm(robot, count=1000)
    for n in range(1000):
        zeros = joints(robot.joints, np.zeros(robot.joint_count))
        if kind == 'second publisher':
            arm.add('/joint_states', JOINTS, n * 0.01 + 0.006, zeros)
    for n in (100, 500, 900) if kind == 'failed reads' else ():
        failed = joints(robot.joints, np.full(robot.joint_count, -np.pi))
        arm.add('/joint_states', JOINTS, n * 0.01 + 0.004, failed)
    return arm


@pytest.mark.parametrize(
    ('kind', 'share', 'is_fault'),
    [('second publisher', '50 %', True), ('failed reads', '0.299 %', False)],
)
def test_false_joint_angles_are_found_with_their_share_and_not_used(
    kind, share, is_fault, robot, tmp_path
):
    arm = with_false_angles(robot, kind)
    result = streams(arm, robot, tmp_path)
    assert_array_equal(result.joints.values, arm.theta)
    check = check_bag(tmp_path / 'bag', robot.description.directory.name)
    found = [text for text in (check.faults if is_fault else check.lines) if share in text]
    assert len(found) == 1 and 'stop a second program that publishes joint_states' in found[0]
    assert bool(check.faults) == is_fault, check.faults
    # Without the robot, the fault is that of the only robot whose messages these are.
    assert any(share in text for text in check_bag(tmp_path / 'bag').faults) == is_fault


def test_muscle_messages_beside_false_joint_angles_are_kept_without_them(robot, tmp_path):
    arm, zeros = Arm(robot, count=1000), np.zeros(robot.joint_count)
    is_false = [400 <= n < 700 for n in range(1000)]
    messages = iter(is_false)
    arm.content = [
        each._replace(data=joints(robot.joints, zeros))
        if each.type == JOINTS and next(messages)
        else each
        for each in arm.content
    ]
    pairs = streams(arm, robot, tmp_path).pairs()
    assert_array_equal(pairs.length, arm.length)
    assert_array_equal(np.isnan(pairs.theta).all(axis=1), is_false)


@pytest.mark.parametrize('first', [0, samples.START - 3600 * 10**9])
def test_a_forward_jump_of_the_log_times_is_a_fault(first, content, tmp_path):
    early = [sample._replace(log_time=first) for sample in content[:5]]
    samples.write_ours(tmp_path / 'bag', [*early, *content[5:]])
    (fault,) = [text for text in check_bag(tmp_path / 'bag').faults if 'jump forward' in text]
    assert ('57.0 years' if first == 0 else '60.0 min') in fault
    assert '--skip-pauses' in fault


@pytest.mark.parametrize('topic', ['/joint_states', '/muscle_states'])
def test_a_topic_that_was_lost_during_the_recording_is_a_fault(topic, robot, tmp_path):
    arm = Arm(robot, count=1500)
    lost_at = samples.START + 4 * 10**9
    arm.content = [each for each in arm.content if each.topic != topic or each.log_time < lost_at]
    arm.write(tmp_path / 'bag')
    (fault,) = check_bag(tmp_path / 'bag', 'arm26').faults
    assert f'no message of {topic} was recorded from 4.0 s to 15.0 s' in fault


def test_a_pause_of_the_recorder_is_not_blamed_on_the_publishers(robot, tmp_path):
    arm, pause = Arm(robot, count=400), 60 * 10**9
    late = samples.START + 2 * 10**9
    arm.content = [
        each._replace(log_time=each.log_time + pause * (each.log_time >= late))
        for each in arm.content
    ]
    arm.write(tmp_path / 'bag')
    faults = check_bag(tmp_path / 'bag', 'arm26').faults
    assert any('the recorder was paused' in fault for fault in faults)
    assert not any('no message of' in fault for fault in faults)


def test_an_encoder_that_wraps_around_is_named_and_no_muscle_is_blamed(robot, tmp_path):
    arm = Arm(robot, count=400)
    theta = iter(np.mod(arm.theta, 2.0 * np.pi))
    arm.content = [
        each._replace(data=joints(robot.joints, next(theta))) if each.type == JOINTS else each
        for each in arm.content
    ]
    result = streams(arm, robot, tmp_path)
    assert_allclose(result.joints.values, arm.theta, atol=1e-12)
    (fault,) = check_bag(tmp_path / 'bag', 'arm26').faults
    assert 'whole turns' in fault and 'subtract the whole turns' in fault


def test_recordings_of_a_robot_without_tensions_are_judged_and_unused_tensions_named(
    arm, robot, tmp_path
):
    modules = with_modules(robot.description, actuation='position', tension_source='none')
    silent = Robot(modules)
    result = streams(arm, silent, tmp_path)
    assert_allclose(result.pairs().tension, np.tile(silent.actuation.assumed_tension, (200, 1)))
    assert not find_faults(silent, result.pairs()).wiring.faulty
    assert not find_faults(silent, result.pairs()).joint_sensors
    (note,) = result.notes
    assert note.startswith('muscle_states has tensions from ') and 'tension_source: sensor' in note
    (tmp_path / 'other').mkdir()
    assert streams(arm, robot, tmp_path / 'other').notes == ()
