# SPDX-License-Identifier: Apache-2.0
"""Each change that check_driver prints is made in the driver that has the fault.

A row of a table has the kind of a fault in driver_problems.yaml, a part of its advice, a function
that makes a driver with this fault, and the functions that follow the advice. The latter change
what leaves or reaches the faulty driver, and use no more than the printed text and what a user
would look up. A change after which the fault, or another one, is found fails its test.
"""

import copy
import math
import os
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from robots import copy_robot, read_muscles, with_modules, write_muscles

from driver.scripted import Driver, array, joint_state, muscle_rows
from driver.test_faults import (
    BIAS,
    BICEPS,
    POSITION,
    ROBOT,
    K,
    M,
    exchanged,
    inverted_law,
    law,
    neck,
    recording,
    rows_in,
    scaled,
    settled,
    silent,
    stiff_and_strong,
    unclipped,
    with_tension,
)
from driver.test_order import CYCLE, misordered
from musculoskeletal_ae.driver.listening import TENSION_UNITS, UNITS, Listening
from musculoskeletal_ae.driver.position_motion_test import Positioning
from musculoskeletal_ae.driver.stiffness_motion_test import Winding
from musculoskeletal_ae.driver.verdict import PROBLEMS, Verdict
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.description import TensionRange
from musculoskeletal_ae.robot.motors import Motors, MotorTopics
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.motor_interface import MotorInterface

assert neck  # a fixture

LENGTH, TENSION, TEMPERATURE = range(3)
MOTORS = tuple(f'motor_{m}' for m in range(M))
CURRENT = Robot(with_modules(ROBOT.description, 'position', 'current'))
#: a robot whose first muscle is too weak for the motion test
WEAK = Robot(
    replace(
        ROBOT.description,
        tension=TensionRange(
            ROBOT.tension.bias,
            *(
                np.r_[most, each[1:]]
                for most, each in ((35.0, ROBOT.tension.limit), (45.0, ROBOT.tension.max))
            ),
        ),
    )
)
#: faults that have no row here
EXCEPTIONS = {
    'several': 'needs the graph of ROS: test/nodes/test_check_driver.py',
    'several of joints': 'needs the graph of ROS: test/nodes/test_check_driver.py',
    'type': 'needs the graph of ROS: test/nodes/test_check_driver.py',
    'deaf': 'needs the graph of ROS: test/nodes/test_check_driver.py',
    'silence': 'needs the graph of ROS: test/nodes/test_check_driver.py',
}


@pytest.fixture(autouse=True)
def is_idle(monkeypatch):
    """Pretend that this computer is not overloaded."""
    monkeypatch.setattr(os, 'getloadavg', lambda: (0.0, 0.0, 0.0))


def then(driver, attribute, change):
    """Apply `change` to what the driver already publishes as `publish` or `angles`."""
    before = getattr(driver, attribute)
    setattr(driver, attribute, lambda values: change(before(values)))


def first(driver, change):
    """Apply `change` to a command before the driver takes it."""
    take = driver.take
    driver.take = lambda target: take(change(target))


def muscles_in(text):
    """Return the indices of the muscles that a text names, in the order of the text."""
    places = {m: text.find(name) for m, name in enumerate(ROBOT.muscles)}
    return sorted((m for m in places if places[m] >= 0), key=places.get)


def muscles_of(fault):
    """Return the indices of the muscles that a fault concerns."""
    return [ROBOT.muscles.index(name) for name in fault.subjects]


def joints_in(text):
    return [j for j, name in enumerate(ROBOT.joints) if name in text]


def numbers_in(text):
    return [float(each) for each in re.findall(r'[-+]?\d+(?:\.\d+)?', text)]


def law_in(text, robot=ROBOT):
    """Return the control law with the constants that the advice states."""
    bias, stiffness = re.search(r'T_bias ([\d.]+) N, K ([\d.e+]+) N/m', text).groups()
    return law(float(bias), float(stiffness), robot.tension.max[0])


# -- rejected messages ----------------------------------------------------------------------------


def sound_rows():
    """Return rows of an arm at rest, with a little noise."""
    noise = np.random.default_rng(0)
    still = np.stack(
        [
            ROBOT.muscle_lengths(0.5 * (ROBOT.lower + ROBOT.upper), ROBOT.tension.bias),
            ROBOT.tension.bias,
            np.full(M, 30.0),
        ]
    )
    return lambda: still + 1e-4 * noise.normal(size=still.shape)


def layout(*dims, offset=0):
    keys = 'label', 'size', 'stride'
    return SimpleNamespace(
        dim=[SimpleNamespace(**dict(zip(keys, each))) for each in dims], data_offset=offset
    )


def motor_state(rows, now, **other):
    position = dict(zip(MOTORS, rows[LENGTH]))
    effort = list(rows[TENSION])
    stamp = SimpleNamespace(sec=1 + int(now), nanosec=round(now % 1.0 * 1e9))
    fields = {'name': list(position), 'position': list(position.values()), 'velocity': []}
    header = SimpleNamespace(stamp=stamp)
    return SimpleNamespace(**{**fields, 'effort': effort, 'header': header, **other})


def states(change):
    """Return a function that computes a message of muscle_states; `change` edits it."""

    def message(rows, _):
        made = array(rows)
        change(made)
        return made

    return message


def edited(**values):
    return states(lambda message: vars(message).update(values))


def with_layout(*dims, offset=0):
    return edited(layout=layout(*dims, offset=offset))


def not_finite(message):
    message.data[M + 2] = math.nan


