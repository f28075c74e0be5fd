# SPDX-License-Identifier: Apache-2.0

import numpy as np

from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation


def test_preset_paper_moves_towards_forced_joint_angles(trained):
    robot = Robot.load('arm26')
    arms = Simulation(robot, trained['paper'], 'paper')
    arms.fixed[0] = [np.nan, -1.2]
    before = abs(arms.state.theta[0, 1] + 1.2)
    state = arms.step(1.0)
    # Over five seeds, the remaining distance was at most 0.02 times `before`.
    assert abs(state.theta[0, 1] + 1.2) < 0.1 * before
    assert np.all((state.theta >= robot.lower) & (state.theta <= robot.upper))


def test_preset_paper_moves_towards_the_commanded_lengths_without_stiffness_control(trained):
    """Without an external force, the term of the muscle lengths (weight w₅) dominates the loss."""
    robot = Robot.load('arm26')
    arms = Simulation(robot, trained['paper'], 'paper')
    resting = arms.step(0.2).length[0]
    sent = robot.muscle_lengths(np.array([0.4, -1.0]), np.full(6, 60.0))
    arms.command[0] = sent
    reached = arms.step(1.0).length[0]
    np.testing.assert_array_equal(arms.state.followed[0], sent)
    assert np.linalg.norm(reached - sent) < 0.3 * np.linalg.norm(resting - sent)
