# SPDX-License-Identifier: Apache-2.0
"""A correct driver passes the check; each fault that a driver may have is detected and named."""

import copy
import inspect
import math
import os
import re
from dataclasses import replace
from functools import cache, partial
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from readings import reading
from robots import with_modules

from driver.scripted import Driver, RecordedArm, array, joint_state, muscle_rows, record
from musculoskeletal_ae.awake_clock import AwakeClock
from musculoskeletal_ae.driver import listening
from musculoskeletal_ae.driver.listening import Listening
from musculoskeletal_ae.driver.motion_test import ABOVE_BIAS, RUN_AWAY_TENSION
from musculoskeletal_ae.driver.stiffness_motion_test import Winding
from musculoskeletal_ae.driver.verdict import CHECKS, PROBLEMS, Verdict
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.messages import message_reading
from musculoskeletal_ae.robot.description import TensionRange
from musculoskeletal_ae.robot.motors import Motors, MotorTopics
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.series_elastic import SeriesElastic
from musculoskeletal_ae.signals import motor_interface, muscle_states
from musculoskeletal_ae.signals.motor_interface import MotorInterface
from musculoskeletal_ae.signals.muscle_states import (
    QUANTITIES,
    MuscleReadings,
    Presence,
    Quantity,
)

ROBOT = Robot.load('arm26')
POSITION = Robot(with_modules(ROBOT.description, actuation='position'))
M, BICEPS = ROBOT.muscle_count, 4
BIAS, K = ROBOT.tension.bias[0], ROBOT.stiffness[0]


@cache
def _settled(seed):
    driver = Driver(ROBOT, seed)
    driver.listen(2.0)
    return driver


def settled(seed=0):
    """Return a copy of a driver whose arm has come to rest."""
    return copy.deepcopy(_settled(seed))


@cache
def recording(moved):
    return record(ROBOT, 8.0 if moved else 3.0, moved)


def silent(moved=False):
    """Return a driver to listen to: at rest for 3 s, or moved by a hand for 8 s."""
    return Driver(ROBOT, arm=RecordedArm(ROBOT, recording(moved)))


def heard(moved=False, joints=True, zeroed=True, **faults):
    """Return the verdict of listening to a driver with these faults, attributes of `Driver`."""
    driver = silent(moved)
    for attribute, value in faults.items():
        setattr(driver, attribute, value)
    return driver.listen(8.0 if moved else 3.0, moved, joints, zeroed)


def rows_in(order):
    return lambda rows: rows[order]


def scaled(*factors):
    return lambda rows: rows * np.array(factors)[:, None]


def exchanged(values):
    return values[..., [1, 0, *range(2, M)]]


def flipped(rows, muscles=slice(None)):
    rows = rows.copy()
    rows[0, muscles] *= -1.0
    return rows


def less_tension(rows):
    rows = rows.copy()
    rows[1, BICEPS] -= 35.0
    return rows


@pytest.mark.parametrize(
    ('follows', 'seed'),
    [
        ('muscle stiffness', 0),
        ('position', 0),
        pytest.param('muscle stiffness', 1, marks=pytest.mark.thorough),
    ],
)
def test_a_sound_driver_is_found_sound(follows, seed):
    driver = Driver(ROBOT if follows == 'muscle stiffness' else POSITION, seed)
    driver.listen(2.0)
    at_rest = driver.listen()
    assert not at_rest.faults, str(at_rest)
    assert_not_judged(at_rest)
    verdict = driver.wind(heard=at_rest)
    assert not verdict.faults, str(verdict)
    assert f'these joint sensors have the right sign: {", ".join(ROBOT.joints)}' in str(verdict)
    assert_consistent(verdict)
    for m, line in enumerate(str(verdict).splitlines()[1 : M + 1]):
        assert line.startswith(ROBOT.muscles[m]) and 'WRONG' not in line
        # `clip` is not reached, and θ does not show the order of all muscles.
        passed = {check for check in CHECKS if verdict.has_passed(check, m)}
        assert passed | {'order'} == {*CHECKS} - {'clip'}, line


def test_a_sound_driver_is_found_sound_if_a_hand_moves_the_arm():
    verdict = heard(moved=True)
    assert not verdict.faults, str(verdict)


@pytest.mark.parametrize('follows', ['muscle stiffness', 'position'])
def test_a_sound_driver_without_joint_sensors_is_found_sound(follows):
    driver = Driver(ROBOT if follows == 'muscle stiffness' else POSITION)
    driver.listen(2.0)
    driver.angles = lambda theta: np.full_like(theta, np.nan)
    at_rest = driver.listen(3.0, joints=False)
    assert not at_rest.faults, str(at_rest)
    assert_not_judged(at_rest)
    verdict = driver.wind((0, BICEPS), heard=at_rest)
    assert not verdict.faults, str(verdict)
    assert_consistent(verdict)
    assert all(verdict.has_passed('sign', m) == (m in (0, BICEPS)) for m in range(M))


