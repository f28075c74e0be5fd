# SPDX-License-Identifier: Apache-2.0
"""Muscles in a wrong order are named, and no sound driver is accused of a wrong order."""

from itertools import combinations

import numpy as np
import pytest
from robots import with_modules

from driver.scripted import Driver, array, joint_state, muscle_rows
from musculoskeletal_ae.driver.listening import Listening
from musculoskeletal_ae.driver.motion_test import ABOVE_BIAS
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.robot.robot import Robot

ARM26 = Robot.load('arm26')
POSITION = Robot(with_modules(ARM26.description, actuation='position'))
CYCLE = (0, 3, 4)


def misordered(robot, muscles, what, seed=0, reality='kin'):
    """Return a driver in which `what` of `muscles` are in another order, shifted by one."""
    order = np.arange(robot.muscle_count)
    driver = Driver(robot, arm=make_arm(robot, seed, reality))
    order[list(muscles)] = np.roll(muscles, 1)
    if what in ('readings', 'both', 'readings of the law'):
        driver.publish = lambda rows: rows[:, order]
    if what == 'readings of the law':  # it is evaluated in the driver, with the published lengths
        bias, most = robot.tension.bias, robot.tension.max
        driver.in_tension = lambda target, rows: np.minimum(
            bias + np.maximum(0.0, robot.stiffness * (rows[0, order] - target)), most
        )
    if what in ('commands', 'both'):
        # The command of column j must reach the muscle whose readings column j shows.
        into = np.argsort(order) if what == 'both' else order
        driver.take = lambda target: target[into]
    driver.listen(2.0)
    return driver


def assert_names(verdict, muscles, name=None):
    (fault,) = verdict.faults
    assert fault.check == 'order', str(verdict)
    assert name in (None, fault.kind), str(verdict)
    assert set(fault.subjects) == {verdict.robot.muscles[m] for m in muscles}, str(verdict)
    assert all(name in fault.text for name in fault.subjects)


def thorough(*case):
    return pytest.param(*case, marks=pytest.mark.thorough)


# A fault is called 'misplaced movable' if the joint angles do not tell which side is exchanged.
@pytest.mark.parametrize(
    ('what', 'muscles', 'name'),
    [
        thorough('readings', (1, 4), 'misplaced readings'),
        ('readings', CYCLE, 'misplaced movable'),
        thorough('commands', (1, 4), 'misplaced commands'),
        ('readings of the law', (1, 4), 'misplaced readings'),
        thorough('readings', (3, 5), 'misplaced readings'),
        thorough('readings', (4, 5), 'misplaced readings'),
        thorough('commands', (3, 5), 'misplaced commands'),
        thorough('commands', (4, 5), 'misplaced commands'),
        thorough('readings of the law', (2, 5), 'misplaced readings'),
        thorough('readings of the law', (4, 5), 'misplaced readings'),
    ],
)
def test_muscles_in_a_wrong_order_are_the_only_fault_and_are_not_pulled_hard(what, muscles, name):
    driver = misordered(ARM26, muscles, what)
    driver.pulled.clear()
    assert_names(driver.wind(), muscles, name)
    assert driver.pulled['order'] < ARM26.tension.bias[0] + ABOVE_BIAS


@pytest.mark.parametrize(
    ('what', 'muscles', 'seed', 'name'),
    [
        ('readings', (0, 1), 1, 'misplaced readings'),  # found after the arm was held
        ('readings', (0, 5), 0, 'misplaced'),
        ('commands', (0, 5), 1, 'misplaced commands'),
        thorough('readings', (0, 5), 1, 'misplaced readings'),
        thorough('readings', (1, 4), 0, 'misplaced readings'),
        thorough('commands', (0, 5), 0, 'misplaced'),
        thorough('commands', (1, 4), 0, 'misplaced commands'),
    ],
)
def test_exchanged_modules_that_follow_positions_are_named(what, muscles, seed, name):
    assert_names(misordered(POSITION, muscles, what, seed).wind(), muscles, name)


@pytest.mark.parametrize(
    ('name', 'muscles', 'seed', 'reality'),
    [
        ('musashi_left_arm', (0, 7), 1, 'kin'),
        thorough('musashi_left_arm', (2, 3), 2, 'kin'),
        thorough('arm26', (3, 4), 1, 'foreign'),
    ],
)
def test_exchanged_readings_of_other_arms_are_named(name, muscles, seed, reality):
    driver = misordered(Robot.load(name), muscles, 'readings', seed, reality)
    assert_names(driver.wind(), muscles)


def test_commands_are_exchanged_if_a_moving_hand_showed_that_the_readings_are_right():
    driver = misordered(ARM26, (2, 5), 'commands')
    heard = driver.listen(8.0, moved=True)
    driver.listen(3.0)
    (fault,) = driver.wind(heard=heard).faults
    assert fault.kind == 'misplaced commands'


@pytest.mark.parametrize('share', [0.4, thorough(1.0)])
def test_exchanged_readings_never_pass_the_check_of_order_while_a_hand_moves_the_arm(share):
    """A hand moves every joint through a share of its range."""
    arm, low, high = make_arm(ARM26, 1, 'foreign'), ARM26.lower, ARM26.upper
    periods = 10.0 * (1.0 + 0.3 * np.arange(len(low)))
    readings = []
    for now in np.arange(0.0, 30.0, 0.1):
        arm.reset(0.5 * (low + high - share * np.cos(2.0 * np.pi * now / periods) * (high - low)))
        arm.step(0.05)
        readings.append((now, arm.sense()))

    def passing(*exchanged):
        """Return the muscles that pass the check of order, with two exchanged columns."""
        order, listening = np.arange(ARM26.muscle_count), Listening(ARM26, 10.0)
        order[list(exchanged)] = exchanged[::-1]
        for now, reading in readings:
            listening.joints(joint_state(dict(zip(ARM26.joints, reading.theta))))
            listening.muscles(array(muscle_rows(reading)[:, order]), now)
        verdict = listening.verdict(30.0)
        return {m for m in range(ARM26.muscle_count) if verdict.has_passed('order', m)}

    assert len(passing()) >= ARM26.muscle_count - 1
    for pair in combinations(range(ARM26.muscle_count), 2):
        assert not passing(*pair) & set(pair)


@pytest.mark.thorough  # test_remedies.py has a typical case
@pytest.mark.parametrize('muscles', [(0, 1), (2, 5), (1, 4)])
def test_muscles_whose_readings_and_commands_are_exchanged_are_named_by_the_joint_angles(muscles):
    verdict = misordered(ARM26, muscles, 'both').wind()
    assert_names(verdict, muscles, 'both misplaced')
    assert 'the joint angles show' in str(verdict)


@pytest.mark.parametrize(
    ('name', 'seed', 'reality'),
    [
        ('arm26', 0, 'foreign'),
        thorough('arm26', 2, 'kin'),
        thorough('musashi_left_arm', 0, 'foreign'),
    ],
)
def test_no_sound_driver_is_accused_of_a_wrong_order(name, seed, reality):
    verdict = misordered(Robot.load(name), (), 'both', seed, reality).wind()
    assert 'order' not in verdict.wrong, str(verdict)