SOUND = states(lambda _: None)
STATES = {
    'not finite': (states(not_finite), 'publish finite lengths and tensions', [SOUND]),
    'wrong length': (lambda rows, _: array(rows[:2]), '3×M values', [SOUND]),
    'empty': (edited(data=np.zeros(0)), '3×M values', [SOUND]),
    'oversized': (edited(data=np.zeros(10_001)), '3×M values', [SOUND]),
    'wrong layout': (
        with_layout(('row', 3, 18), ('muscle', M, M), offset=1),
        "('quantity', 3, 3M), ('muscle', M, M), or empty, and data_offset is 0",
        [with_layout(('quantity', 3, 3 * M), ('muscle', M, M)), with_layout()],
    ),
}


def angles(**values):
    """Return a function that computes a message of joint_states; `values` replace its fields."""

    def message(_, __):
        made = joint_state(dict.fromkeys(ROBOT.joints, 0.5))
        made.position = (0.5 * (ROBOT.lower + ROBOT.upper)).tolist()
        vars(made).update(values)
        return made

    return message


JOINT_STATES = {
    'not finite': (
        angles(position=[math.nan] * 2),
        'leave out the joints whose sensors do not work',
        [None, angles(name=['elbow'], position=[1.0])],
    ),
    'wrong length': (
        angles(position=[], velocity=[0.0, 0.0]),
        'one entry per joint, each joint once; `velocity` and `effort` may be empty',
        [angles(), angles(velocity=[0.0, 0.0])],
    ),
    'empty': (angles(name=[], position=[]), 'fill `name` and `position`', [angles()]),
    'oversized': (
        angles(name=['elbow'] * 10_001, position=[0.0] * 10_001),
        'one entry per joint',
        [angles()],
    ),
    'duplicate joint': (
        angles(name=['elbow', 'elbow'], position=[1.0, 1.0]),
        'each joint once',
        [angles()],
    ),
    'missing joint': (
        angles(name=['joint_1', 'joint_2']),
        'use the joint names of muscles.yaml; a message may contain some of the joints',
        [angles(), angles(name=['elbow'], position=[1.0])],
    ),
}


def motors(**values):
    """Return a function that computes a message of motors; `values` replace its fields."""
    return lambda rows, now: motor_state(rows, now, **values)


def of_motors(edit):
    """Return a function that computes a message of motors; `edit` edits it."""

    def message(rows, now):
        made = motor_state(rows, now)
        edit(made)
        return made

    return message


def rename(message):
    message.name[0] = 'other'


def twice(message):
    for field in (message.name, message.position, message.effort):
        field.append(field[0])


def one_stamp(message):
    message.header.stamp = SimpleNamespace(sec=5, nanosec=0)


def no_stamp(message):
    message.header.stamp = SimpleNamespace(sec=0, nanosec=0)


MOTOR_STATES = {
    'empty': (motors(name=[], position=[], effort=[]), 'fill `name`, `position` and `effort`', []),
    'oversized': (
        motors(name=['a'] * 10_001, position=[0.0] * 10_001, effort=[]),
        'each motor of this robot once',
        [],
    ),
    'wrong length': (motors(position=[]), 'fill `name`, `position` and `effort`', []),
    'missing motor': (of_motors(rename), 'list all motors in one joint_state_broadcaster', []),
    'duplicate motor': (of_motors(twice), 'each motor of this robot once', []),
    'no stamp': (of_motors(no_stamp), 'set header.stamp to the time of the reading', []),
    'repeated stamp': (of_motors(one_stamp), 'publish each reading once, with its own stamp', []),
    'not finite': (motors(effort=[]), 'add this state interface to the hardware component', []),
}


def connected(joints=MOTORS):
    """Return how motors are connected: their positions are lengths, their efforts tensions."""
    ones = np.ones(M)
    return Motors(
        MotorTopics('joint_states'), joints=joints, command_order=joints, spool_radius=ones,
        direction=ones, zero=0.0 * ones, tension_per_effort=ones, effort_zero=0.0 * ones,
    )  # fmt: skip


def judged(message, of_joints, motors=None, robot=ROBOT):
    """Return the verdict on a second of messages.

    Args:
        message: Computes a message of the muscles from rows and a time.
        of_joints: The same for the joint angles; None for none.
        motors: How the motors are connected, or None for a driver.
        robot: The robot.
    """
    listening, rows = Listening(robot, 100.0, motors=MotorInterface(motors)), sound_rows()
    for k in range(100):
        if of_joints:
            listening.joints(of_joints(None, None))
        listening.muscles(message(rows(), 0.01 * k), 0.01 * k)
    return listening.verdict(1.0)


MESSAGES = {
    **{f'muscle_states: {reason}': (*row, 'muscles') for reason, row in STATES.items()},
    **{f'joint_states: {reason}': (*row, 'joints') for reason, row in JOINT_STATES.items()},
    **{f'motors: {reason}': (*row, 'motors') for reason, row in MOTOR_STATES.items()},
}


def fault_of(message):
    """Return the name of the fault that a message causes."""
    return message if message in PROBLEMS else f'{message.partition(": ")[0]}: refused'


@pytest.mark.parametrize('name', MESSAGES)
def test_a_message_is_accepted_after_the_change(name):
    wrong, advice, changed, topic = MESSAGES[name]

    def verdict(message):
        if topic == 'joints':
            return judged(SOUND, message)
        return judged(message, angles(), connected() if topic == 'motors' else None)

    (fault, *_) = verdict(wrong).faults
    assert fault.kind == fault_of(name) and advice in fault.remedy
    assert name.partition(': ')[2] in fault.text  # the reason
    for message in changed or [motors()]:
        assert not verdict(message).faults, str(verdict(message))


