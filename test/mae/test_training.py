# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest
import torch
from msgspec import structs
from robots import read_muscles, write_muscles, write_robot

from musculoskeletal_ae.mae.network import Network, from_mae, to_mae
from musculoskeletal_ae.mae.training import (
    POSTURE_MARGIN,
    annealing,
    fit,
    initial_mae,
    loss,
    overload_states,
    pair_errors,
    random_states,
    shuffled,
)
from musculoskeletal_ae.mae.units import Mask
from musculoskeletal_ae.presets import PAPER, PRESETS
from musculoskeletal_ae.robot.robot import Robot


def test_paper_preset_has_the_layers_of_the_paper():
    arm = Robot.load('musashi_left_arm')
    mae = initial_mae(arm, 'paper', steps=1).mae
    assert mae.layer_sizes == (5 + 2 * 10 + 3, 200, 30, 5 + 10, 30, 200, 5 + 2 * 10)


def test_paper_preset_trains_as_the_paper_does():
    paper = PAPER.training
    assert paper.weights == (1.0, 10.0, 10.0)
    assert paper.steps * paper.batch == 30 * paper.samples == 30 * 10_000
    assert (paper.optimiser, paper.step_size, paper.annealed) == ('adam', 1e-3, False)
    assert not PAPER.network.standardise and not paper.standard_norms


def test_paper_preset_enters_scaled_units_as_they_are(trained):
    np.testing.assert_array_equal(trained['paper'].mean, 0.0)
    np.testing.assert_array_equal(trained['paper'].std, 1.0)


def test_loss_is_the_weighted_sum_of_plain_norms(robot):
    values = random_states(robot, 5, np.random.default_rng(0), 500.0).scaled()
    network = Network(2, 6, PAPER.network, np.zeros(14), np.ones(14))
    tensor, mask = torch.tensor(values, dtype=torch.float32), torch.tensor([0, 1, 2, 0, 1])
    error = network(tensor, mask).detach().numpy() - values
    norms = [np.linalg.norm(error[:, a:b], axis=1).mean() for a, b in ((0, 2), (2, 8), (8, 14))]
    got = loss(network, tensor, mask, PAPER.training).item()
    assert got == pytest.approx(norms[0] + 10 * norms[1] + 10 * norms[2], rel=1e-5)


def test_loss_has_a_finite_gradient_where_nothing_is_wrong():
    network = Network(1, 2, PAPER.network, np.zeros(5), np.ones(5))
    for parameter in network.parameters():
        torch.nn.init.zeros_(parameter)
    value = loss(network, torch.zeros(3, 5), torch.arange(3), PAPER.training)
    value.backward()
    gradients = [p.grad for p in network.parameters() if p.grad is not None]
    assert gradients and all(torch.isfinite(g).all() for g in gradients)


def test_training_samples_cover_the_geometric_model_slightly_beyond_its_limits(robot):
    theta, tension, length = overload_states(robot, 2000, np.random.default_rng(0))
    margin = POSTURE_MARGIN * (robot.upper - robot.lower)
    assert (theta >= robot.lower - margin).all() and (theta <= robot.upper + margin).all()
    assert (theta.min(axis=0) < robot.lower).all() and (theta.max(axis=0) > robot.upper).all()
    assert tension.min() >= 0.0
    assert robot.tension.limit[0] < tension.max() <= robot.tension.max[0]
    assert (tension <= robot.tension.limit).all(axis=1).mean() > 0.75
    np.testing.assert_allclose(length, robot.muscle_lengths(theta, tension), atol=1e-12)


def test_an_epoch_shows_every_sample_once():
    batches = shuffled(np.arange(12.0)[:, None], 4, np.random.default_rng(0))
    for _ in range(2):
        epoch = np.concatenate([next(batches) for _ in range(3)])
        assert sorted(epoch[:, 0]) == list(range(12))


def test_fewer_samples_than_a_batch_are_one_batch():
    assert len(next(shuffled(np.ones((3, 2)), 10, np.random.default_rng(0)))) == 3


