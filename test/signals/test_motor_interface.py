# SPDX-License-Identifier: Apache-2.0
"""Conversion of the messages of a ros2_control robot, with the rules of its two controllers."""

import math
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.robot.motors import Motors, MotorTopics
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.motor_interface import MotorInterface
from musculoskeletal_ae.signals.muscle_stream import MuscleStream, RejectionError

MOTORS = 'm0', 'm1', 'm2'
CONNECTED = Motors(
    MotorTopics('/joint_states', '/tendons/commands'),
    joints=MOTORS,
    command_order=('m2', 'm0', 'm1'),
    spool_radius=np.array([0.01, 0.02, 0.01]),
    direction=np.array([-1.0, 1.0, -1.0]),
    zero=np.array([1.0, 0.0, -0.5]),
    tension_per_effort=np.array([100.0, -50.0, 100.0]),
    effort_zero=np.array([0.1, 0.0, 0.0]),
)
POSITION, EFFORT = {'m0': 3.0, 'm1': 1.0, 'm2': 0.5}, {'m0': 0.5, 'm1': -2.0, 'm2': 0.3}
LENGTH, TENSION = [-0.02, 0.02, -0.01], [40.0, 100.0, 30.0]


def joint_state(names=('m1', 'elbow', 'm0', 'gripper', 'm2'), stamp=1, **changes):
    """Return a message of joint_state_broadcaster, with NaN for states that a joint lacks."""
    nan = [math.nan] * len(names)
    fields = {
        'position': [POSITION.get(name, math.nan) for name in names],
        'velocity': nan,
        'effort': [EFFORT.get(name, math.nan) for name in names],
    } | changes
    header = SimpleNamespace(stamp=SimpleNamespace(sec=stamp, nanosec=0))
    return SimpleNamespace(header=header, name=list(names), **fields)


def states(message, motors=CONNECTED):
    return MotorInterface(motors).reading(message)


def directly(robot):
    """Return motors whose positions are lengths, and whose efforts are tensions."""
    ones = np.ones(robot.muscle_count)
    topics, names = MotorTopics('q'), robot.muscles
    return Motors(topics, names, names, ones, ones, 0.0 * ones, ones, 0.0 * ones)


def refused(message, interface=None):
    with pytest.raises(MessageError) as error:
        (interface or MotorInterface(CONNECTED)).reading(message)
    return error.value.reason


def test_positions_and_efforts_become_lengths_and_tensions_by_name_and_temperature_is_unknown():
    for names in (('m1', 'elbow', 'm0', 'gripper', 'm2'), ('m0', 'm1', 'm2')):
        read = states(joint_state(names))
        np.testing.assert_allclose([read.length, read.tension], [LENGTH, TENSION])
        assert np.isnan(read.temperature).all()


def test_an_effort_that_does_not_exist_is_an_unknown_tension_not_zero():
    assert np.isnan(states(joint_state(effort=[])).tension).all()
    read = states(joint_state(effort=[math.nan, math.nan, 0.5, math.nan, 0.3]))
    np.testing.assert_array_equal(np.isnan(read.tension), [False, True, False])


@pytest.mark.parametrize(
    ('message', 'reason'),
    [
        (joint_state(()), 'empty'),
        (joint_state(('m0', 'm1')), 'missing motor'),
        (joint_state(('left', 'right')), 'missing motor'),
        (joint_state(('m0', 'm1', 'm2', 'm1')), 'duplicate motor'),
        (joint_state(position=[0.0] * 4), 'wrong length'),
        (joint_state(position=[]), 'wrong length'),
        (joint_state(effort=[0.0] * 3), 'wrong length'),
        (joint_state(velocity=[0.0]), 'wrong length'),
        (joint_state([f'j{n}' for n in range(10_001)]), 'oversized'),
        (joint_state(stamp=0), 'no stamp'),
    ],
)
def test_an_ambiguous_message_of_the_motors_is_rejected(message, reason):
    assert refused(message) == reason


def test_a_repeated_message_is_rejected_by_its_stamp_until_the_clock_is_set_back():
    interface = MotorInterface(CONNECTED)
    interface.reading(joint_state(stamp=5))
    assert refused(joint_state(stamp=5), interface) == 'repeated stamp'
    interface.reading(joint_state(stamp=6))
    interface.reading(joint_state(stamp=2))  # an earlier stamp, as after the clock was set back
    interface.reset()
    interface.reading(joint_state(stamp=2))


