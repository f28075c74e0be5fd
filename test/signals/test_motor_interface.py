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

from musculoskeletal_ae.exceptions import MessageError, MusculoskeletalError
from musculoskeletal_ae.nodes.parameters import motor_settings
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.motor_interface import MotorInterface
from musculoskeletal_ae.signals.motor_settings import MotorSettings
from musculoskeletal_ae.signals.muscle_stream import MuscleStream, RejectionError
from musculoskeletal_ae.validity import read_muscle_states

MUSCLES = 'flexor', 'extensor', 'abductor'
MOTORS = 'm0', 'm1', 'm2'
SETTINGS = MotorSettings(
    motor_state_topic='/joint_states',
    motor_command_topic='/tendons/commands',
    motor_names=MOTORS,
    motor_command_order=('m2', 'm0', 'm1'),
    spool_radius=(0.01, 0.02, 0.01),
    motor_direction=(-1.0, 1.0, -1.0),
    motor_zero=(1.0, 0.0, -0.5),
    tension_per_effort=(100.0, -50.0, 100.0),
    effort_zero=(0.1, 0.0, 0.0),
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


def states(message, settings=SETTINGS):
    return np.reshape(MotorInterface(settings, MUSCLES).reading(message).data, (3, -1))


def refused(message, interface=None):
    with pytest.raises(MessageError) as error:
        (interface or MotorInterface(SETTINGS, MUSCLES)).reading(message)
    return error.value.reason


def test_positions_and_efforts_become_lengths_and_tensions_by_name_and_temperature_is_unknown():
    for names in (('m1', 'elbow', 'm0', 'gripper', 'm2'), ('m0', 'm1', 'm2')):
        rows = states(joint_state(names))
        np.testing.assert_allclose(rows[:2], [LENGTH, TENSION])
        assert np.isnan(rows[2]).all()


def test_without_parameters_a_position_is_a_length_and_an_effort_a_tension():
    message = joint_state(MUSCLES, position=[0.1, -0.1, 0.0], effort=[30.0, 31.0, 32.0])
    rows = states(message, MotorSettings(motor_state_topic='/joint_states'))
    np.testing.assert_allclose(rows[:2], [[0.1, -0.1, 0.0], [30.0, 31.0, 32.0]])


def test_an_effort_that_does_not_exist_is_an_unknown_tension_not_zero():
    assert np.isnan(states(joint_state(effort=[]))[1]).all()
    rows = states(joint_state(effort=[math.nan, math.nan, 0.5, math.nan, 0.3]))
    np.testing.assert_array_equal(np.isnan(rows[1]), [False, True, False])


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
    interface = MotorInterface(SETTINGS, MUSCLES)
    interface.reading(joint_state(stamp=5))
    assert refused(joint_state(stamp=5), interface) == 'repeated stamp'
    interface.reading(joint_state(stamp=6))
    interface.reading(joint_state(stamp=2))  # an earlier stamp, as after the clock was set back
    interface.reset()
    interface.reading(joint_state(stamp=2))


def test_the_names_may_change_from_message_to_message():
    interface = MotorInterface(SETTINGS, MUSCLES)
    for stamp, names in enumerate((MOTORS, MOTORS[::-1], ('hand', *MOTORS)), 1):
        data = interface.reading(joint_state(names, stamp)).data
        np.testing.assert_allclose(data[:3], LENGTH)
    assert refused(joint_state(('hand',), 4), interface) == 'missing motor'


def test_a_position_that_is_not_a_number_is_rejected_by_the_one_stream_of_all_messages():
    robot = Robot.load('arm26')
    interface = MotorInterface(MotorSettings(motor_state_topic='q'), robot.muscles)
    position = [0.0] * robot.muscle_count
    position[2] = math.nan
    effort = robot.tension.bias.tolist()
    reading = interface.reading(joint_state(robot.muscles, position=position, effort=effort))
    with pytest.raises(RejectionError, match='not finite: length of brachialis') as rejection:
        MuscleStream(robot).take(reading, 0.0)
    assert rejection.value.states is not None
    position[2] = 0.0
    reading = interface.reading(joint_state(robot.muscles, 2, position=position, effort=effort))
    sample = MuscleStream(robot).take(reading, 0.0)
    np.testing.assert_allclose(sample.motor_tension, robot.tension.bias)


def test_without_tension_sensors_a_message_without_effort_is_used_and_otherwise_rejected(tmp_path):
    robot = Robot.load('arm26')
    interface = MotorInterface(MotorSettings(motor_state_topic='q'), robot.muscles)
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
    assert np.isnan(sample.motor_tension).all() and (sample.length == 0.0).all()


anything = st.lists(st.floats(width=64), max_size=5)


@given(st.lists(st.sampled_from([*MOTORS, 'elbow']), max_size=5), anything, anything, anything)
def test_whatever_arrives_is_a_reading_or_a_message_error(names, position, velocity, effort):
    arrays = {'position': position, 'velocity': velocity, 'effort': effort}
    with suppress(MessageError):
        assert states(joint_state(names, **arrays)).shape == (3, 3)


def test_a_command_is_in_the_order_of_the_controller():
    command = MotorInterface(SETTINGS, MUSCLES).command(np.array(LENGTH))
    np.testing.assert_allclose(command, [POSITION[name] for name in ('m2', 'm0', 'm1')])


values = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3)
signs = st.lists(st.sampled_from([-1.0, 1.0]), min_size=3, max_size=3)
radii = st.lists(st.floats(0.001, 0.1), min_size=3, max_size=3)


