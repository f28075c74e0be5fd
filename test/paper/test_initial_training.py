# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest
import torch

from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.paper import constants
from musculoskeletal_ae.paper.initial_training import loss, random_states
from musculoskeletal_ae.paper.network import new_network
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.robot.robot import Robot


def test_the_network_has_the_printed_layers():
    arm = Robot.load('musashi_left_arm')
    mae = initial_mae(arm, 'paper', steps=1)
    assert mae.layer_sizes == (5 + 2 * 10 + 3, 200, 30, 5 + 10, 30, 200, 5 + 2 * 10)


def test_100_batches_and_30_epochs_make_3000_mini_batches_for_any_body():
    assert constants.INITIAL_SAMPLES // constants.INITIAL_BATCH == 100
    for name in ('arm26', 'musashi_upper_body'):
        assert preset_named('paper').initial_steps(Robot.load(name)) == 30 * 100


def test_the_samples_are_states_of_the_geometric_model():
    robot = Robot.load('arm26')
    theta, tension, length = random_states(robot, 500, np.random.default_rng(0))
    np.testing.assert_array_equal(length, robot.muscle_lengths(theta, tension))
    assert ((theta >= robot.lower) & (theta <= robot.upper)).all()
    assert tension.min() < 10.0 and (tension.max(axis=0) > 0.95 * robot.tension.max).all()


def test_the_loss_is_the_weighted_sum_of_plain_norms():
    values = random_states(Robot.load('arm26'), 5, np.random.default_rng(0)).scaled()
    network = new_network(2, 6)
    tensor, mask = torch.tensor(values, dtype=torch.float32), torch.tensor([0, 1, 2, 0, 1])
    error = network(tensor, mask).detach().numpy() - values
    norms = [np.linalg.norm(error[:, a:b], axis=1).mean() for a, b in ((0, 2), (2, 8), (8, 14))]
    got = loss(network, tensor, mask).item()
    assert got == pytest.approx(norms[0] + 10 * norms[1] + 10 * norms[2], rel=1e-5)


def test_the_loss_has_a_finite_gradient_where_nothing_is_wrong():
    network = new_network(1, 2)
    for parameter in network.parameters():
        torch.nn.init.zeros_(parameter)
    loss(network, torch.zeros(3, 5), torch.arange(3)).backward()
    gradients = [p.grad for p in network.parameters() if p.grad is not None]
    assert gradients and all(torch.isfinite(g).all() for g in gradients)
