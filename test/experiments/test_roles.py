# SPDX-License-Identifier: Apache-2.0
"""Selection of elbow and shoulder joints on robots without such names."""

import math

import numpy as np
import pytest
from robots import write_robot

from musculoskeletal_ae.experiments.roles import (
    elbow,
    elbows,
    flexed,
    plot_unit,
    shoulder,
    within,
)
from musculoskeletal_ae.robot.robot import Robot


@pytest.mark.parametrize(
    ('name', 'flexes', 'forced'),
    [('musashi_left_arm', 'elbow_pitch', 'shoulder_pitch'), ('arm26', 'elbow', 'shoulder')],
)
def test_elbow_and_shoulder_are_found_by_name(name, flexes, forced):
    robot = Robot.load(name)
    assert robot.joints[elbow(robot)] == flexes
    assert robot.joints[shoulder(robot)] == forced
    assert flexed(robot) == pytest.approx(-0.5 * math.pi)
    assert within(robot, shoulder(robot), 30.0) == pytest.approx(math.radians(30.0), abs=1e-3)


def test_the_elbows_of_two_arms_are_found_by_name():
    robot = Robot.load('musashi_upper_body')
    named = [name for name, elbow in zip(robot.joints, elbows(robot), strict=True) if elbow]
    assert named == [
        f'{side}_elbow_{axis}' for side in ('left', 'right') for axis in ('pitch', 'yaw')
    ]


def test_without_known_names_the_first_and_last_revolute_joints_are_shoulder_and_elbow(tmp_path):
    robot = Robot.load(write_robot(tmp_path / 'other', slider=True))
    assert robot.units.slides.tolist() == [False, False, False, True]
    assert shoulder(robot) == 0
    assert elbow(robot) == robot.joint_count - 2
    assert np.flatnonzero(elbows(robot)).tolist() == [elbow(robot)]
    assert plot_unit(robot, robot.joint_count - 1) == (60.0, 'mm')  # of 1 rad
    assert robot.lower[elbow(robot)] <= flexed(robot) <= robot.upper[elbow(robot)]
