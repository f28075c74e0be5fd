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
    return np.array([stream.take(now, row).theta for now, row in zip(time, theta, strict=True)])


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


def test_a_sensor_without_a_possible_reading_is_named_until_it_can_be_read_again(robot):
    stream, good = JointStream(robot), np.zeros(robot.joint_count)
    bad = good.copy()
    bad[1] = 9.0
    for step in range(100):
        stream.take(0.02 * step, bad)
    assert stream.unreadable(2.0) == [robot.joints[1]]
    stream.take(2.0, good)
    assert stream.unreadable(2.0) == []
