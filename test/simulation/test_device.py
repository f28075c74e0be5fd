# SPDX-License-Identifier: Apache-2.0
"""The simulator by torch: what numpy computes, and nowhere but on the device that was asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from robots import write_robot
from torch.overrides import TorchFunctionMode

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae import training
from musculoskeletal_ae.mae.residuals import TouchStatistics
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation

ARMS = 4


class Untold(TorchFunctionMode):
    """Answers what tensors without numbers cannot: whether something is true of them."""

    def __init__(self, answer):
        super().__init__()
        self.answer = answer

    def __torch_function__(self, function, types, args=(), kwargs=None):
        if function is torch.Tensor.__bool__:
            return self.answer
        return function(*args, **(kwargs or {}))


@pytest.fixture(scope='module', params=['arm26', 'slider'])
def robot(request, tmp_path_factory):
    if request.param == 'arm26':
        return Robot.load('arm26')
    # Two groups, one with a joint that slides; a joint that follows another.
    coupled = {'joint': 'finger', 'master': 'bend', 'ratio': -0.5, 'offset': 0.2}
    folder = tmp_path_factory.mktemp('slider')
    return Robot.load(write_robot(folder, slider=True, finger=True, couplings=[coupled]))


@pytest.fixture(scope='module')
def mae(robot):
    touch = TouchStatistics(np.full(robot.muscle_count, 0.15), np.ones(robot.joint_count))
    return replace(initial_mae(robot, steps=20).mae, touch=touch)


def pushed(robot, mae, device):
    rng = np.random.default_rng(0)
    arms = Simulation(robot, mae, arms=ARMS, device=device)
    theta = robot.random_postures(ARMS, rng)
    tension = rng.uniform(robot.tension.bias, robot.tension.limit, (ARMS, robot.muscle_count))
    arms.command = mae.lengths(theta, tension)
    arms.wrench = rng.normal(0.0, 8.0, (ARMS, 6))
    arms.fixed[0, 0] = 0.1
    return arms


def test_torch_computes_what_numpy_does(robot, mae):
    one, other = (pushed(robot, mae, device) for device in (None, 'cpu'))
    for _ in range(3):
        for ours, theirs in zip(one.step(0.02), other.step(0.02), strict=True):
            # Networks are of single precision, and muscles stiff.
            np.testing.assert_allclose(theirs.numpy(), ours, rtol=1e-4, atol=1e-2)
        np.testing.assert_allclose(other.state.theta.numpy(), one.state.theta, atol=1e-5)
        assert other.report() == one.report()
        one.isolate([1])
        other.isolate([1])
    assert (other.state.tension[:, 1] == 0.0).all()


@pytest.mark.parametrize('answer', [True, False])
def test_everything_is_on_the_device(robot, mae, monkeypatch, answer):
    monkeypatch.setattr(training, 'check_device', lambda _: None)
    # Tensors of `meta` mix with no others, as those of a GPU do not.
    with Untold(answer):
        arms = pushed(robot, mae, 'meta')
        arms.step(0.02)
        arms.isolate([1])
        arms.use(mae)
        arms.start_from(robot.random_postures(2, np.random.default_rng(1)))
        state = arms.step(0.01)
    assert {part.device.type for part in state} == {'meta'}
    assert {part.dtype for part in state} == {torch.float64}


@pytest.mark.skipif(torch.cuda.is_available(), reason='it simulates there')
def test_without_a_gpu_it_says_so(robot, mae):
    with pytest.raises(MusculoskeletalError, match=r"device 'cuda'.*nothing there.*legal: cpu"):
        Simulation(robot, mae, device='cuda')


def test_the_paper_s_descent_is_on_no_device(robot, mae):
    with pytest.raises(MusculoskeletalError, match=r"'paper'.*'cuda'.*Legal there: default"):
        Simulation(robot, mae, 'paper', device='cuda')