@given(values, values, signs, radii, st.permutations(MOTORS))
def test_an_emulated_arm_reads_what_is_commanded_and_publishes_what_is_read(
    length, zero, sign, radius, order
):
    settings = replace(
        SETTINGS,
        motor_zero=tuple(zero),
        motor_direction=tuple(sign),
        spool_radius=tuple(radius),
        motor_command_order=tuple(order),
    )
    interface, taken = MotorInterface(settings, MUSCLES), []
    layout = SimpleNamespace(dim=[], data_offset=0)
    data = interface.command(np.array(length)).tolist()
    interface.take_command(taken.append)(SimpleNamespace(data=data, layout=layout))
    np.testing.assert_allclose(taken[0], length, atol=1e-12)
    names, position, effort = interface.joint_values(np.array(length), np.array(TENSION))
    rows = read_muscle_states(
        interface.reading(joint_state(names, position=position, effort=effort)), 3
    )
    np.testing.assert_allclose(rows[:2], [length, TENSION], atol=1e-12)


@pytest.mark.parametrize(
    ('changes', 'problem'),
    [
        ({'motor_names': ('m0',)}, 'motor_names: got 1 names; expected a motor for each of the 3'),
        ({'motor_names': ('m0', 'm0', 'm1')}, "'m0' is listed twice"),
        (
            {'motor_command_order': ('m0', 'm1')},
            "motor_command_order: 'm2' is missing, unknown or repeated; expected each of m0",
        ),
        ({'motor_command_order': ('m0', 'm1', 'x')}, 'motor_command_order: '),
        ({'motor_command_order': (*MOTORS, 'm0')}, "motor_command_order: 'm0'"),
        ({'spool_radius': (0.01, 0.02)}, 'spool_radius: got 2 values; expected 1, or 3'),
        ({'motor_direction': (0.5,)}, 'motor_direction: got 0.5; expected 1 or -1'),
        (
            {'tension_per_effort': (1.0, 0.0, 1.0)},
            'tension_per_effort: got 0; expected a number other than 0',
        ),
        ({'motor_state_topic': ''}, 'motor_command_topic: needs motor_state_topic'),
    ],
)
def test_parameters_that_do_not_fit_the_muscles_are_refused(changes, problem):
    with pytest.raises(MusculoskeletalError, match=problem):
        MotorInterface(replace(SETTINGS, **changes), MUSCLES)


def test_tools_read_the_file_of_the_nodes(tmp_path):
    file = tmp_path / 'nodes.yaml'
    file.write_text(
        '/**: {ros__parameters: {max_age: 0.5, motor_names: [m0, m1], spool_radius: [1, 2]}}\n'
        'controller: {ros__parameters: {explore: true}}\n'
    )
    settings = motor_settings([file])
    assert settings == MotorSettings(motor_names=('m0', 'm1'), spool_radius=(1.0, 2.0))
    assert motor_settings([]) == MotorSettings()


@pytest.mark.parametrize(
    ('text', 'problem'),
    [
        ('/**: {ros__parameters: {spool_radius: 0.01}}', 'spool_radius: 0.01; legal: a list of'),
        ('/**: {ros__parameters: {motor_names: m0}}', 'motor_names: '),
        ('/**: {ros__parameters: {motor_state_topic: 3}}', 'motor_state_topic: '),
        ('/**: {ros__parameters: {spool_radiu: [0.01]}}', 'nearest: spool_radius'),
        ('estimator: {ros__parameters: {spool_radius: [0.01]}}', "state it under '/\\*\\*'"),
        ('a: {estimator: {ros__parameters: {spool_radius: [0.01]}}}', "state it under '/\\*\\*'"),
        ('/**: {spool_radius: [0.01]}', 'with a mapping `ros__parameters`'),
        ('just a text', 'with a mapping `ros__parameters`'),
    ],
)
def test_a_file_that_tools_would_misread_is_refused(tmp_path, text, problem):
    file = tmp_path / 'nodes.yaml'
    file.write_text(text)
    with pytest.raises(MusculoskeletalError, match=problem) as error:
        motor_settings([file])
    assert str(file) in str(error.value)
