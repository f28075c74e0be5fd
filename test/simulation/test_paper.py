# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation


def test_it_goes_towards_forced_postures(trained):
    robot = Robot.load('arm26')
    arms = Simulation(robot, trained['paper'], 'paper')
    arms.fixed[0] = [np.nan, -1.2]
    before = abs(arms.state.theta[0, 1] + 1.2)
    state = arms.step(1.0)
    assert abs(state.theta[0, 1] + 1.2) < 0.1 * before  # at most 0.02 over five seeds
    assert np.all((state.theta >= robot.lower) & (state.theta <= robot.upper))