def assert_not_judged(verdict):
    """Assert that a remark explains how to check order and sign of an arm that was not moved."""
    (remark,) = not_judged(verdict)
    assert remark.startswith('note: order, sign')
    assert 'of all muscles not judged: ' in remark


def assert_consistent(verdict):
    """Assert that the remarks name no check that the table shows as passed."""
    for remark in not_judged(verdict):
        for group in remark.removeprefix('note: ').partition(' not judged: ')[0].split('; '):
            checks, _, names = group.partition(' of ')
            muscles = ROBOT.muscles if names == 'all muscles' else names.split(', ')
            for check, name in product(checks.split(', '), muscles):
                assert not verdict.has_passed(check, ROBOT.muscles.index(name)), remark


@pytest.mark.parametrize(
    ('publish', 'moved', 'check', 'reported'),
    [
        (scaled(1, 1e-3, 1), True, 'unit', 'tensions look like kN'),
        (less_tension, False, 'law', 'with the tendon detached'),
    ],
)
def test_a_fault_is_found_by_listening(publish, moved, check, reported):
    """The other faults that listening finds are those of test_remedies.py."""
    verdict = heard(moved, publish=publish)
    assert verdict.wrong == {check}, str(verdict)
    assert reported in str(verdict)


@pytest.mark.parametrize('name', ['arm26', 'musashi_left_arm'])
def test_one_wrong_zero_is_not_taken_for_a_wrong_order(name):
    robot = Robot.load(name)
    for m in range(robot.muscle_count):
        driver = Driver(robot)
        driver.publish = partial(offset, m)
        verdict = driver.listen(0.5)
        zeros = [fault.subjects for fault in verdict.faults if fault.check == 'zero']
        assert zeros == [(robot.muscles[m],)]
        assert verdict.wrong == {'zero'}, str(verdict)
        assert 'wrong sign or order looks like a wrong zero' in str(verdict)


def offset(m, rows):
    rows = rows.copy()
    rows[0, m] += 0.1
    return rows


@pytest.mark.parametrize('robot', ['arm26', 'musashi_left_arm'])
def test_the_reversed_sign_of_every_length_is_one_fault_of_an_arm_at_rest(robot):
    robot = Robot.load(robot)
    theta = robot.lower + 0.9 * (robot.upper - robot.lower)
    length = -robot.muscle_lengths(theta, robot.tension.bias)
    listening, noise = Listening(robot, 100.0, theta), np.random.default_rng(0)
    for k in range(50):
        rows = np.stack([length, robot.tension.bias, np.full(len(length), 30.0)])
        listening.muscles(array(rows + 1e-4 * noise.normal(size=rows.shape)), 0.01 * k)
    verdict = listening.verdict(0.5)
    assert len(verdict.faults) == 1 and 'reverse the sign of every l' in str(verdict), str(verdict)
    assert 'judged at rest, which is not reliable' in verdict.faults[0].text


def test_angles_in_degrees_are_found_at_rest():
    assert 'shoulder, elbow look like degrees' in str(heard(angles=np.degrees))


def test_listening_names_the_joint_sensors_of_right_sign_if_the_arm_was_moved():
    (right,) = joint_notes(heard(moved=True))
    assert all(joint in right for joint in ROBOT.joints)
    assert not joint_notes(heard())


def joint_notes(verdict):
    return [note for note in verdict.notes if 'sign' in note and 'joint sensors' in note]


NECK = """<robot name="neck">
  <link name="torso"/>
  <joint name="pitch" type="revolute">
    <parent link="torso"/><child link="neck"/><axis xyz="0 1 0"/>
    <limit lower="-0.5" upper="0.6" effort="20" velocity="6"/>
  </joint>
  <link name="neck">
    <inertial><origin xyz="0 0 0.015"/><mass value="0.2"/>
      <inertia ixx="2e-4" ixy="0" ixz="0" iyy="2e-4" iyz="0" izz="2e-4"/></inertial>
  </link>
  <joint name="roll" type="revolute">
    <parent link="neck"/><child link="skull"/><origin xyz="0 0 0.03"/><axis xyz="1 0 0"/>
    <limit lower="-0.5" upper="0.5" effort="20" velocity="6"/>
  </joint>
  <link name="skull">
    <inertial><origin xyz="0.01 0 0.1"/><mass value="1.5"/>
      <inertia ixx="6e-3" ixy="0" ixz="0" iyy="6e-3" iyz="0" izz="5e-3"/></inertial>
  </link>
</robot>
"""


@pytest.fixture
def neck(tmp_path):
    """Return a robot that is symmetric about the plane y = 0, with two muscles on each side."""
    muscles = [
        {
            'name': f'{end}_{side}',
            'route': [
                {'link': 'torso', 'xyz': [0.05 * x, 0.05 * y, -0.08]},
                {'link': 'skull', 'xyz': [0.04 * x, 0.04 * y, 0.03]},
            ],
        }
        for end, x in (('front', 1), ('back', -1))
        for side, y in (('left', 1), ('right', -1))
    ]
    description = {
        'joints': ['pitch', 'roll'],
        'muscles': muscles,
        'series_elastic': {'force': 100.0, 'rate': 30.0, 'wire_stretch': 2e-5},
        'stiffness': 10000.0,
        'tension': {'bias': 30.0, 'limit': 200.0, 'max': 500.0},
        'end_effector': 'skull',
    }
    (tmp_path / 'robot.urdf').write_text(NECK, encoding='utf-8')
    (tmp_path / 'muscles.yaml').write_text(yaml.safe_dump(description), encoding='utf-8')
    return Robot.load(str(tmp_path))