def test_the_names_may_change_from_message_to_message():
    interface = MotorInterface(CONNECTED)
    for stamp, names in enumerate((MOTORS, MOTORS[::-1], ('hand', *MOTORS)), 1):
        np.testing.assert_allclose(interface.reading(joint_state(names, stamp)).length, LENGTH)
    assert refused(joint_state(('hand',), 4), interface) == 'missing motor'


def test_a_position_that_is_not_a_number_is_rejected_by_the_one_stream_of_all_messages():
    robot = Robot.load('arm26')
    interface = MotorInterface(directly(robot))
    position = [0.0] * robot.muscle_count
    position[2] = math.nan
    effort = robot.tension.bias.tolist()
    reading = interface.reading(joint_state(robot.muscles, position=position, effort=effort))
    with pytest.raises(RejectionError, match='not finite: length of brachialis') as rejection:
        MuscleStream(robot).take(reading, 0.0)
    assert rejection.value.readings is not None
    position[2] = 0.0
    reading = interface.reading(joint_state(robot.muscles, 2, position=position, effort=effort))
    sample = MuscleStream(robot).take(reading, 0.0)
    np.testing.assert_allclose(sample.motor_tension, robot.tension.bias)


def test_without_tension_sensors_a_message_without_effort_is_used_and_otherwise_rejected(tmp_path):
    robot = Robot.load('arm26')
    interface = MotorInterface(directly(robot))
    message = joint_state(robot.muscles, position=[0.0] * robot.muscle_count, effort=[])
    with pytest.raises(RejectionError, match='not finite: tension of deltoid_anterior'):
        MuscleStream(robot).take(interface.reading(message), 0.0)
    for file in robot.description.directory.glob('*.*'):
        text = file.read_text('utf-8')
        without = 'actuation: position\ntension_source: none'
        (tmp_path / file.name).write_text(text.replace('stiffness: 10000.0', without))
    blind = Robot.load(tmp_path)
    interface.reset()
    sample = MuscleStream(blind).take(interface.reading(message), 0.0)
    assert (sample.motor_tension == blind.actuation.assumed_tension).all()
    assert (sample.length == 0.0).all()


anything = st.lists(st.floats(width=64), max_size=5)


@given(st.lists(st.sampled_from([*MOTORS, 'elbow']), max_size=5), anything, anything, anything)
def test_whatever_arrives_is_a_reading_or_a_message_error(names, position, velocity, effort):
    arrays = {'position': position, 'velocity': velocity, 'effort': effort}
    with suppress(MessageError):
        assert states(joint_state(names, **arrays)).length.shape == (3,)


def test_a_command_is_in_the_order_of_the_controller():
    command = MotorInterface(CONNECTED).command(np.array(LENGTH))
    np.testing.assert_allclose(command, [POSITION[name] for name in ('m2', 'm0', 'm1')])


values = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3)
signs = st.lists(st.sampled_from([-1.0, 1.0]), min_size=3, max_size=3)
radii = st.lists(st.floats(0.001, 0.1), min_size=3, max_size=3)


@given(values, values, signs, radii, st.permutations(MOTORS))
def test_an_emulated_arm_reads_what_is_commanded_and_publishes_what_is_read(
    length, zero, sign, radius, order
):
    motors = replace(
        CONNECTED,
        zero=np.array(zero),
        direction=np.array(sign),
        spool_radius=np.array(radius),
        command_order=tuple(order),
    )
    interface, taken = MotorInterface(motors), []
    layout = SimpleNamespace(dim=[], data_offset=0)
    data = interface.command(np.array(length)).tolist()
    interface.take_command(taken.append)(SimpleNamespace(data=data, layout=layout))
    np.testing.assert_allclose(taken[0], length, atol=1e-12)
    names, position, effort = interface.joint_values(np.array(length), np.array(TENSION))
    read = interface.reading(joint_state(names, position=position, effort=effort))
    np.testing.assert_allclose([read.length, read.tension], [length, TENSION], atol=1e-12)
