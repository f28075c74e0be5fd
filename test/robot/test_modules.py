# SPDX-License-Identifier: Apache-2.0
"""Kinds of muscle modules in muscles.yaml: legal combinations and their effects."""

import numpy as np
import pytest
from robots import read_muscles, write_muscles, write_robot

from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.emulator.kin.individual import NOMINAL, Individual
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.exceptions import MusculoskeletalError, RobotDescriptionError
from musculoskeletal_ae.robot.description import SPEED_DEFAULT
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation


class GeometricBody:
    """A body with the lengths of the geometric model and the interface of a network."""

    friction = np.zeros(8)
    elasticity = None

    def __init__(self, robot):
        self.robot, self.lengths = robot, robot.muscle_lengths

    def lengths_with_pullback(self, theta, tension):
        jacobian = self.robot.routes.muscle_jacobian(theta)
        return self.lengths(theta, tension), lambda g: np.einsum('nm,nmd->nd', g, jacobian)


def test_modules_follow_stiffness_control_unless_the_file_says_positions(tmp_path):
    usual = Robot.load(write_robot(tmp_path / 'a'))
    assert usual.actuation.follows_tensions
    assert (usual.stiffness == 1e4).all() and np.isinf(usual.description.speed).all()
    robot = Robot.load(write_robot(tmp_path / 'b', actuation='position', speed=0.2, release=0.02))
    assert not robot.actuation.follows_tensions
    assert (robot.description.speed == 0.2).all() and (robot.actuation.release == 0.02).all()
    plain = Robot.load(write_robot(tmp_path / 'c', actuation='position'))
    assert (plain.description.speed == SPEED_DEFAULT).all()
    paid_out = plain.elongation(plain.tension.limit) - plain.elongation(plain.tension.bias)
    np.testing.assert_allclose(plain.actuation.release, paid_out)
    document = read_muscles(tmp_path / 'b')
    document['muscles'][1] |= {'speed': 0.05, 'release': 0.01}
    robot = Robot.load(write_muscles(tmp_path / 'b', document))
    assert robot.description.speed[1] == 0.05 and robot.actuation.release[1] == 0.01
    assert robot.description.speed[0] == 0.2


@pytest.mark.parametrize(
    ('keys', 'fragments'),
    [
        ({'actuation': 'velocity'}, ["'velocity'", 'stiffness', 'position']),
        ({'actuation': 'position', 'stiffness': 1e4}, ['stiffness of the robot', 'remove']),
        ({'speed': 0.1}, ['speed of the robot', 'actuation: position']),
        ({'release': 0.1}, ['release of the robot', 'actuation: position']),
        ({'actuation': 'position', 'speed': 0.0}, ['speed']),
    ],
)
def test_keys_that_do_not_go_together_are_refused(tmp_path, keys, fragments):
    with pytest.raises(RobotDescriptionError) as error:
        Robot.load(write_robot(tmp_path, **keys))
    for fragment in fragments:
        assert fragment in str(error.value)


@pytest.mark.parametrize('reality', ['kin', 'foreign'])
def test_an_emulated_module_goes_to_its_position_at_its_speed_and_holds_it(tmp_path, reality):
    robot = Robot.load(write_robot(tmp_path, actuation='position', speed=0.05))
    arm = make_arm(robot, 0, reality)
    start = arm.sense().muscles.length
    arm.step(1.0)  # before the first command, the module must hold its length
    assert np.abs(arm.sense().muscles.length - start).max() < 1e-3
    goal = start + np.linspace(0.005, 0.015, robot.muscle_count)
    arm.command_length(goal)
    arm.step(0.1)
    assert np.abs(arm.sense().muscles.length - start).max() < 0.05 * 0.1 + 1e-3
    arm.step(0.4)
    np.testing.assert_allclose(arm.sense().muscles.length, goal, atol=1.5e-3)
    arm.step(2.0)  # without further commands, the module must hold its position
    np.testing.assert_allclose(arm.sense().muscles.length, goal, atol=1.5e-3)
    with pytest.raises(MusculoskeletalError, match='follow lengths only'):
        arm.command_tension(goal)


def test_an_emulated_module_pulls_no_harder_than_its_largest_tension(tmp_path):
    tension = {'bias': 10.0, 'limit': 50.0, 'max': 60.0}
    robot = Robot.load(write_robot(tmp_path, actuation='position', tension=tension))
    arm, most = make_arm(robot, 0), 0.0
    for _ in range(300):
        arm.command_length(np.full(robot.muscle_count, -0.1))
        arm.step(0.01)
        most = max(most, float(arm.tension.max()))
    # While joints move, tensions may briefly exceed `max` (60 N). At rest they do not.
    assert 40.0 < most < 90.0
    assert arm.tension.max() < 63.0


def test_the_simulated_arm_rests_where_the_emulated_one_does(tmp_path):
    robot = Robot.load(write_robot(tmp_path, actuation='position'))
    theta = 0.5 * (robot.lower + robot.upper)
    tension = np.linspace(40.0, 80.0, robot.muscle_count)
    command = robot.muscle_lengths(theta, tension)
    individual = Individual(robot, 0, NOMINAL)
    individual.joint_friction[:] = 0.0
    arm = EmulatedArm(robot, 0, individual)
    arm.reset(theta)
    for _ in range(500):
        arm.command_length(command)
        arm.step(0.01)
    simulated = Simulation(robot, GeometricBody(robot))
    simulated.command = command[None]
    state = simulated.settle()
    np.testing.assert_allclose(state.theta[0], arm.theta, atol=0.02)
    np.testing.assert_allclose(state.tension[0], arm.tension, atol=4.0)
    np.testing.assert_allclose(state.length[0], command, atol=1e-3)
