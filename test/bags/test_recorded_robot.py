# SPDX-License-Identifier: Apache-2.0
"""Recordings are told apart by the robot that was recorded."""

import pytest

from bags.arm_bag import ARRAY, JOINTS, STRING, Arm, array, string
from musculoskeletal_ae.bags.check import check_bag
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools.recorded_robot import main, misfit


@pytest.fixture
def arm():
    return Arm(Robot.load('arm26'), count=20)


def test_a_recording_fits_the_robot_that_was_recorded(arm, tmp_path):
    arm.add('/muscle_states', ARRAY, -0.5, array([1.0]))  # a bad message at the start
    assert main([str(arm.write(tmp_path / 'bag')), 'arm26']) == 0


def test_of_a_recording_of_another_shipped_robot_the_robot_is_named(arm, tmp_path, capsys):
    assert main([str(arm.write(tmp_path / 'bag')), 'musashi_left_arm']) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert 'is not a recording of musashi_left_arm: ' in line
    assert line.endswith('it fits arm26; pass --robot arm26')


URDF = """<robot name="neck">
<joint name="turn" type="revolute"/><joint name="foot" type="fixed"/>
</robot>"""


def test_of_a_recording_of_an_unknown_robot_its_description_is_named(arm, tmp_path):
    short = [sample for sample in arm.content if sample.type != JOINTS]
    arm.content = [sample._replace(data=array([[0.1] * 5] * 3)) for sample in short]
    arm.add('/robot_description', STRING, 0.0, string(URDF))
    problem = misfit(Bag.open(arm.write(tmp_path / 'bag')), 'arm26')
    assert '15 values; expected 18' in problem
    assert "robot_description is that of 'neck', with the joints turn; pass --robot" in problem


def test_without_joint_sensors_the_description_tells_robots_with_equal_muscles_apart(arm, tmp_path):
    arm.content = [sample for sample in arm.content if sample.type != JOINTS]
    assert misfit(Bag.open(arm.write(tmp_path / 'first')), 'arm26') == ''
    arm.add('/robot_description', STRING, 0.0, string(URDF))
    problem = misfit(Bag.open(arm.write(tmp_path / 'second')), 'arm26')
    assert 'its robot_description has the joints turn' in problem
    (fault,) = check_bag(tmp_path / 'second', 'arm26').faults
    assert 'its robot_description has the joints turn; choose the robot' in fault
    assert not any('arm26' in line for line in check_bag(tmp_path / 'second').lines)


def test_what_is_no_recording_is_an_error_in_one_line(tmp_path, capsys):
    assert main([str(tmp_path / 'none'), 'arm26']) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('error: ') and 'none' in line
