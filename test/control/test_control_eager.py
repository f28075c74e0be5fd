# SPDX-License-Identifier: Apache-2.0
"""The torch-eager control that the benchmark times is the same algorithm: same commands."""

from __future__ import annotations

import numpy as np
import pytest

from bench.timings_control import eager_proposed, eager_proposed_paper
from musculoskeletal_ae.control import methods as control
from musculoskeletal_ae.mae.network import from_mae, to_mae
from musculoskeletal_ae.mae.training import initial_training
from musculoskeletal_ae.robot.robot import Robot


@pytest.mark.parametrize('preset', ['default', 'paper'])
def test_numpy_and_torch_command_the_same_lengths(preset):
    robot = Robot.load('arm26')
    network, _ = initial_training(robot, preset, steps=100)
    mae = to_mae(network, robot.joints, robot.muscles, preset, 'briefly, for a test')
    eager = from_mae(mae)
    theta, tension = np.array([-0.4, -1.0]), np.full(6, 40.0)
    torque = robot.kinematics.holding_torque(theta)
    if preset == 'default':
        ours = control.proposed(robot, mae, theta, torque, tension, robot.tension.limit).length
        theirs = eager_proposed(robot, eager, theta, torque, tension)
    else:
        ours = control.proposed_paper(robot, mae, theta, torque, tension).length
        theirs = eager_proposed_paper(robot, eager, theta, torque, tension)
    np.testing.assert_allclose(ours, theirs, atol=1e-4)