@pytest.mark.parametrize(
    ('order', 'signs', 'faults', 'named'),
    [
        ([0, 1, 2, 3], [1, 1], [], ''),
        ([0, 1, 2, 3], [1, -1], ['joint sign or order'], 'roll'),
        ([1, 0, 2, 3], [1, 1], ['place', 'place'], 'front_right'),
    ],
)
def test_a_reversed_joint_sensor_of_a_symmetric_arm_is_not_taken_for_several_exchanges(
    neck, order, signs, faults, named
):
    listening, noise = Listening(neck, 100.0), np.random.default_rng(0)
    for k in range(400):
        share = 0.5 - 0.5 * np.cos(0.02 * k * np.array([1.0, 1.3]))
        theta = neck.lower + share * (neck.upper - neck.lower)
        length = neck.muscle_lengths(theta, neck.tension.bias)
        rows = np.stack([length, neck.tension.bias, np.full(4, 30.0)])
        rows += 1e-4 * noise.normal(size=rows.shape)
        listening.joints(joint_state(dict(zip(neck.joints, signs * theta))))
        listening.muscles(array(rows[:, order]), 0.01 * k)
    verdict = listening.verdict(4.0)
    assert [fault.kind for fault in verdict.faults] == faults, str(verdict)
    assert not faults or named in verdict.faults[0].text
    assert not verdict.allows_motion or not faults


def listened(robot, spoil):
    """Return the verdict on a driver of a moved arm; `spoil` returns θ of the joint messages."""
    listening, noise = Listening(robot, 100.0), np.random.default_rng(0)
    for k in range(400):
        share = 0.1 + 0.8 * (0.5 - 0.5 * np.cos(0.02 * k * np.array([1.0, 1.3])))
        theta = robot.lower + share * (robot.upper - robot.lower)
        length = robot.muscle_lengths(theta, robot.tension.bias)
        rows = np.stack([length, robot.tension.bias, np.full(4, 30.0)])
        rows += 1e-4 * noise.normal(size=rows.shape)
        for angles in spoil(k, theta):
            listening.joints(joint_state(dict(zip(robot.joints, angles))))
        listening.muscles(array(rows), 0.01 * k)
    return listening.verdict(4.0)


def test_zeros_of_a_second_publisher_are_named_and_no_length_is_blamed(neck):
    verdict = listened(neck, lambda _, theta: [theta, 0.0 * theta])
    (fault,) = verdict.faults
    assert fault.kind == 'false joint angles'
    assert '50 % of the 800 messages' in fault.text and 'roll 0 rad' in fault.text
    assert 'stop a second program' in fault.remedy


def test_a_single_false_angle_is_a_remark_with_its_value(neck):
    verdict = listened(neck, lambda k, theta: [theta - np.pi * (k == 200)])
    assert not verdict.faults, str(verdict)
    (note,) = [note for note in verdict.notes if 'false joint angles' in note]
    assert '0.25 % of the 400 messages' in note


def test_the_angle_that_is_beyond_the_limits_is_quoted(neck):
    far = neck.upper + 0.5
    verdict = listened(neck, lambda k, theta: [theta if k < 100 else far])
    (fault,) = verdict.faults
    assert fault.kind == 'joint'
    assert f'{far[0]:.3g} rad, 0.5 rad beyond its limits' in fault.text


def test_advice_on_a_rejected_message_is_that_of_its_topic():
    listening = Listening(ROBOT, 100.0)
    velocities = joint_state({})
    velocities.name, velocities.velocity = list(ROBOT.joints), [0.0, 0.0]
    listening.joints(velocities)
    listening.joints(joint_state(dict.fromkeys(ROBOT.joints, math.nan)))
    listening.joints(joint_state({}))
    listening.muscles(array(np.zeros((2, M))), 0.0)
    advice = [fault.remedy for fault in listening.verdict(0.1).faults]
    assert sum('fill `name` and `position`' in change for change in advice) == 2
    assert sum('3×M' in change for change in advice) == 1  # this advice concerns muscle_states only


def test_every_advice_on_a_rejected_message_belongs_to_a_reason_to_reject_it():
    rejected = set()
    readers = {
        ('muscle_states', message_reading): ('read_rows',),
        ('muscle_states', muscle_states): ('read_muscle_states',),
        ('joint_states', message_reading): ('read_posture', 'joint_names'),
        ('motors', message_reading): ('joint_names',),
        ('motors', muscle_states): ('read_muscle_states',),
        ('motors', motor_interface): ('reading', '_find'),
    }
    for (topic, module), functions in readers.items():
        source = inspect.getsource(module)
        for name in functions:
            text = re.split(r'\n *def ', source.partition(f'def {name}(')[2])[0]
            reasons = re.findall(r"MessageError\(\s*'([^']+)'", text)
            assert reasons
            rejected |= {f'{topic}: {reason}' for reason in reasons}
        rejected.add(f'{topic}: refused')
    assert {fault for fault in PROBLEMS if ': ' in fault} <= rejected


