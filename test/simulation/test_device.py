# SPDX-License-Identifier: Apache-2.0
"""The simulator with its network in torch has the results of numpy, on the requested device."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from robots import write_robot
from torch.overrides import TorchFunctionMode

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.network import TorchLengths
from musculoskeletal_ae.mae.residuals import TouchStatistics
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation

ARMS = 5


class Devices(TorchFunctionMode):
    """Records the devices of all tensors that torch functions return."""

    def __init__(self):
        super().__init__()
        self.types = set()

    def __torch_function__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        self.types |= {result.device.type} if isinstance(result, torch.Tensor) else set()
        return result


@pytest.fixture(
    scope='module',
    params=['arm26', pytest.param('musashi_upper_body', marks=pytest.mark.thorough), 'slider'],
)
def robot(request, tmp_path_factory):
    if request.param != 'slider':
        return Robot.load(request.param)
    # This robot has two groups, a prismatic joint and a coupled joint.
    coupled = {'joint': 'finger', 'master': 'bend', 'ratio': -0.5, 'offset': 0.2}
    folder = tmp_path_factory.mktemp('slider')
    return Robot.load(write_robot(folder, slider=True, finger=True, couplings=[coupled]))


@pytest.fixture(scope='module')
def mae(robot):
    touch = TouchStatistics(np.full(robot.muscle_count, 0.15), np.ones(robot.joint_count))
    return replace(initial_mae(robot, steps=2).mae, touch=touch)


def pushed(robot, mae, device):
    rng = np.random.default_rng(0)
    arms = Simulation(robot, mae, arms=ARMS, device=device)
    theta = robot.random_postures(ARMS, rng)
    tension = rng.uniform(robot.tension.bias, robot.tension.limit, (ARMS, robot.muscle_count))
    arms.command = mae.lengths(theta, tension)
    arms.wrench = rng.normal(0.0, 8.0, (ARMS, 6))
    arms.fixed[0, 0] = 0.1
    return arms


def test_torch_agrees_with_numpy(robot, mae):
    one, other = (pushed(robot, mae, device) for device in (None, 'cpu'))
    for _ in range(3):
        for ours, theirs in zip(one.step(0.02), other.step(0.02), strict=True):
            # The tolerance covers rounding errors of single precision, which stiff muscles amplify.
            np.testing.assert_allclose(theirs, ours, rtol=1e-4, atol=1e-2)
        np.testing.assert_allclose(other.state.theta, one.state.theta, atol=1e-5)
        assert other.report() == one.report()
        one.isolate([1])
        other.isolate([1])
    assert (other.state.tension[:, 1] == 0.0).all()


def test_the_network_is_computed_on_the_device(robot, mae):
    # Tensors on the device `meta` have no values. Like tensors on a GPU, they cannot be mixed with
    # tensors on another device.
    theta = robot.random_postures(ARMS, np.random.default_rng(0))
    network, tension = TorchLengths(mae, 'meta'), np.ones((ARMS, robot.muscle_count))
    with Devices() as devices, pytest.raises((NotImplementedError, RuntimeError), match='meta'):
        network.lengths_with_pullback(theta, tension)
    assert devices.types == {'meta'}


@pytest.mark.skipif(torch.cuda.is_available(), reason='this machine has a GPU')
def test_device_cuda_is_refused_without_a_gpu(robot, mae):
    with pytest.raises(MusculoskeletalError, match=r"device 'cuda'.*cannot use it; legal: cpu"):
        Simulation(robot, mae, device='cuda')


def test_preset_paper_is_refused_on_a_device(robot, mae):
    with pytest.raises(MusculoskeletalError, match=r"'cuda': preset 'paper'.*presets: default"):
        Simulation(robot, mae, 'paper', device='cuda')
