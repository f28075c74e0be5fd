# SPDX-License-Identifier: Apache-2.0
"""The simulator with its network by torch: what numpy computes, and where it was asked for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.network import TorchLengths
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation

ARMS = 5


class Devices(TorchFunctionMode):
    """Notes where the tensors are that functions return."""

    def __init__(self):
        super().__init__()
        self.seen = set()

    def __torch_function__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        self.seen |= {result.device.type} if isinstance(result, torch.Tensor) else set()
        return result


@pytest.fixture(scope='module', params=['arm26', 'musashi_upper_body'])
def robot(request):
    return Robot.load(request.param)


@pytest.fixture(scope='module')
def mae(robot):
    return initial_mae(robot, steps=20).mae


def test_torch_computes_what_numpy_does(robot, mae):
    one, other = (Simulation(robot, mae, arms=ARMS, device=device) for device in (None, 'cpu'))
    for arms in (one, other):
        rng = np.random.default_rng(0)
        tension = rng.uniform(robot.tension.bias, robot.tension.limit, (ARMS, robot.muscle_count))
        arms.command = mae.lengths(robot.random_postures(ARMS, rng), tension)
    for ours, theirs in zip(one.step(0.05), other.step(0.05), strict=True):
        # Networks are of single precision, and muscles stiff.
        np.testing.assert_allclose(theirs, ours, rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(other.state.theta, one.state.theta, atol=1e-5)


def test_the_network_is_on_the_device(robot, mae):
    # Tensors of `meta` mix with no others, as those of a GPU do not; numbers they have none.
    theta = robot.random_postures(ARMS, np.random.default_rng(0))
    network, tension = TorchLengths(mae, 'meta'), np.ones((ARMS, robot.muscle_count))
    with Devices() as devices, pytest.raises((NotImplementedError, RuntimeError), match='meta'):
        network.lengths_with_pullback(theta, tension)
    assert devices.seen == {'meta'}


@pytest.mark.skipif(torch.cuda.is_available(), reason='it simulates there')
def test_without_a_gpu_it_says_so(robot, mae):
    with pytest.raises(MusculoskeletalError, match=r"device 'cuda'.*nothing there.*legal: cpu"):
        Simulation(robot, mae, device='cuda')


def test_the_paper_s_descent_is_on_no_device(robot, mae):
    with pytest.raises(MusculoskeletalError, match=r"'paper'.*'cuda'.*Legal there: default"):
        Simulation(robot, mae, 'paper', device='cuda')
