# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from musculoskeletal_ae.robot.joint_stops import AT_STOP, supporting_stops
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension

LOW, HIGH = 30.0, 200.0


@pytest.mark.parametrize('side', [-1.0, 1.0])
def test_a_stop_pushes_its_joint_back_and_does_not_pull_it(side):
    robot = Robot.load('arm26')
    middle, half = 0.5 * (robot.lower + robot.upper), 0.5 * (robot.upper - robot.lower)
    near, far = (middle + [side * (half[0] - apart * AT_STOP), 0.0] for apart in (0.9, 1.1))
    jacobian = np.zeros((robot.muscle_count, 2))  # the muscles exert no torque
    push, pull = np.array([-side, 0.0]), np.array([side, 0.0])  # torques that the joint needs
    for theta, torque, missing in [(near, push, 0.0), (near, pull, pull), (far, push, push)]:
        stops = supporting_stops(robot, theta)
        exertion = least_tension(jacobian, torque, LOW, HIGH, 60.0, stops)
        np.testing.assert_allclose(exertion.missing_torque, missing, atol=1e-6)
        assert exertion.tension.shape == (robot.muscle_count,)


@pytest.mark.parametrize('side', [-1.0, 1.0])
def test_no_stop_supports_a_joint_that_is_to_push_or_move_away_from_it(side):
    robot = Robot.load('arm26')
    theta = 0.5 * (robot.lower + robot.upper) + [side * 0.5 * (robot.upper - robot.lower)[0], 0.0]
    away, there = np.array([-side, 0.0]), np.array([side, 0.0])
    for velocity, effort, count in [
        (0.0, 0.0, 1), (away, 0.0, 0), (there, 0.0, 1), (0.0, away, 0), (0.0, there, 1)
    ]:  # fmt: skip
        assert len(supporting_stops(robot, theta, velocity, effort)) == count
