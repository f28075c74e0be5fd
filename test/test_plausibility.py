# SPDX-License-Identifier: Apache-2.0
"""What messages of an arm can say: a cut wire that winds in is no lie."""

import copy

import numpy as np
import pytest
from robots import write_robot

from musculoskeletal_ae.control.safety import Muscles
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.control.watch import Watch
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.plausibility import SLACK, WOUND, Plausibility, longest_lengths
from musculoskeletal_ae.robot.robot import Robot

ROBOT = Robot.load('arm26')
WARM = np.full(ROBOT.muscle_count, 30.0)


def test_a_tendon_without_tension_may_be_wound_in_beyond_the_joints_by_a_bounded_length():
    plausibility, tension = Plausibility(ROBOT), np.full(ROBOT.muscle_count, ROBOT.tension.bias)
    tension[0] = 0.0
    end = -longest_lengths(ROBOT)[0]
    for n, length in enumerate(np.arange(0.0, end - WOUND, -0.01)):
        row = np.zeros(ROBOT.muscle_count)
        row[0] = length
        plausibility.check_muscles(tension, row, WARM, 0.01 * n)
    row[0] = end - WOUND - 0.01
    with pytest.raises(MessageError, match='length beyond what the joints allow'):
        plausibility.check_muscles(tension, row, WARM, 0.01 * n + 0.01)


def test_a_tendon_under_tension_has_a_length_that_the_joints_allow():
    tension = np.full(ROBOT.muscle_count, 2.0 * SLACK * ROBOT.tension.bias)
    row = np.zeros(ROBOT.muscle_count)
    row[0] = 1.01 * -longest_lengths(ROBOT)[0]
    with pytest.raises(MessageError, match='length beyond what the joints allow'):
        Plausibility(ROBOT).check_muscles(tension, row, WARM, 0.0)


def test_other_lengths_are_accepted_after_the_clock_has_jumped_back():
    watch, there = Watch(ROBOT, Settings()), np.full(ROBOT.muscle_count, 0.05)
    for length in (0.0 * there, there):
        for n in range(2):
            watch.muscles(Muscles(length, ROBOT.tension.bias, WARM), True, 0.01 * n)
        watch.clock_jumped_back()
    watch.muscles(Muscles(0.0 * there, ROBOT.tension.bias, WARM), True, 0.02)
    with pytest.raises(MessageError, match='jumped'):
        watch.muscles(Muscles(there, ROBOT.tension.bias, WARM), True, 0.03)


@pytest.mark.parametrize('temperature', [500.0, np.inf, np.nan])
def test_readings_of_an_isolated_muscle_are_not_checked(temperature):
    robot = copy.copy(ROBOT)
    plausibility, hot = Plausibility(robot), WARM.copy()
    hot[1] = temperature
    values = robot.tension.bias, np.zeros(robot.muscle_count), hot
    if not np.isnan(temperature):  # else it is unknown anyway
        with pytest.raises(MessageError, match='temperature of no module'):
            plausibility.check_muscles(*values, 0.0)
    robot.isolate([1])
    plausibility.check_muscles(*values, 0.01)


def test_errors_of_prismatic_joints_are_in_metres(tmp_path):
    robot = Robot.load(write_robot(tmp_path, slider=True))
    assert (
        robot.told(np.full(4, 0.5)) == 'bend 0.50 rad, lift 0.50 rad, swing 0.50 rad, wrist 0.50 m'
    )
    error = Plausibility(robot).outside(np.append(robot.lower[:3], 2.0))
    assert error is not None and 'wrist 2 m, limits 0.00 to 0.05' in str(error)