@pytest.mark.parametrize('preset', ['default', 'paper'])
def test_a_tenth_of_the_training_beats_the_mean_posture(robot, trained, preset):
    states = random_states(robot, 500, np.random.default_rng(5), robot.tension.limit)
    trivial = np.linalg.norm(states.theta - states.theta.mean(axis=0), axis=1).mean()
    errors = pair_errors(trained[preset], states)
    assert len(errors) == 9
    theta = [e for e in errors if e.mask is Mask.TENSION_LENGTH and e.output == 'theta']
    assert theta[0].norm < 0.3 * trivial
    assert theta[0].elements.shape == (2,)


def test_muscle_jacobian_approaches_the_geometric_one(robot, trained):
    theta, tension, _ = random_states(robot, 100, np.random.default_rng(6), robot.tension.limit)
    # l = f_geo − L_e(l_abs, T), and L_e grows with l_abs.
    slope = robot.series_elastic.length_slope(tension)[..., None]
    true = robot.routes.muscle_jacobian(theta) * (1.0 - slope)
    error = trained['default'].muscle_jacobian(theta, tension) - true
    assert np.abs(error).mean() < 0.05 * np.abs(true).mean()


def test_same_seed_gives_the_same_network_and_another_seed_another(robot):
    one, again, other = (initial_mae(robot, 'paper', seed, steps=5).mae for seed in (7, 7, 8))
    for (w1, b1), (w2, b2) in zip(one.encoder + one.decoder, again.encoder + again.decoder):
        np.testing.assert_array_equal(w1, w2)
        np.testing.assert_array_equal(b1, b2)
    assert (one.encoder[0][0] != other.encoder[0][0]).any()


def test_training_leaves_the_callers_random_state_and_threads_alone(robot):
    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    threads = torch.get_num_threads()
    initial_mae(robot, 'default', seed=9, steps=2)
    assert torch.get_num_threads() == threads
    assert torch.equal(torch.rand(3), expected)


def test_training_goes_on_from_given_weights(robot, trained):
    rng = np.random.default_rng(2)
    batches = shuffled(random_states(robot, 2000, rng, 200.0).scaled(), 64, rng)
    settings = structs.replace(PAPER.training, steps=200, step_size=3e-4)
    before = trained['paper']
    network = from_mae(before)
    observed: list[int] = []
    losses = fit(network, batches, settings, progress=lambda step, *_: observed.append(step))
    after = to_mae(network, robot.joints, robot.muscles, 'paper', 'more')
    states = random_states(robot, 500, rng, 200.0)
    assert observed == list(range(200)) and len(losses) == 200

    def error(mae):
        return sum(e.norm for e in pair_errors(mae, states) if e.output == 'theta')

    assert error(after) < 0.85 * error(before)  # 0.60 to 0.67 over six seeds


def test_annealing_rises_and_then_falls_to_nothing():
    assert annealing(0.0) == 0.0
    assert annealing(0.05) == pytest.approx(1.0)
    assert annealing(1.0) == pytest.approx(0.0)


def check_trains(arm: Robot) -> None:
    for preset in PRESETS:
        mae = initial_mae(arm, preset, steps=100).mae
        states = random_states(arm, 50, np.random.default_rng(0), arm.tension.max)
        assert all(np.isfinite(e.norm) for e in pair_errors(mae, states))
        shape = (arm.muscle_count, arm.joint_count)
        assert mae.muscle_jacobian(states.theta[0], states.tension[0]).shape == shape


def test_an_arm_with_a_prismatic_joint_trains(tmp_path):
    check_trains(Robot.load(write_robot(tmp_path, slider=True)))


def test_an_arm_of_one_joint_and_two_muscles_trains(tmp_path):
    directory = write_robot(tmp_path, joints=['bend'])
    document = read_muscles(directory)
    document['muscles'] = document['muscles'][-2:]
    arm = Robot.load(write_muscles(directory, document))
    assert (arm.joint_count, arm.muscle_count) == (1, 2)
    assert arm.upper[0] < 0.0  # the posture that lengths are relative to is out of reach
    check_trains(arm)