def test_the_motors_of_a_message_are_found_after_the_correction_of_their_names():
    renamed = ('other', *MOTORS[1:])
    (fault,) = judged(of_motors(rename), angles(), connected()).faults
    assert 'or correct `joint` in motors.yaml' in fault.remedy
    assert not judged(of_motors(rename), angles(), connected(renamed)).faults


def without_tension(rows, _):
    return array(rows * [[1.0], [math.nan], [1.0]])


@pytest.mark.parametrize(
    ('message', 'motors'), [(without_tension, None), (motors(effort=[]), connected())]
)
def test_readings_without_tension_are_accepted_after_the_change_of_muscles_yaml(
    message, motors, tmp_path
):
    (fault,) = judged(message, angles(), motors).faults
    assert fault.kind.endswith(': not finite')
    advice = re.split('[Ww]ithout (?:effort|tension sensors)', fault.remedy)[1]
    directory = copy_robot('arm26', tmp_path)
    document = read_muscles(directory) | dict(re.findall(r'(\w+): (\w+)', advice))
    for removed in re.findall(r'remove its `(\w+)`', advice):
        del document[removed]
    robot = Robot.load(write_muscles(directory, document))
    verdict = judged(message, angles(), motors, robot)
    assert not verdict.faults, str(verdict)


# -- listening ------------------------------------------------------------------------------------


class Heard(NamedTuple):
    """A fault that listening finds, and the changes that its advice allows."""

    spoil: Callable  # gives a driver the fault
    advice: str  # a part of the advice
    changes: list[Callable]  # each follows the advice, called with the driver and the fault
    moved: bool = False  # whether a hand moves the arm
    robot: Robot = ROBOT


def publishing(change):
    """Return a function that lets a driver change the rows that it publishes."""
    return lambda driver: then(driver, 'publish', change)


def with_angles(change):
    """Return a function that lets a driver change the joint angles that it publishes."""
    return lambda driver: then(driver, 'angles', change)


def of_muscle(m, row, change):
    """Return a change of rows: that of one quantity of one muscle."""

    def changed(rows):
        rows = rows.copy()
        rows[row, m] = change(rows[row, m])
        return rows

    return changed


def to_row_order(driver, fault):
    """Publish length, tension and temperature in this order; the fault says what the rows are."""
    names = re.search(r'rows look like (.*)', fault.text)[1].split(', ')
    order = [names.index(name) for name in ('length', 'tension', 'temperature')]
    then(driver, 'publish', lambda rows: rows[order])


def to_rows(driver, _):
    then(driver, 'publish', lambda rows: rows.reshape(M, 3).T)


def to_unit(row, unit):
    """Return a change: convert a row from the unit of the driver, which the fault names."""

    def change(driver, fault):
        named = fault.text.rpartition(' look like ')[2].split(' or ')
        assert unit in named or unit.replace('N', 'A') in named
        units = {unit: factor for each in UNITS.values() for unit, factor in each.items()}
        factors = [1.0, 1.0, 1.0]
        factors[row] = (units | TENSION_UNITS)[unit]
        then(driver, 'publish', scaled(*factors))

    return change


def to_celsius(driver, _):
    then(driver, 'publish', lambda rows: rows - [[0.0], [0.0], [273.15]])


def to_positive(driver, fault):
    for m in muscles_of(fault):
        then(driver, 'publish', of_muscle(m, TENSION, lambda tension: -tension))


def zero_the_tension_sensor(driver, fault):
    """Subtract what each sensor reads with the tendon detached."""
    detached = driver.publish(np.zeros((3, M)))[TENSION]
    for m in muscles_of(fault):
        then(driver, 'publish', of_muscle(m, TENSION, lambda read, m=m: read - detached[m]))


def zero_the_length(driver, fault):
    """Let l of these muscles be 0 at θ = 0, where the route has the length 0 as well."""
    at_zero = driver.publish(np.zeros((3, M)))[LENGTH]
    for m in muscles_of(fault):
        then(driver, 'publish', of_muscle(m, LENGTH, lambda length, m=m: length - at_zero[m]))


def reverse_lengths(driver, fault):
    for m in muscles_of(fault):
        then(driver, 'publish', of_muscle(m, LENGTH, lambda length: -length))


def subtract_the_offset(driver, fault):
    off = 1e-3 * numbers_in(fault.text)[0]
    for m in muscles_of(fault):
        then(driver, 'publish', of_muscle(m, LENGTH, lambda length: length - off))


def correct_the_radius(driver, _):
    """Compute l with the radius that a user measures."""
    then(driver, 'publish', of_muscle(BICEPS, LENGTH, lambda length: length / 3.0))


def publish_in_order(driver, faults):
    """Move every column to the muscle that it behaves like, as the faults say."""
    order = list(range(M))
    for fault in faults if isinstance(faults, list) else [faults]:
        (m,), (other,) = muscles_of(fault), muscles_in(fault.text)
        order[other] = m
    then(driver, 'publish', lambda rows: rows[:, order])


def to_radians(driver, fault):
    turned = joints_in(fault.text)
    then(driver, 'angles', lambda theta: np.where(np.isin(range(len(theta)), turned),
                                                  np.radians(theta), theta))  # fmt: skip


