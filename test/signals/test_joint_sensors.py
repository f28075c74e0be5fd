# SPDX-License-Identifier: Apache-2.0
"""Wrong joint sensors of a moving arm are found by comparing them with the muscle lengths."""

from functools import cache
from itertools import combinations

import numpy as np
import pytest
from driver.scripted import Driver
from readings import reading

from musculoskeletal_ae.driver.stiffness_motion_test import Winding
from musculoskeletal_ae.driver.verdict import Verdict
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.joint_sensors import (
    DEGREES,
    ORDER,
    SIGN,
    STUCK,
    judge,
    stuck_sensors,
)

ROBOTS = {name: Robot.load(name) for name in ('arm26', 'musashi_left_arm')}
NAMES = [pytest.param('arm26', marks=pytest.mark.thorough), 'musashi_left_arm']
MUSCLES = 5  # number of muscles that are wound in; fewer are enough to move all joints
#: robots and joints whose sensors have the wrong sign
SINGLE = [(name, (j,)) for name, robot in ROBOTS.items() for j in range(robot.joint_count)]
SEVERAL = [
    (name, joints)
    for name, robot in ROBOTS.items()
    for size in {2, robot.joint_count}
    for joints in combinations(range(robot.joint_count), size)
]
TYPICAL = [
    ('musashi_left_arm', joints) for joints in ((0,), (3,), (4,), (0, 1), (2, 4), (*range(5),))
]
REVERSED = [
    pytest.param(*case, marks=[] if case in TYPICAL else pytest.mark.thorough)
    for case in SINGLE + SEVERAL
]


@cache
def motion(name):
    """Return readings of a robot while the motion test of check_driver winds in muscles.

    Returns:
        θ, l and T in rows, and the number of the segment to which each row belongs; one muscle is
        wound in during a segment.
    """
    driver = Driver(ROBOTS[name], 1)
    driver.listen(2.0)
    winding = Winding(Verdict(ROBOTS[name]))
    theta, length, tension, tested = [], [], [], []
    while not winding.done and len(set(tested)) <= MUSCLES:
        for angles, rows in driver.step():
            theta.append(angles)
            length.append(rows[0])
            tension.append(rows[1])
            tested.append(winding.trying)
            if (target := winding.step(reading(rows), driver.now)) is not None:
                driver.command(target)
    segments = np.unique(tested, return_inverse=True)[1]
    return np.array(theta), np.array(length), np.array(tension), segments


def judged(name, change):
    theta, length, tension, segments = motion(name)
    return judge(ROBOTS[name], change(theta), length, tension, segments=segments)


def with_signs(*reversed_joints):
    def change(theta):
        changed = theta.copy()
        changed[:, reversed_joints] *= -1.0
        return changed

    return change


@pytest.mark.parametrize('name', NAMES)
def test_correct_joint_sensors_are_found_correct(name):
    faults, right = judged(name, lambda theta: theta)
    assert not faults
    assert right == tuple(range(ROBOTS[name].joint_count))


@pytest.mark.parametrize(('name', 'joints'), REVERSED)
def test_joint_sensors_of_wrong_sign_are_named(name, joints):
    (fault,), right = judged(name, with_signs(*joints))
    assert fault[:2] == (SIGN, joints)
    assert not set(joints) & set(right)


@pytest.mark.parametrize('name', NAMES)
def test_angles_in_degrees_and_exchanged_joints_are_named(name):
    robot = ROBOTS[name]
    assert judged(name, np.degrees).faults[0][:2] == (DEGREES, tuple(range(robot.joint_count)))
    order = [*range(robot.joint_count)]
    order[-2:] = reversed(order[-2:])
    (fault,), _ = judged(name, lambda theta: theta[:, order])
    assert fault[:2] == (ORDER, tuple(range(robot.joint_count))[-2:])


def test_the_sign_of_a_joint_that_does_not_move_is_not_judged():
    theta, length, tension, segments = motion('musashi_left_arm')
    still = np.repeat(theta[:1], len(theta), axis=0)
    assert judge(ROBOTS['musashi_left_arm'], still, length, tension, segments=segments) == ([], ())


def test_a_sensor_that_repeats_a_reading_while_the_joint_moves_is_stuck():
    robot, rng = ROBOTS['arm26'], np.random.default_rng(0)
    time = 0.02 * np.arange(2000)
    middle, span = 0.5 * (robot.lower + robot.upper), robot.upper - robot.lower
    waves = np.sin(np.outer(time, [0.7, 1.1]))
    theta = middle + 0.4 * span * waves + 1e-3 * rng.normal(size=waves.shape)
    tension = np.full((len(time), robot.muscle_count), 60.0)
    length = robot.muscle_lengths(theta, tension)
    assert not stuck_sensors(robot, time, theta, length, tension)
    read = theta.copy()
    read[500:1000, 1] = read[500, 1]
    (fault,) = stuck_sensors(robot, time, read, length, tension)
    assert fault == (STUCK, (1,), time[500], time[999])
    # If a joint rests and its sensor has no noise, the reading repeats as well. This is no fault.
    resting = np.where(np.arange(2000)[:, None] // 500 == 1, theta[500], theta)
    resting[:, 0] = theta[:, 0]
    length = robot.muscle_lengths(resting, tension)
    assert not stuck_sensors(robot, time, resting, length, tension)
