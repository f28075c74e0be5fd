# SPDX-License-Identifier: Apache-2.0
"""The simulator on trained networks, and on one that nobody would train."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench import sim_pictures
from bench.simulation_nominal import compare, random_commands, rest_errors
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation


@pytest.fixture(scope='module')
def robot():
    return Robot.load('arm26')


@pytest.fixture(scope='module')
def mae(robot):
    return initial_mae(robot, 'default', seed=0, steps=700).mae


def test_it_rests_where_the_nominal_body_rests_and_stays_there(robot, mae):
    commands = random_commands(robot, 10, seed=2)
    theta, _, drift, tension_drift = rest_errors(robot, mae, 'default', commands)
    assert np.median(theta.max(axis=1)) < 0.05  # briefly trained: the tails are longer
    assert drift.max() < 0.02
    assert tension_drift.max() < 5.0


def test_one_arm_and_a_batch_agree_to_a_millionth(robot, mae):
    commands = random_commands(robot, 300, seed=3)
    batch = Simulation(robot, mae, arms=300)
    batch.command = commands
    batch.wrench[:, 2] = -10.0
    batch.step(0.3)
    for i in (0, 17, 299):
        single = Simulation(robot, mae)
        single.command, single.wrench = commands[[i]], batch.wrench[[i]]
        for ours, theirs in zip(single.step(0.3), batch.state, strict=True):
            np.testing.assert_allclose(ours[0], theirs[i], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize('preset', ['default', 'paper'])
def test_a_nonsense_network_moves_it_within_its_limits_only(robot, mae, preset):
    rng = np.random.default_rng(5)
    wild = tuple((1e3 * rng.normal(size=w.shape), 1e3 * b) for w, b in mae.decoder)
    arms = Simulation(robot, replace(mae, decoder=wild), preset, arms=3)
    arms.command = random_commands(robot, 3, seed=0)
    arms.wrench[:] = 1e6
    state = arms.step(2.0)
    assert np.all((state.theta >= robot.lower) & (state.theta <= robot.upper))
    assert np.all((state.tension >= robot.tension.bias) & (state.tension <= robot.tension.max))
    arms.use(mae)
    arms.wrench[:] = 0.0
    assert np.isfinite(arms.settle().length).all()


def test_preset_paper_goes_towards_forced_postures(robot):
    mae = initial_mae(robot, 'paper', seed=0, steps=500).mae
    arms = Simulation(robot, mae, 'paper')
    arms.fixed[0] = [np.nan, -1.2]
    before = abs(arms.state.theta[0, 1] + 1.2)
    state = arms.step(1.0)
    assert abs(state.theta[0, 1] + 1.2) < 0.3 * before
    assert np.all((state.theta >= robot.lower) & (state.theta <= robot.upper))


def test_the_same_commands_bring_arm_and_simulator_close(robot, mae):
    commands = list(random_commands(robot, 2, seed=1))
    distance = compare(EmulatedArm(robot, 1), Simulation(robot, mae), commands, duration=1.0)
    still = compare(EmulatedArm(robot, 1), Simulation(robot, mae), [commands[0]] * 2, duration=0.01)
    assert 0.0 < distance.theta < 0.5
    assert still.theta >= 0.0 and distance.tension < 100.0


def test_pictures_of_an_arm_at_rest_and_loaded_are_written(robot, mae, tmp_path):
    files = sim_pictures.save_both(robot, mae, tmp_path / 'new')
    assert [file.name for file in files] == ['sim_at_rest.png', 'sim_loaded.png']
    assert all(file.read_bytes().startswith(b'\x89PNG') for file in files)