def reverse_angles(driver, fault):
    sign = np.ones(ROBOT.joint_count)
    sign[joints_in(fault.text)] = -1.0
    then(driver, 'angles', lambda theta: sign * theta)


def exchange_angles(driver, fault):
    one, other = joints_in(fault.text)
    order = list(range(ROBOT.joint_count))
    order[one], order[other] = other, one
    then(driver, 'angles', lambda theta: theta[order])


def leave_out(driver, fault):
    (j,) = joints_in(fault.text)
    driver.names = [name for name in ROBOT.joints if name != ROBOT.joints[j]]
    then(driver, 'angles', lambda theta: np.delete(theta, j))


def option(**values):
    """Return a change: call check_driver with other options."""
    return lambda driver, _: driver.options.update(values)


def frozen(muscles=slice(None)):
    """Return a function that repeats the first reading of muscles for ever."""

    def spoil(driver):
        read = []

        def publish(rows):
            read.append(rows)
            rows = rows.copy()
            rows[:, muscles] = read[0][:, muscles]
            return rows

        driver.publish = publish

    return spoil


def publish_all(driver, _):
    driver.publish = lambda rows: rows


def every_reading_twice(driver):
    read = []
    driver.publish = lambda rows: read.append(rows) or read[len(read) // 2]


def noiseless(driver):
    """Let the sensors of all muscles and joints have no noise."""
    middle = 0.5 * (ROBOT.lower + ROBOT.upper)

    def theta():
        if not driver.options.get('moved'):
            return middle
        return middle + 0.3 * np.sin([driver.now, 1.3 * driver.now]) * (ROBOT.upper - ROBOT.lower)

    bias = ROBOT.tension.bias
    driver.angles = lambda _: theta()
    driver.publish = lambda _: np.stack(
        [ROBOT.muscle_lengths(theta(), bias), bias, np.full(M, 30.0)]
    )


def one_noiseless(driver):
    """Let the sensors of one muscle have no noise."""
    at_rest = recording(False)[0].theta

    def publish(rows):
        rows = rows.copy()
        theta = driver.arm.sense().theta if driver.options.get('moved') else at_rest
        rows[0, 3] = ROBOT.muscle_lengths(theta, ROBOT.tension.bias)[3]
        rows[1, 3] = BIAS
        return rows

    driver.publish = publish


def move_by_hand(driver, _):
    driver.options = {'moved': True}


def amperes(factor=1.0):
    """Return a change of rows: motor currents instead of tensions, times a factor."""
    return lambda rows: rows * [[1.0], [factor / CURRENT.tension_source.newton_per_ampere[0]], [1]]


def angles_of_a_second_publisher(driver):
    count = []

    def publish(theta):
        count.append(theta)
        return theta if len(count) % 2 else 0.0 * theta

    driver.angles = publish


def angles_with_turns(driver):
    driver.angles = lambda theta: theta + [0.0, 4.0 * np.pi]


def subtract_turns(driver, _):
    then(driver, 'angles', lambda theta: theta - 2.0 * np.pi * np.round(
        (theta - 0.5 * (ROBOT.lower + ROBOT.upper)) / (2.0 * np.pi)))  # fmt: skip


def only_one_publisher(driver, _):
    driver.angles = lambda theta: theta


HEARD = {
    'rows': Heard(
        publishing(rows_in([1, 0, 2])), 'publish length, tension, temperature', [to_row_order]
    ),
    'rows, cyclic': Heard(
        publishing(rows_in([2, 0, 1])), 'publish length, tension, temperature', [to_row_order]
    ),
    'by muscle': Heard(
        publishing(lambda rows: rows.T.reshape(3, M)), 'publish 3 rows', [to_rows]
    ),
    'temperature unit, K': Heard(
        publishing(lambda rows: rows + [[0], [0], [273.15]]), 'publish °C', [to_celsius]
    ),
    'length unit': Heard(publishing(scaled(1000, 1, 1)), 'publish m', [to_unit(LENGTH, 'mm')]),
    'length unit, moved': Heard(
        publishing(scaled(100, 1, 1)), 'publish m', [to_unit(LENGTH, 'cm')], moved=True
    ),
    'length': Heard(
        publishing(of_muscle(BICEPS, LENGTH, lambda length: length + 2.0)),
        'publish m, with l = 0 at θ = 0',
        [zero_the_length],
    ),
    'tension': Heard(
        publishing(of_muscle(BICEPS, TENSION, lambda tension: -tension)),
        'publish N; tension is positive',
        [to_positive],
    ),
    'tension unit': Heard(publishing(scaled(1, 1000, 1)), 'publish N', [to_unit(TENSION, 'mN')]),
    'tension unit, kgf': Heard(
        publishing(scaled(1, 1 / 9.80665, 1)), 'publish N', [to_unit(TENSION, 'kgf')]
    ),
    'tension sign': Heard(
        publishing(scaled(1, -1, 1)), 'publish tension as a positive value', [to_positive]
    ),
    'current': Heard(
        publishing(lambda rows: of_muscle(BICEPS, TENSION, lambda i: 500.0 * i)(amperes()(rows))),
        'publish A; correct torque_constant, gear and spool_radius',
        [lambda driver, _: then(driver, 'publish',
                                of_muscle(BICEPS, TENSION, lambda i: i / 500.0))],
        robot=CURRENT,
    ),
    'current unit': Heard(
        publishing(amperes(1000.0)), 'publish A', [to_unit(TENSION, 'mN')], robot=CURRENT
    ),
    'current sign': Heard(
        publishing(amperes(-1.0)),
        'publish currents that are positive while the motor winds in',
        [to_positive],
        robot=CURRENT,
    ),
    'resting tension': Heard(
        publishing(of_muscle(BICEPS, TENSION, lambda tension: tension + 35.0)),
        'zero the tension sensor with the tendon detached',
        [zero_the_tension_sensor],
    ),
    'temperature unit': Heard(
        publishing(scaled(1, 1, 10)), 'publish °C', [to_unit(TEMPERATURE, 'tenths of °C')]
    ),
    'impossible value': Heard(
        publishing(of_muscle(BICEPS, TEMPERATURE, lambda _: 850.0)),
        'publish °C, or NaN if it is not measured',
        [lambda driver, _: then(driver, 'publish',
                                of_muscle(BICEPS, TEMPERATURE, lambda _: math.nan))],
    ),
    'degrees': Heard(
        with_angles(np.degrees), 'publish joint_states in rad', [to_radians], moved=True
    ),
    'joint sign': Heard(
        with_angles(lambda theta: theta * [1.0, -1.0]),
        'publish θ with the sign that the axis in robot.urdf defines',
        [reverse_angles],
        moved=True,
    ),
    'joint sign, all': Heard(
        with_angles(lambda theta: -theta),
        'publish θ with the sign that the axis in robot.urdf defines',
        [reverse_angles],
        moved=True,
    ),
    'joint order': Heard(
        with_angles(lambda theta: theta[::-1]),
        'publish each position under the name of its joint',
        [exchange_angles],
        moved=True,
    ),
    'joint': Heard(
        with_angles(lambda theta: theta + [3.0, 0.0]),
        'with the sign and zero of the URDF',
        [lambda driver, _: then(driver, 'angles', lambda theta: theta - [3.0, 0.0])],
        moved=True,
    ),
    'joint not finite': Heard(
        with_angles(lambda theta: np.array([theta[0], math.nan])),
        'leave the joint out of joint_states while the sensor does not work',
        [leave_out],
    ),
    'false joint angles': Heard(
        angles_of_a_second_publisher,
        'stop a second program that publishes joint_states',
        [only_one_publisher],
        moved=True,
    ),
    'false joint angles, turns': Heard(
        angles_with_turns,
        'subtract the whole turns that the encoder counts',
        [subtract_turns],
        moved=True,
    ),
    'rate': Heard(
        lambda driver: setattr(driver, 'period', 0.05),
        'publish at 100 Hz, or set the parameter `rate` of the nodes and the option --rate',
        [lambda driver, _: setattr(driver, 'period', 0.01), option(rate=20.0)],
    ),
    'gap': Heard(
        lambda driver: setattr(driver, 'period', 1.2),
        'read and publish in a separate loop that never waits',
        [lambda driver, _: setattr(driver, 'period', 0.01)],
    ),
    'repeated': Heard(every_reading_twice, 'publish each reading once', [publish_all]),
    'repeated, without noise': Heard(
        noiseless, 'if the sensors have no noise, move the arm during the check', [move_by_hand]
    ),
    'stuck': Heard(frozen([3]), 'check that this module is read', [publish_all]),
    'stuck, without noise': Heard(
        one_noiseless,
        'if its sensors have no noise, move the arm during the check',
        [move_by_hand],
    ),
    'place': Heard(
        publishing(exchanged),
        'publish the readings in the order of muscles.yaml',
        [publish_in_order],
        moved=True,
    ),
    'place, three': Heard(
        publishing(lambda rows: rows[..., [2, 0, 1, 3, 4, 5]]),
        'publish the readings in the order of muscles.yaml',
        [publish_in_order],
        moved=True,
    ),
    'sign': Heard(
        publishing(of_muscle(BICEPS, LENGTH, lambda length: -length)),
        'l must fall when the motor winds in',
        [reverse_lengths],
        moved=True,
    ),
    'all signs': Heard(
        publishing(scaled(-1, 1, 1)), 'reverse the sign of every l', [reverse_lengths], moved=True
    ),
    'slope': Heard(
        publishing(of_muscle(BICEPS, LENGTH, lambda length: 3.0 * length)),
        'check the radius of the spool, its encoder, and the route',
        [correct_the_radius],
        moved=True,
    ),
    'zero': Heard(
        publishing(of_muscle(BICEPS, LENGTH, lambda length: length + 0.08)),
        'subtract the offset',
        [subtract_the_offset, option(zeroed=False)],
        moved=True,
    ),
    'zero at rest': Heard(
        publishing(of_muscle(BICEPS, LENGTH, lambda length: length + 0.08)),
        'then subtract the offset',
        [subtract_the_offset, option(zeroed=False)],
    ),
}  # fmt: skip


def listen(case, change=None, faults=()):
    """Return the verdict on the driver of a case; `change` follows the advice on `faults`."""
    driver = silent(case.moved)
    driver.robot, driver.options = case.robot, {}
    case.spoil(driver)
    for fault in faults:
        change(driver, fault)
    options = {'moved': case.moved, **driver.options}
    if options['moved'] and not case.moved:
        driver.arm = silent(True).arm
    seconds = 8.0 if options['moved'] else 3.0
    listening = Listening(case.robot, options.get('rate', 100.0), None, options.get('zeroed', True))
    for _ in range(round(seconds / 0.01)):
        for theta, rows in driver.step():
            listening.joints(joint_state(dict(zip(driver.names, driver.angles(theta)))))
            listening.muscles(array(rows), driver.now)
    return listening.verdict(driver.now)


@pytest.mark.parametrize('name', HEARD)
def test_a_fault_that_listening_finds_is_gone_after_the_change(name):
    case, fault_name = HEARD[name], name.partition(', ')[0]
    before = listen(case)
    assert {fault.kind for fault in before.faults} == {fault_name}, str(before)
    assert case.advice in before.faults[0].remedy
    assert not before.allows_motion
    assert before.conclusion == 'driver check FAILED: fix the faults above'
    for change in case.changes:
        faults = before.faults
        if change is publish_in_order:  # the faults describe one order together
            faults = [before.faults]
        after = listen(case, change, faults)
        assert not after.faults, str(after)


def test_the_first_step_against_a_wrong_zero_at_rest_finds_a_wrong_sign():
    """A sign that looks like a wrong zero at rest is seen while a hand moves the arm."""
    at_rest = HEARD['zero at rest']
    middle = recording(False)[0].muscles.length[BICEPS]
    # The sensor counts in the wrong direction from a zero that is wrong as well.
    turned = publishing(of_muscle(BICEPS, LENGTH, lambda length: 2.0 * middle - length + 0.08))
    (fault,) = listen(at_rest._replace(spoil=turned)).faults
    assert fault.kind == 'zero at rest'
    assert fault.remedy.startswith('run check_driver without --move, and move the arm by hand')
    (fault,) = listen(at_rest._replace(spoil=turned, moved=True)).faults
    assert fault.kind == 'sign'


@pytest.mark.parametrize('is_sensor', [True, False])
def test_the_steps_against_a_reversed_sensor_of_a_symmetric_arm_end_the_fault(neck, is_sensor):
    """If the sign of the sensor is right, the muscles that the second step names are exchanged."""
    mirrored = [1, 0, 3, 2]
    signs, order = ([1.0, -1.0], [0, 1, 2, 3]) if is_sensor else ([1.0, 1.0], mirrored)

    def verdict(signs, order):
        listening, noise = Listening(neck, 100.0), np.random.default_rng(0)
        for k in range(400):
            share = 0.5 - 0.5 * np.cos(0.02 * k * np.array([1.0, 1.3]))
            theta = neck.lower + share * (neck.upper - neck.lower)
            rows = np.stack([neck.muscle_lengths(theta, neck.tension.bias), neck.tension.bias,
                             np.full(4, 30.0)])  # fmt: skip
            rows += 1e-4 * noise.normal(size=rows.shape)
            listening.joints(joint_state(dict(zip(neck.joints, signs * theta))))
            listening.muscles(array(rows[:, order]), 0.01 * k)
        return listening.verdict(4.0)

    (fault,) = verdict(signs, order).faults
    assert fault.kind == 'joint sign or order'
    first_step, second_step = fault.remedy.splitlines()
    assert 'with the sign that the axis in robot.urdf defines' in first_step
    if is_sensor:
        reversed_joint = neck.joints.index(re.search('angle of (\\w+)', fault.text)[1])
        signs = [sign * (-1.0) ** (j == reversed_joint) for j, sign in enumerate(signs)]
    else:
        named = [name for name in neck.muscles if name in second_step]
        assert set(named) == set(neck.muscles)
        order = [order[m] for m in mirrored]
    assert not verdict(signs, order).faults


# -- winding in -----------------------------------------------------------------------------------


class Wound(NamedTuple):
    """A fault that the motion test finds, and the changes that its advice allows."""

    driver: Callable  # makes the driver with the fault
    advice: str  # a part of the advice
    changes: list[Callable]  # each follows the advice, called with the driver and the fault
    muscles: tuple[int, ...] = (BICEPS,)  # to wind in; if none, all, later those with the fault


def spoiled(**attributes):
    """Return a function that makes a driver at rest; `attributes` are its faults."""

    def make():
        driver = settled()
        for name, value in attributes.items():
            setattr(driver, name, value)
        return driver

    return make


@cache
def _settled_position():
    driver = Driver(POSITION)
    driver.listen(1.0)
    return driver


def position(spoil):
    """Return a function that makes a driver at rest, whose modules follow positions."""

    def make():
        driver = copy.deepcopy(_settled_position())
        spoil(driver, muscle_rows(driver.arm.sense()))
        return driver

    return make


def disordered(muscles, what, robot=ROBOT, sensors=True):
    """Return a function that makes a driver in which readings or commands are exchanged."""

    def make():
        driver = misordered(robot, muscles, what)
        if not sensors:
            driver.angles = lambda theta: np.full_like(theta, math.nan)
        return driver

    return make


def follow_the_stated_law(driver, fault):
    driver.in_tension = law_in(fault.remedy, driver.robot)


def limit_the_tension(driver, _):
    most, follow = driver.robot.tension.max, driver.in_tension
    driver.in_tension = lambda target, rows: np.minimum(most, follow(target, rows))


def reverse_command(driver, _):
    first(driver, lambda target: -target)


def reverse_length(driver, _):
    then(driver, 'publish', scaled(-1, 1, 1))


def reverse_both(driver, fault):
    reverse_length(driver, fault)
    reverse_command(driver, fault)


def reverse_lengths_of_the_law(driver, _):
    """Reverse the sign of l where the driver reads it, for its messages and for its law."""
    publish, follow = driver.publish, law()
    driver.publish = lambda rows: publish(rows) * [[-1.0], [1.0], [1.0]]
    driver.in_tension = lambda target, rows: follow(target, driver.publish(rows))


def count_commands_from_the_zero_of_l(driver, fault):
    tight, length = (1e-3 * each for each in numbers_in(fault.text))
    first(driver, lambda target: target + tight - length)


def exchange_tensions(driver, fault):
    (m,), (other,) = muscles_of(fault), muscles_in(fault.text)
    order = list(range(M))
    order[m], order[other] = other, m

    def publish(rows):
        rows = rows.copy()
        rows[TENSION] = rows[TENSION, order]
        return rows

    then(driver, 'publish', publish)


def moves_in(fault):
    """Return for each command which column of the readings it moves, as the fault says."""
    pairs = re.findall(r'winding in (\w+)(?: moved the readings of | those of )(\w+)',
                       fault.text)  # fmt: skip
    index = ROBOT.muscles.index
    return {index(one): index(other) for one, other in pairs}


def exchange_commands(driver, fault):
    """Give each muscle the command of the muscle whose readings it moves."""
    into = list(range(M))
    for m, other in moves_in(fault).items():
        into[m] = other
    first(driver, lambda target: target[np.argsort(into)])


def exchange_readings(driver, fault):
    """Publish under each muscle the readings that move when it is wound in."""
    order = list(range(M))
    for m, other in moves_in(fault).items():
        order[m] = other
    then(driver, 'publish', lambda rows: rows[:, order])


def exchange_both(driver, fault):
    names = re.findall(r'(\w+) moves like (\w+)', fault.text)
    order = list(range(M))
    for one, other in names:
        order[ROBOT.muscles.index(other)] = ROBOT.muscles.index(one)
    then(driver, 'publish', lambda rows: rows[:, order])
    first(driver, lambda target: target[np.argsort(order)])


def find_the_side_by_hand(driver, fault):
    """Exchange what the orders of a moved arm leave: readings if `order` is WRONG there."""
    heard = driver.listen(8.0, moved=True)
    driver.listen(3.0)
    (exchange_readings if 'order' in heard.wrong else exchange_commands)(driver, fault)


def press_on_the_tendon(driver, fault):
    """Press on the tendon that the advice names: its own readings or those of another change."""
    (m,) = muscles_in(re.search('press on the tendon of (.*?) while', fault.remedy)[1])
    pressed = np.zeros((3, M))
    pressed[TENSION, m] = 1.0
    own = driver.publish(pressed)[TENSION, m] == 1.0
    (exchange_commands if own else exchange_readings)(driver, fault)


def swap_rows(driver, _):
    then(driver, 'publish', rows_in([0, 2, 1]))


def attribute(name, value):
    return lambda driver, _: setattr(driver, name, value)


def in_newton(driver, _):
    then(driver, 'publish', scaled(1, 9.81, 1))


def clipped(**law_values):
    """Return a driver whose muscles reach their maximum within the test."""

    def make():
        driver = unclipped(with_tension(55.0, 60.0))
        driver.in_tension = law(most=60.0, **law_values)
        return driver

    return make


def humming():
    """Return a driver whose slow law makes stiff modules oscillate."""
    driver = Driver(stiff_and_strong(7.0e5))
    driver.in_tension = law(100.0, 7.0e5, 3000.0)
    driver.law_period = 0.01
    driver.listen(2.0)
    return driver


def lower_stiffness(driver, _):
    """Write a lower `stiffness` to muscles.yaml, and use it in the law of the driver as well."""
    driver.robot = stiff_and_strong(1.0e5)
    driver.in_tension = law(100.0, 1.0e5, 3000.0)
    driver.listen(2.0)


def law_in_the_module(driver, _):
    driver.in_tension = None


def inverted():
    driver = settled()
    inverted_law(driver, list(range(M)))
    return driver


def spring(target, rows):
    return np.maximum(0.0, BIAS + K * (rows[LENGTH] - target))


WOUND = {
    'misplaced commands': Wound(
        disordered((1, 4), 'commands'), 'read commands in the order of muscles.yaml',
        [exchange_commands], (),
    ),
    'misplaced movable': Wound(
        spoiled(take=exchanged), 'move the arm by hand through its whole range',
        [find_the_side_by_hand], (0,),
    ),
    'misplaced movable, readings': Wound(
        disordered(CYCLE, 'readings'), 'move the arm by hand through its whole range',
        [find_the_side_by_hand], (),
    ),
    'misplaced readings': Wound(
        disordered((1, 4), 'readings'), 'publish the readings in the order of muscles.yaml',
        [exchange_readings], (),
    ),
    'misplaced': Wound(
        disordered((1, 4), 'readings', sensors=False), 'press on the tendon of',
        [press_on_the_tendon], (),
    ),
    'misplaced, commands': Wound(
        disordered((1, 4), 'commands', sensors=False), 'press on the tendon of',
        [press_on_the_tendon], (),
    ),
    'both misplaced': Wound(
        disordered((0, 1), 'both'), 'exchange the columns of these muscles in both',
        [exchange_both], tuple(range(M)),
    ),
    'outwards': Wound(
        spoiled(publish=scaled(-1, 1, 1), take=lambda target: -target),
        'l and l_target must fall when the motor winds in', [reverse_both],
    ),
    'mirrored': Wound(
        spoiled(publish=scaled(-1, 1, 1)), 'reverse the sign of l', [reverse_length]
    ),
    'mirrored command': Wound(
        spoiled(take=lambda target: -target), 'reverse the sign of the command', [reverse_command]
    ),
    'rising': Wound(inverted, 'reverse the sign of l', [reverse_lengths_of_the_law]),
    'tension place': Wound(
        spoiled(publish=lambda rows: np.stack([rows[0], exchanged(rows[1]), rows[2]])),
        'publish tensions in the order of muscles.yaml', [exchange_tensions], (0,),
    ),
    'other zero': Wound(
        spoiled(take=lambda target: target + 0.03), 'l and l_target must have the same zero',
        [count_commands_from_the_zero_of_l],
    ),
    'gain': Wound(
        spoiled(in_tension=law(stiffness=K / 2)), 'the control law is', [follow_the_stated_law]
    ),
    'gain, unit': Wound(
        spoiled(publish=scaled(1, 1 / 9.81, 1)), 'check the unit of T', [in_newton]
    ),
    'hold': Wound(
        spoiled(in_tension=law(bias=0.0)), 'the control law is', [follow_the_stated_law]
    ),
    'beyond l': Wound(
        spoiled(in_tension=spring), 'limit the demand to at least T_bias, by max(0, …)',
        [follow_the_stated_law],
    ),
    'clip': Wound(
        clipped(clip=False), 'limit T to T_max', [limit_the_tension, follow_the_stated_law]
    ),
    'no answer': Wound(
        spoiled(take=lambda target: target / 1000.0), 'the command is in m',
        [lambda driver, _: first(driver, lambda target: 1000.0 * target)],
    ),
    'no answer, motor off': Wound(
        spoiled(take=lambda target: np.where(np.arange(M) == BICEPS, 1.0, target)),
        'check that the motor is on', [attribute('take', lambda target: target)],
    ),
    'late': Wound(spoiled(late=0.15), 'respond within 100 ms', [attribute('late', 0.0)]),
    'third row': Wound(
        spoiled(publish=rows_in([0, 2, 1])), 'publish length, tension, temperature', [swap_rows]
    ),
    'hums': Wound(
        humming, 'evaluate the law in the module, or lower `stiffness`',
        [law_in_the_module, lower_stiffness],
    ),
    'ran away': Wound(
        spoiled(in_tension=law(gain=6.0)), 'check sign and unit of l, T and the command',
        [follow_the_stated_law],
    ),
    'position hold': Wound(
        position(lambda driver, _: setattr(driver, 'take', lambda _: np.zeros(M))),
        'follow l_target as a position', [attribute('take', lambda target: target)],
    ),
    'position gain': Wound(
        position(lambda driver, home: setattr(
            driver, 'take', lambda target: home[0] + 0.4 * (target - home[0]))),
        'l_target is in m, with the zero and sign of l',
        [attribute('take', lambda target: target)],
    ),
    'position sign': Wound(
        position(lambda driver, home: setattr(
            driver, 'publish', lambda rows: np.stack([rows[0], 2 * home[1] - rows[1], rows[2]]))),
        'l must fall when the motor winds in',
        [attribute('publish', lambda rows: rows)],
    ),
    'position outwards': Wound(
        position(lambda driver, home: setattr(
            driver, 'take', lambda target: np.minimum(target, home[0] + 0.0005))),
        'follow l_target outwards, too', [attribute('take', lambda target: target)],
    ),
    'position ran away': Wound(
        position(lambda driver, _: setattr(driver, 'take', lambda target: -target - 0.04)),
        'with the zero, sign and unit of l', [attribute('take', lambda target: target)],
    ),
    'misplaced commands, position': Wound(
        position(lambda driver, _: setattr(driver, 'take', exchanged)),
        'read commands in the order of muscles.yaml', [exchange_commands],
    ),
}  # fmt: skip


@pytest.mark.parametrize('name', WOUND)
def test_a_fault_that_the_motion_test_finds_is_gone_after_the_change(name):
    case, fault_name = WOUND[name], name.partition(', ')[0]
    before = case.driver().wind(case.muscles)
    faults = {fault.kind: fault for fault in before.faults}
    assert fault_name in faults, str(before)
    assert case.advice in faults[fault_name].remedy
    for change in case.changes:
        driver = case.driver()
        change(driver, faults[fault_name])
        after = driver.wind(case.muscles or muscles_of(faults[fault_name]))
        assert not after.faults, str(after)


def test_every_fault_has_a_row_or_a_reason():
    tried = {key.partition(', ')[0] for key in [*HEARD, *WOUND]} | {*map(fault_of, MESSAGES)}
    tried |= {'silent', 'joint sign or order'}  # tests of their own
    assert tried.isdisjoint(EXCEPTIONS)
    assert tried | EXCEPTIONS.keys() == PROBLEMS.keys()


def test_a_driver_that_publishes_its_topic_is_heard():
    (fault,) = Listening(ROBOT, 100.0).verdict(3.0).faults
    assert fault.kind == 'silent' and 'muscle_states' in fault.text
    assert 'publish the topic' in fault.remedy
    assert not judged(SOUND, angles()).faults


@pytest.mark.parametrize(
    ('kind', 'robot', 'refused', 'advice', 'mended'),
    [
        (Winding, ROBOT, ((), 35.0), 'pass a higher --tension', ((), 50.0)),
        (Winding, WEAK, ((), None), 'check only the other muscles', (tuple(range(1, M)), None)),
        (Positioning, POSITION, ((), 1e4), 'choose a lower value', ((), 100.0)),
    ],
)
def test_a_motion_test_that_was_refused_is_accepted_with_the_advised_options(
    kind, robot, refused, advice, mended
):
    with pytest.raises(MusculoskeletalError, match=advice):
        kind(Verdict(robot), *refused)
    kind(Verdict(robot), *mended)