def ros2_control(**wrong):
    """Return the verdict on a driver with messages of ros2_control, read by settings.

    The settings are right, except those in `wrong`.
    """
    ones, muscles = np.ones(ROBOT.muscle_count), ROBOT.muscles
    right = Motors(
        MotorTopics('joint_states'),
        joints=muscles,
        command_order=muscles,
        spool_radius=0.012 * ones,
        direction=-ones,
        zero=0.0 * ones,
        tension_per_effort=ones,
        effort_zero=0.0 * ones,
    )
    interface = MotorInterface(right)

    def message(rows, now):
        names, position, effort = interface.joint_values(rows[0], rows[1])
        stamp = SimpleNamespace(sec=1 + int(now), nanosec=round(now % 1.0 * 1e9))
        header = SimpleNamespace(stamp=stamp)
        arrays = {'position': position, 'velocity': [], 'effort': effort}
        return SimpleNamespace(header=header, name=list(names), **arrays)

    motors = MotorInterface(replace(right, **wrong))
    return heard(moved=True, message=message, motors=motors)


def test_the_motors_of_ros2_control_are_judged_as_muscles():
    verdict = ros2_control()
    assert not verdict.faults and 'nothing protects the motors from heat' in str(verdict)


@pytest.mark.parametrize(
    ('wrong', 'check', 'reported'),
    [
        ({'direction': np.ones(6)}, 'sign', 'change spool_radius, direction, zero'),
        ({'spool_radius': np.full(6, 0.036)}, 'unit', 'times the change that the route predicts'),
        (
            {'zero': np.full(6, 8.0)},
            'zero',
            'from the length that the route predicts in this posture',
        ),
        ({'tension_per_effort': np.full(6, 0.224)}, 'unit', 'tensions look like'),
        (
            {'joints': tuple('abcdef'), 'command_order': tuple('abcdef')},
            'order',
            'correct `joint` in motors.yaml',
        ),
    ],
)
def test_a_wrong_entry_of_the_motors_is_found(wrong, check, reported):
    verdict = ros2_control(**wrong)
    assert check in verdict.wrong, str(verdict)
    assert reported in str(verdict)


def test_one_joint_sensor_without_a_number_is_named():
    verdict = heard(angles=lambda theta: np.array([theta[0], math.nan]))
    assert 'the position of elbow was not finite in 300 messages' in str(verdict)


def test_only_a_complete_check_says_that_the_driver_keeps_its_contract():
    driver = unclipped(with_tension(55.0, 60.0))
    driver.in_tension = law(most=60.0)
    verdict = driver.listen(3.0)
    at_rest = 'no fault found; not judged: order, sign, law, clip, latency of all muscles'
    assert verdict.conclusion == at_rest
    verdict = driver.listen(8.0, moved=True)
    # Two muscles of the moved arm hardly changed their lengths. Two others changed them so much
    # alike that their exchange would hardly be seen.
    few = 'brachialis, triceps_lateral'
    alike = f'order of deltoid_anterior, {few}, biceps_long; sign of {few}'
    part = f'no fault found; not judged: {alike}; law, clip, latency of all muscles'
    assert verdict.conclusion == part
    driver.listen(3.0)
    others = ', '.join(name for m, name in enumerate(ROBOT.muscles) if m != BICEPS)
    assert f'; law, clip, latency of {others}' in driver.wind((BICEPS,), heard=verdict).conclusion
    verdict = Verdict(ROBOT)
    for check in CHECKS:
        assert check in verdict.conclusion
        verdict.passed(check)
    assert verdict.conclusion == 'the driver keeps its contract'


def test_no_remark_advises_to_move_an_arm_that_was_moved_for_muscles_in_the_wrong_order():
    verdict = heard(moved=True, publish=exchanged)
    misplaced = {name for fault in verdict.faults for name in fault.subjects}
    assert len(misplaced) == 2
    for remark in not_judged(verdict):
        assert 'all muscles' not in remark and not any(name in remark for name in misplaced)


def not_judged(verdict):
    """Return the remarks that say how to make a check."""
    return [
        text for text in verdict.remarks if text.startswith('note: ') and ' not judged: ' in text
    ]


def test_unknown_length_offsets_are_no_fault_if_the_user_says_so():
    offset = np.stack([np.linspace(-0.13, 0.13, M), np.zeros(M), np.zeros(M)])
    assert heard(publish=lambda rows: rows + offset).wrong & {'zero', 'unit'}
    for moved in (False, True):
        assert not heard(moved, zeroed=False, publish=lambda rows: rows + offset).faults
    offset[0] = 0.1
    turned = heard(moved=True, zeroed=False, publish=lambda rows: flipped(rows) + offset)
    assert turned.wrong == {'sign'}


