# SPDX-License-Identifier: Apache-2.0
"""Impossible readings of joint sensors are not used, and readings of all other joints are."""

import numpy as np
import pytest

from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.joint_stream import JointReading, JointStream

PERIOD = 0.01


@pytest.fixture(scope='module')
def robot():
    return Robot.load('arm26')


def moving(seconds=6.0):
    time = PERIOD * np.arange(round(seconds / PERIOD))
    return time, np.stack([-0.6 + 0.4 * np.sin(time), -1.0 + 0.6 * np.sin(3.0 * time)], axis=1)


def usable_angles(robot, time, theta):
    stream = JointStream(robot)
    return np.array([stream.take(now, row) for now, row in zip(time, theta, strict=True)])


@pytest.mark.parametrize('value', [0.0, -np.pi, 1e6, np.nan])
@pytest.mark.parametrize('length', [1, 30])
def test_bursts_of_impossible_readings_are_not_usable(robot, value, length):
    time, theta = moving()
    read = theta.copy()
    for begin in range(100, len(time) - length, 200):
        read[begin : begin + length, 1] = value
    usable = usable_angles(robot, time, read)
    np.testing.assert_array_equal(usable[:, 0], theta[:, 0])
    is_known = np.isfinite(usable[:, 1])
    assert (usable[is_known, 1] == theta[is_known, 1]).all()
    assert is_known.mean() > 0.4


def test_impossible_readings_are_counted_for_each_joint(robot):
    stream = JointStream(robot)
    time, theta = moving(1.0)
    theta[50, 0], theta[60:63, 1] = -np.pi, 0.0
    for now, row in zip(time, theta, strict=True):
        stream.take(now, row)
    shoulder, elbow = robot.joints
    assert stream.rejected == {
        (shoulder, JointReading.OUTSIDE): 1, (elbow, JointReading.JUMPED): 3
    }  # fmt: skip


def test_the_level_of_a_slipped_sensor_is_usable_after_a_second(robot):
    time, theta = moving()
    theta[200:, 0] += 0.5
    usable = np.isfinite(usable_angles(robot, time, theta))
    assert usable[:200].all()
    assert not usable[200:295, 0].any()
    assert usable[305:].all()


def test_a_fast_motion_is_usable(robot):
    time = PERIOD * np.arange(200)
    theta = np.stack([-0.4 + np.sin(6.0 * time), -1.0 + 0.8 * np.sin(7.0 * time)], axis=1)
    assert np.isfinite(usable_angles(robot, time, theta)).all()


def between(readings, others):
    """Return a posture from two programs that publish in turns, and the time of each message."""
    rows = np.stack([readings, others], axis=1).reshape(-1, readings.shape[1])
    return 0.5 * PERIOD * np.arange(len(rows)), rows


def test_a_sensor_without_a_possible_reading_is_named_until_it_can_be_read_again(robot):
    stream = JointStream(robot)
    time, theta = moving(6.0)
    bad = theta.copy()
    bad[100:400, 1] = 9.0
    named = []
    for now, row in zip(time, bad, strict=True):
        stream.take(now, row)
        named.append(set(stream.impossible(now)))
    assert not any(named[:300])
    assert named[310] == named[490] == {1}
    assert not any(named[510:])


@pytest.mark.parametrize('value', [0.0, -np.pi])
@pytest.mark.parametrize('length', [1, 50])
def test_single_impossible_readings_and_bursts_are_no_lasting_fault(robot, value, length):
    stream = JointStream(robot)
    time, theta = moving(4.0)
    theta[100 : 100 + length, 1] = value
    for now, row in zip(time, theta, strict=True):
        stream.take(now, row)
        assert not stream.impossible(now)


def test_zeros_of_a_second_program_are_a_lasting_fault_of_half_of_the_readings(robot):
    stream = JointStream(robot)
    time, rows = between(moving(3.0)[1], np.zeros((300, 2)))
    for now, row in zip(time, rows, strict=True):
        stream.take(now, row)
    series = stream.impossible(time[-1])
    assert set(series) == {0, 1}
    assert all(0.3 < each.impossible / each.total < 0.6 for each in series.values())


def test_a_message_of_which_most_readings_are_impossible_is_not_used_at_all():
    robot = Robot.load('musashi_left_arm')
    stream = JointStream(robot)
    theta = np.array([0.05, -0.4, 0.3, -1.0, 0.4])  # 0 is possible for the first joint alone
    time, rows = between(np.tile(theta, (50, 1)), np.zeros((50, 5)))
    usable = np.array([stream.take(now, row) for now, row in zip(time, rows, strict=True)])
    np.testing.assert_array_equal(usable[0::2], np.tile(theta, (50, 1)))
    assert np.isnan(usable[1::2]).all()
    assert stream.rejected[robot.joints[0], JointReading.FOREIGN] == 50


def test_only_the_broken_sensors_are_named_if_half_of_all_are_broken():
    robot = Robot.load('musashi_left_arm')
    stream = JointStream(robot)
    theta = np.array([0.05, -0.4, 0.3, -1.0, 0.4])
    for step in range(400):
        broken = np.where((np.arange(5) >= 2) & (step >= 100), 9.0, theta)
        stream.take(PERIOD * step, broken)
    assert set(stream.impossible(PERIOD * step)) == {2, 3, 4}


def test_a_joint_that_had_readings_is_missing_after_a_second_without_one(robot):
    stream = JointStream(robot)
    named = []
    for step in range(300):
        stream.take(PERIOD * step, np.array([-0.6, -1.0 if step < 100 else np.nan]))
        stream.pass_time(PERIOD)
        named.append(stream.missing)
    assert not any(named[:195])
    assert named[205:] == 95 * [[robot.joints[1]]]
    stream.take(3.0, np.array([-0.6, -1.0]))
    assert stream.missing == []


def test_a_joint_that_never_had_a_reading_has_no_sensor(robot):
    stream = JointStream(robot)
    for step in range(300):
        stream.take(PERIOD * step, np.array([-0.6, np.nan]))
        stream.pass_time(PERIOD)
    assert stream.missing == []
