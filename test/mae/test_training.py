# SPDX-License-Identifier: Apache-2.0


import numpy as np
import pytest
import torch
from robots import read_muscles, write_muscles, write_robot

from musculoskeletal_ae.mae.default_training import POSTURE_MARGIN, annealing, overload_states
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.training import pair_errors, random_states, shuffled
from musculoskeletal_ae.mae.units import Mask
from musculoskeletal_ae.presets.registry import PRESETS
from musculoskeletal_ae.robot.robot import Robot


def test_paper_preset_enters_scaled_units_as_they_are(trained):
    np.testing.assert_array_equal(trained['paper'].mean, 0.0)
    np.testing.assert_array_equal(trained['paper'].std, 1.0)


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
    # l = f_geo − L_e, and the elongation L_e grows with the absolute length at the rate `slope`.
    slope = robot.series_elastic.length_slope(tension)[..., None]
    true = robot.routes.muscle_jacobian(theta) * (1.0 - slope)
    error = trained['default'].muscle_jacobian(theta, tension) - true
    assert np.abs(error).mean() < 0.05 * np.abs(true).mean()


def test_same_seed_gives_the_same_network_and_another_seed_another(robot):
    one, again, other = (initial_mae(robot, 'paper', seed, steps=5) for seed in (7, 7, 8))
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


def test_annealing_rises_and_then_falls_to_nothing():
    assert annealing(0.0) == 0.0
    assert annealing(0.05) == pytest.approx(1.0)
    assert annealing(1.0) == pytest.approx(0.0)


def check_trains(arm: Robot) -> None:
    for preset in PRESETS:
        mae = initial_mae(arm, preset, steps=10)
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
    assert arm.upper[0] < 0.0  # θ = 0, to which lengths are relative, is beyond the joint limits
    check_trains(arm)