def test_slow_repeated_and_frozen_messages_are_found():
    verdict = heard(period=0.05)
    assert verdict.wrong == {'rate'} and 'came at 20 Hz' in str(verdict)
    assert not verdict.allows_motion
    rows, first = [], []
    repeating = heard(publish=lambda now: rows.append(now) or rows[len(rows) // 2])
    assert 'repeat the previous message' in str(repeating)

    def freeze(rows):
        first.append(rows)
        rows = rows.copy()
        rows[:, 3] = first[0][:, 3]
        return rows

    verdict = heard(publish=freeze)
    assert [fault.subjects for fault in verdict.faults] == [(ROBOT.muscles[3],)], str(verdict)


LONGEST_TICK = 0.07  # as in check_driver [s]


class Messages:
    """Passes messages of a driver at rest to `Listening`, at times that the test chooses."""

    def __init__(self):
        self.awake = AwakeClock(LONGEST_TICK)
        self.listening, self.driver = Listening(ROBOT, 100.0, clock=self.awake), silent()
        self.number = 0
        self.ticks = []  # times at which the clock learns that this process is running [s]

    def bring(self, count, sent, came, lost=()):
        """Let `count` messages arrive, except those whose numbers are in `lost`.

        `sent` and `came` compute the times of sending and of arrival [s] from the number of a
        message.
        """
        for n in range(count):
            self.number += 1
            while self.ticks and self.ticks[0] <= came(n):
                self.awake.tick(self.ticks.pop(0))
            if n not in lost:
                (_, rows), *_ = self.driver.step()
                self.listening.muscles(array(rows), came(n), sent(n), self.number)


def test_messages_that_wait_in_a_busy_computer_are_no_fault_of_the_driver():
    messages = Messages()
    sent = lambda n: 1000.0 + 0.01 * n  # noqa: E731
    messages.bring(300, sent, lambda n: 0.01 * n + (0.5 if 100 <= n < 150 else 0.0))
    verdict = messages.listening.verdict(3.0)
    assert not verdict.faults, str(verdict)


@pytest.fixture(autouse=True)
def is_idle(monkeypatch):
    """Pretend that this computer is not overloaded, except where a test says so."""
    monkeypatch.setattr(os, 'getloadavg', lambda: (0.0, 0.0, 0.0))


def overload(monkeypatch):
    monkeypatch.setattr(os, 'getloadavg', lambda: (1e3, 0.0, 0.0))


@pytest.mark.parametrize(
    ('period', 'allows_motion'),
    [(0.02, True), (0.03, True), (0.05, False), (0.3, False)],  # 50, 33, 20, 3 Hz
)
def test_a_slow_driver_on_an_overloaded_computer_has_no_fault_but_is_moved_at_30_hz_only(
    monkeypatch, period, allows_motion
):
    assert heard(period=period).wrong == {'rate'}
    overload(monkeypatch)
    verdict = heard(period=period)
    assert not verdict.faults, str(verdict)
    assert verdict.allows_motion == allows_motion
    assert 'not judged: rate (this computer is overloaded, load 1000 on ' in str(verdict)
    assert 'not judged: rate, ' in verdict.conclusion


def test_a_driver_that_falls_silent_on_an_overloaded_computer_is_found(monkeypatch):
    overload(monkeypatch)
    assert heard(moved=True, period=2.0).wrong == {'rate'}


@pytest.mark.parametrize('robot', ['muscle stiffness', 'position'])
def test_a_late_response_on_an_overloaded_computer_is_not_judged(monkeypatch, robot):
    overload(monkeypatch)
    driver = settled() if robot == 'muscle stiffness' else Driver(POSITION)
    driver.late = 0.15
    verdict = driver.wind((BICEPS,), heard=driver.listen(1.0))
    assert not verdict.faults, str(verdict)
    assert 'not judged: latency (this computer is overloaded' in str(verdict)
    assert 'latency' in verdict.conclusion


def test_the_motion_test_of_a_sound_driver_finds_no_fault_at_33_hz():
    driver = settled()
    driver.period = 0.03
    verdict = driver.wind((0, BICEPS))
    assert not verdict.faults, str(verdict)


def listen(rate, steps):
    """Return a driver and its listener after some steps; `rate` is the expected rate [Hz]."""
    driver, listening = silent(), Listening(ROBOT, rate)
    for _ in range(steps):
        for _, rows in driver.step():
            listening.muscles(array(rows), driver.now)
    return driver, listening


def test_a_driver_that_is_faster_than_expected_has_no_fault():
    driver, listening = listen(50.0, 200)
    verdict = listening.verdict(driver.now)
    assert not verdict.faults, str(verdict)
    assert 'came at 100 Hz, which is more than the expected 50 Hz' in str(verdict)


def test_messages_that_are_lost_on_the_way_are_no_fault_of_the_driver():
    messages = Messages()
    lost = {*range(100, 140), *range(200, 240)}
    messages.bring(300, lambda n: 1000.0 + 0.01 * n, lambda n: 0.01 * n, lost)
    verdict = messages.listening.verdict(3.0)
    assert not verdict.faults, str(verdict)
    assert '80 of 300 messages were lost in transit' in str(verdict)


@pytest.mark.parametrize('step', [-3600.0, 0.3, 3600.0])
@pytest.mark.parametrize('lost', [(), range(100, 140)])
def test_a_clock_of_the_driver_that_is_set_is_no_gap(step, lost):
    messages = Messages()
    messages.bring(
        300, lambda n: 5000.0 + 0.01 * n + (step if n >= 150 else 0.0), lambda n: 0.01 * n, lost
    )
    verdict = messages.listening.verdict(3.0)
    assert not verdict.faults, str(verdict)


@pytest.mark.parametrize('is_busy', [True, False])
def test_a_gap_in_which_this_computer_was_blocked_is_recognised(is_busy):
    messages = Messages()
    late = lambda n: 0.01 * n + (0.6 if n >= 100 else 0.0)  # noqa: E731
    messages.ticks = [t for t in np.arange(0.0, 3.6, 0.02) if not (is_busy and 1.05 < t < 1.55)]
    messages.bring(300, lambda n: 1000.0 + late(n), late)
    verdict = messages.listening.verdict(3.6)
    assert verdict.wrong == (set() if is_busy else {'rate'}), str(verdict)
    assert verdict.allows_motion == is_busy
    assert ('this computer is busy' if is_busy else 'no message was received for 0.61 s') in str(
        verdict
    )


def test_a_driver_that_falls_silent_is_found():
    driver, listening = listen(100.0, 50)
    assert not listening.verdict(driver.now).faults
    assert 'no message was received for 8.00 s' in str(listening.verdict(driver.now + 8.0))


@pytest.mark.parametrize('share', [0.1, 0.3])
def test_sensors_with_hardly_any_noise_are_no_fault(share):
    rng = np.random.default_rng(0)
    steps, still = np.array([[1e-5], [0.5], [0.1]]), muscle_rows(recording(False)[-1])

    def publish(_):
        return np.rint(still / steps + share * rng.normal(size=still.shape)) * steps

    verdict = heard(publish=publish)
    assert not verdict.faults, str(verdict)


def test_additional_joints_and_joints_in_several_messages_are_no_fault():
    driver, listening = silent(), Listening(ROBOT, 100.0)
    for _ in range(200):
        for theta, rows in driver.step():
            for name, angle in zip(ROBOT.joints, theta):
                listening.joints(joint_state({name: angle}))
            listening.joints(joint_state({'finger': 0.1}))
            listening.muscles(array(rows), driver.now)
    verdict = listening.verdict(driver.now)
    assert not verdict.faults, str(verdict)
    assert 'missing joint' in str(verdict) and 'are unknown; publish' not in str(verdict)


def test_unknown_joint_names_are_found():
    verdict = heard(names=('joint_1', 'joint_2'))
    assert 'missing joint' in str(verdict) and ROBOT.joints[0] in str(verdict)


def test_missing_joint_sensors_are_no_fault():
    verdict = heard(names=('other', ROBOT.joints[1]))
    assert not verdict.faults
    assert f'the angles of {ROBOT.joints[0]} are unknown' in str(verdict)


def test_modules_without_thermometers_are_no_fault():
    verdict = heard(publish=scaled(1, 1, math.nan))
    assert not verdict.faults
    assert 'nothing protects the motors from heat' in str(verdict)


def law(bias=BIAS, stiffness=K, most=ROBOT.tension.max[0], clip=True, gain=1.0):
    def follow(target, rows):
        tension = bias + np.maximum(0.0, stiffness * (rows[0] - target))
        return gain * (np.minimum(tension, most) if clip else tension)

    return follow


@pytest.mark.parametrize('joint', [0, pytest.param(1, marks=pytest.mark.thorough)])
def test_a_joint_sensor_of_wrong_sign_is_named_by_winding_in(joint):
    driver, sign = settled(), np.ones(ROBOT.joint_count)
    sign[joint] = -1.0
    driver.angles = lambda theta: sign * theta
    verdict = driver.wind()
    assert {fault.kind for fault in verdict.faults} == {'joint sign'}, str(verdict)
    assert f'sign of the angle of {ROBOT.joints[joint]} is reversed' in str(verdict)
    assert 'WRONG' not in verdict.table  # no muscle has a fault


def test_a_test_that_moved_a_joint_too_little_names_the_tension_to_repeat_it_with():
    for highest, advice in (None, 'Repeat the test with --tension 105'), (300.0, '. Move the arm'):
        robot = ROBOT if highest is None else with_tension(300.0, 500.0)
        verdict = Verdict(robot)
        winding = Winding(verdict, (0,), highest)
        still, driver = np.zeros(robot.joint_count), settled()
        while not winding.done:
            for _, rows in driver.step():
                if (target := winding.step(reading(rows), driver.now, still)) is not None:
                    driver.command(target)
        assert advice in str(verdict)


def inverted_law(driver, order):
    """Let the driver confuse lengths: their sign is wrong, and the order of muscles is `order`."""
    home, back = driver.arm.sense().muscles.length, np.argsort(order)
    # The lengths are mirrored about the initial ones, so that listening finds no fault.
    driver.publish = lambda rows: np.stack([2.0 * home - rows[0], *rows[1:]])[:, order]
    follow = law()
    driver.in_tension = lambda target, rows: follow(target[back], [2.0 * home - rows[0]])


HARMFUL = {
    'inverted': lambda driver: inverted_law(driver, list(range(M))),
    'inverted and exchanged': lambda driver: inverted_law(driver, [2, 0, 1, 4, 3, 5]),
    'commands exchanged': lambda driver: setattr(driver, 'take', exchanged),
}


@pytest.mark.parametrize(
    ('name', 'highest'),
    [
        ('inverted', None),
        ('inverted and exchanged', None),
        ('commands exchanged', 60.0),
        pytest.param('inverted', 60.0, marks=pytest.mark.thorough),
        pytest.param('inverted and exchanged', 60.0, marks=pytest.mark.thorough),
        pytest.param('commands exchanged', None, marks=pytest.mark.thorough),
    ],
)
def test_no_wrong_driver_pulls_above_the_test_tension_while_the_arm_is_held(name, highest):
    driver = settled()
    HARMFUL[name](driver)
    verdict = driver.wind((BICEPS,), highest)
    assert verdict.faults or name == 'commands exchanged', str(verdict)
    assert driver.pulled['hold'] < (highest or BIAS + ABOVE_BIAS)
    assert max(driver.pulled.values()) < (highest or BIAS + ABOVE_BIAS) + RUN_AWAY_TENSION


# No choice of the first command is safe with each of these drivers.
JUMPING = {
    'sign of the command': lambda home, target: 2.0 * (home - 0.03) - target,
    'another zero': lambda _, target: target - 0.02,
    'another order': lambda home, target: target + (home[::-1] - home) - 0.01,
}


@pytest.mark.parametrize('name', JUMPING)
def test_a_driver_that_pulls_from_the_first_command_on_is_released_and_bounded_by_max(name):
    driver = Driver(with_tension(55.0, 60.0))
    driver.listen(2.0)
    driver.take = partial(JUMPING[name], driver.arm.sense().muscles.length)
    verdict = driver.wind((BICEPS,))
    assert 'released for safety' in str(verdict)
    assert driver.pulled.keys() <= {'hold', 'order'}
    assert max(driver.pulled.values()) < 1.1 * 60.0


def test_a_length_that_rises_as_the_muscle_is_wound_in_has_the_wrong_sign():
    driver = settled()
    home = driver.arm.sense().muscles.length

    # A length mirrored about the initial length is correct at rest; winding in reveals its sign.
    def mirrored(rows):
        return np.stack([2.0 * home - rows[0], *rows[1:]])

    driver.publish = mirrored
    verdict = driver.wind((BICEPS,))
    assert 'sign' in verdict.wrong, str(verdict)
    assert 'l rose by' in str(verdict)


def stiff_and_strong(stiffness):
    """Return the robot with strong muscles (up to 3 kN) and the gain K = `stiffness` [N/m]."""
    tension = TensionRange(*np.outer([100.0, 2000.0, 3000.0], np.ones(M)))
    # The elastic element must be stiffer than K, because the module would oscillate otherwise.
    units = np.outer([2000.0, 60.0, 1e-6], np.ones(M))
    elastic = SeriesElastic(*units)
    parts = {'tension': tension, 'stiffness': np.full(M, stiffness), 'series_elastic': elastic}
    return Robot(replace(ROBOT.description, **parts))


def wound_in_stiff(stiffness, muscles, /, law_period=0.005, seed=0, **of_law):
    """Return the verdict of the motion test on a stiff robot, whose modules regulate tension.

    `of_law` replaces constants of the control law in the driver, so that the law is wrong.
    """
    driver = Driver(stiff_and_strong(stiffness), seed)
    driver.in_tension = law(**{'bias': 100.0, 'stiffness': stiffness, 'most': 3000.0, **of_law})
    driver.law_period = law_period
    driver.listen(2.0)
    return driver.wind(muscles)


@pytest.mark.parametrize('seed', [0, pytest.param(1, marks=pytest.mark.thorough)])
def test_noise_of_length_is_no_fault_of_a_stiff_robot(seed):
    verdict = wound_in_stiff(1.0e5, (0, 3, BICEPS), seed=seed)
    assert not verdict.faults, str(verdict)


@pytest.mark.parametrize('wrong', [{'stiffness': 5.0e4}, {'bias': 0.0}, {'gain': 1.0 / 9.81}])
def test_a_fault_of_a_stiff_robot_is_found(wrong):
    assert 'law' in wound_in_stiff(1.0e5, (BICEPS,), **wrong).wrong


def test_oscillation_of_a_stiff_robot_is_reported():
    # With the seeds 0 to 7, the oscillation was 1.1 to 1.6 times the tolerance (1.5 with seed 0).
    verdict = wound_in_stiff(7.0e5, (BICEPS,), law_period=0.01)
    assert 'N (standard deviation) while it is held' in str(verdict)
    assert 'latency' not in verdict.wrong, str(verdict)


def with_tension(limit, most, bias=BIAS):
    tension = TensionRange(*np.outer([bias, limit, most], np.ones(M)))
    return Robot(replace(ROBOT.description, tension=tension))


def test_a_sound_driver_is_found_sound_above_the_tension_limit():
    verdict = Driver(ROBOT).wind((BICEPS,), 400.0)
    assert not verdict.faults, str(verdict)


@pytest.mark.parametrize(
    ('robot', 'highest', 'reported'),
    [
        (ROBOT, 35.0, 'needs at least 50 N, but it may command 35 N at most'),
        (with_tension(35.0, 45.0), None, 'tension.max is 45 N; check only the other muscles'),
        (with_tension(35.0, 45.0), 60.0, 'tension.max is 45 N; check only the other muscles'),
    ],
)
def test_too_little_tension_to_judge_a_muscle_is_refused(robot, highest, reported):
    with pytest.raises(MusculoskeletalError, match=reported):
        Winding(Verdict(robot), (1,), highest)


def unclipped(robot):
    """Return a driver at rest whose modules do not limit the tension to `max`."""
    driver = Driver(robot)
    driver.listen(2.0)
    constants = driver.arm._module_constants
    driver.arm._module_constants = constants._replace(tension_max=np.full(M, 500.0))
    driver.arm._make_handle()
    return driver


@pytest.mark.parametrize(
    ('wrong', 'check'), [({'bias': 0.0}, 'law'), ({'clip': False}, 'clip'), ({'gain': 3.0}, 'law')]
)
def test_weak_muscles_are_not_pulled_far_beyond_their_maximum(wrong, check):
    driver = unclipped(with_tension(20.0, 26.0, bias=5.0))
    driver.in_tension = law(**{'bias': 5.0, 'most': 26.0, **wrong})
    most = []
    driver.publish = lambda rows: most.append(rows[1].max()) or rows
    assert check in driver.wind((BICEPS,)).wrong
    assert max(most) < 80.0


@pytest.mark.parametrize(
    ('fault', 'checks', 'reported'),
    [
        ('drop:0.4', {'rate'}, 'rate of all muscles'),
        pytest.param(
            'delay:0.2', {'latency'}, 'latency of biceps_long', marks=pytest.mark.thorough
        ),
        pytest.param('duplicate:0.5', {'rate'}, 'rate', marks=pytest.mark.thorough),
        pytest.param(
            'freeze:biceps_long',
            {'rate', 'law'},
            'its reading is the same in every message',
            marks=pytest.mark.thorough,
        ),
        ('dead_sensor:biceps_long', {'rate', 'law'}, 'biceps_long'),
        pytest.param(
            'bias:biceps_long:0.1', {'zero'}, 'zero of biceps_long', marks=pytest.mark.thorough
        ),
        ('bias:tension:biceps_long:40', {'law'}, 'biceps_long'),
    ],
)
def test_faults_of_the_emulated_arm_are_found(fault, checks, reported):
    driver = settled()
    driver.arm.faults.set([fault])
    verdict = driver.wind((BICEPS,), heard=driver.listen())
    assert verdict.wrong & checks, str(verdict)
    assert reported in str(verdict)


@pytest.mark.parametrize(
    ('where', 'value', 'kind'),
    [
        ('take', lambda target: target + 0.06, 'position ran away'),  # a zero that pays out
        ('late', 0.3, 'late'),
    ],
)
def test_a_fault_of_a_driver_that_follows_positions_is_found(where, value, kind):
    """The other faults of such a driver are those of test_remedies.py."""
    driver = Driver(POSITION, 0)
    driver.listen(1.0)
    setattr(driver, where, value)
    verdict = driver.wind((BICEPS,))
    assert kind in {fault.kind for fault in verdict.faults}, str(verdict)


def test_an_optional_quantity_is_judged_by_its_entry_in_the_table(monkeypatch):
    humidity = Quantity('%', 'impossible humidity', lambda _: (0.0, 100.0), Presence.OPTIONAL)
    monkeypatch.setattr(MuscleReadings, 'humidity', humidity, raising=False)
    humidity.__set_name__(MuscleReadings, 'humidity')
    for module in (muscle_states, listening):
        monkeypatch.setattr(module, 'QUANTITIES', (*QUANTITIES, humidity))
    row = np.full(M, 40.0)

    def publish(rows):  # the driver measures no other optional quantity
        return np.vstack([rows, np.full((len(QUANTITIES) - len(rows), M), np.nan), row])

    assert not heard(publish=publish).faults
    row[BICEPS] = 190.0
    (fault,) = heard(publish=publish).faults
    assert fault.subjects == (ROBOT.muscles[BICEPS],)
    assert fault.text == 'its humidity is 190 %; possible: 0 to 100 %'
    assert fault.remedy == 'publish %, or NaN if it is not measured'
