# SPDX-License-Identifier: Apache-2.0
"""Recordings of a ros2_control robot, whose muscles are joints of a JointState."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from robots import arm_with_motors

from bags.arm_bag import ARRAY, JOINTS, PERIOD, Arm, array
from bags.bag_samples import encode, message_class
from musculoskeletal_ae.bags.check import check_bag
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.streams import read_streams
from musculoskeletal_ae.bags.topics import interface_topics, select
from musculoskeletal_ae.exceptions import BagError
from musculoskeletal_ae.robot.motors import MotorTopics
from musculoskeletal_ae.robot.robot import Robot

ROBOT = Robot.load('arm26')
MOTORS = tuple(f'{muscle}_motor' for muscle in ROBOT.muscles)
RADIUS = 0.01  # radius of the spools [m]
COUNT = 40


@pytest.fixture
def robot(tmp_path):
    """Return a function that makes arm26 with motors on a topic."""

    def make(topic='/joint_states', **changes):
        motors = {muscle: {'joint': motor} for muscle, motor in zip(ROBOT.muscles, MOTORS)}
        content = {
            'state_topic': topic,
            'command_topic': '/tendons/commands',
            'spool_radius': RADIUS,
            'direction': -1,
            'motors': motors,
        }
        folder = Path(tempfile.mkdtemp(dir=tmp_path))
        return Robot.load(arm_with_motors(folder, **content | changes))

    return make


def joint_state(names, position, effort, stamp):
    time = message_class('builtin_interfaces/msg/Time')(stamp, 0)
    header = message_class('std_msgs/msg/Header')(time, '')
    values = np.array(position), np.full(len(names), np.nan), np.array(effort)
    return encode(message_class(JOINTS)(header, list(names), *values), JOINTS)


def recording(path, topic='/joint_states', joints=ROBOT.joints, stamps=range(1, COUNT + 1)):
    """Write a bag with the states of motors and joints on one topic; return the recorded arm."""
    arm = Arm(ROBOT, count=COUNT)
    arm.content.clear()
    for i, stamp in zip(range(COUNT), stamps):
        names = [*reversed(MOTORS), *joints]
        position = [*(-arm.length[i] / RADIUS)[::-1], *arm.theta[i][: len(joints)]]
        effort = [*arm.tension[i][::-1], *[np.nan] * len(joints)]
        data = joint_state(names, position, effort, stamp)
        arm.add(topic, JOINTS, i * PERIOD, data)
        arm.add('/tendons/commands', ARRAY, i * PERIOD, array(arm.length[i]))
        arm.add('/muscle_length_command', ARRAY, i * PERIOD, array(arm.length[i]))
    arm.write(path)
    return arm


@pytest.mark.parametrize(
    ('topic', 'stated'),
    [
        ('/joint_states', '/joint_states'),
        ('/joint_states', 'joint_states'),
        ('/joint_state_broadcaster/joint_states', '/joint_state_broadcaster/joint_states'),
        ('/joint_state_broadcaster/joint_states', 'joint_state_broadcaster/joint_states'),
        ('/tendons/states', '/tendons/states'),
    ],
)
def test_motors_are_read_as_muscles_and_the_joints_beside_them_as_joints(
    robot, tmp_path, topic, stated
):
    arm = recording(tmp_path / 'bag', topic)
    streams = read_streams(Bag.open(tmp_path / 'bag'), robot(stated))
    assert_allclose(streams.muscles.length, arm.length)
    assert_allclose(streams.muscles.tension, arm.tension)
    assert np.isnan(streams.muscles.temperature).all()
    assert not streams.rejected
    if topic.endswith('joint_states'):
        assert_allclose(streams.pairs().theta, arm.theta)


def test_a_robot_without_joint_sensors_is_read_and_what_was_not_used_is_counted(robot, tmp_path):
    recording(tmp_path / 'bag', joints=(), stamps=[1, 1, 0, *range(2, COUNT - 1)])
    streams = read_streams(Bag.open(tmp_path / 'bag'), robot())
    assert len(streams.muscle_times) == COUNT - 2 and not len(streams.joints.time)
    assert streams.rejected == {
        '/joint_states as muscle_states: repeated stamp': 1,
        '/joint_states as muscle_states: no stamp': 1,
        '/joint_states as joint_states: missing joint': COUNT,
    }


def test_what_is_recorded_of_another_robot_is_refused_with_the_motors_that_are_missing(
    robot, tmp_path
):
    recording(tmp_path / 'bag')
    other = robot(motors={})
    with pytest.raises(
        BagError, match=r'missing motor: deltoid_anterior, .* the message contains '
    ):
        read_streams(Bag.open(tmp_path / 'bag'), other)
    with pytest.raises(BagError, match=r'/states, which motors\.yaml names, is not in the'):
        interface_topics(Bag.open(tmp_path / 'bag'), motors=MotorTopics('/states'))
    assert not check_bag(tmp_path / 'bag', str(robot().description.directory)).faults
    assert check_bag(tmp_path / 'bag', str(other.description.directory)).faults


def test_a_replay_publishes_what_the_motors_measured_and_never_what_moves_them(tmp_path):
    topic = '/joint_state_broadcaster/joint_states'
    recording(tmp_path / 'bag', topic)
    motors = MotorTopics(topic, '/tendons/commands')
    for keep_names in (False, True):
        chosen = select(Bag.open(tmp_path / 'bag'), ['default'], None, keep_names, motors)
        assert chosen[topic] == topic and '/tendons/commands' not in chosen
        assert set(chosen) == {topic, '/muscle_length_command'}
    named = select(Bag.open(tmp_path / 'bag'), ['/tendons/commands'], None, True, motors)
    assert set(named) == {'/tendons/commands'}


def test_motors_whose_positions_wrap_around_do_not_pass_the_check(robot, tmp_path):
    arm = Arm(ROBOT, count=COUNT)
    arm.content.clear()
    for i in range(COUNT):
        position = np.mod(-arm.length[i] / RADIUS + np.pi, 2.0 * np.pi) - np.pi
        names, values = [*MOTORS, *ROBOT.joints], [*position, *arm.theta[i]]
        effort = [*arm.tension[i], *[np.nan] * ROBOT.joint_count]
        arm.add('/joint_states', JOINTS, i * PERIOD, joint_state(names, values, effort, i + 1))
    arm.write(tmp_path / 'bag')
    with_motors = str(robot().description.directory)
    faults = check_bag(tmp_path / 'bag', with_motors).faults
    assert any('were rejected: length jumped. Run check_driver' in fault for fault in faults)


@pytest.mark.parametrize('factor', [-1.0, 1000.0, np.nan])
def test_a_false_sign_or_unit_of_efforts_is_not_taken_for_another_robot(factor, robot, tmp_path):
    arm = Arm(ROBOT, count=COUNT)
    arm.content.clear()
    for i in range(COUNT):
        position, effort = -arm.length[i] / RADIUS, factor * arm.tension[i]
        arm.add('/joint_states', JOINTS, i * PERIOD, joint_state(MOTORS, position, effort, i + 1))
    arm.write(tmp_path / 'bag')
    with pytest.raises(BagError, match='correct what the driver publishes'):
        read_streams(Bag.open(tmp_path / 'bag'), robot())
