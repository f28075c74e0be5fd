# SPDX-License-Identifier: Apache-2.0
"""A robot with fewer muscles than joints is learned from the postures in which it can rest."""

from itertools import islice

import bodies
import numpy as np
import pytest
from robots import write_robot

from musculoskeletal_ae.control.settings import Settings, Setup
from musculoskeletal_ae.importing.convert import import_robot
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.training import rest_states
from musculoskeletal_ae.motion.exploration import Exploration
from musculoskeletal_ae.robot.equilibrium_states import has_followers, settled_states
from musculoskeletal_ae.robot.robot import Robot


@pytest.fixture(scope='module')
def finger(tmp_path_factory):
    folder = tmp_path_factory.mktemp('finger')
    (folder / 'finger.xml').write_text(bodies.UNDERACTUATED)
    return import_robot(folder / 'finger.xml', folder / 'robot').robot


def test_one_tendon_of_two_sprung_joints_determines_where_they_settle(finger):
    tension = np.repeat([[1.0], [2.5], [4.0]], 20, axis=0)
    start = finger.random_postures(60, np.random.default_rng(0))
    found = settled_states(finger, start, tension)
    assert len(found.theta) == 60
    torque = finger.kinematics.holding_torque(found.theta)
    missing = torque + np.einsum('nmd,nm->nd', found.jacobian, found.tension)
    free = (found.theta > finger.lower) & (found.theta < finger.upper)
    assert np.abs(missing[free]).max() < 0.02 * np.abs(torque).max()
    # A joint at a limit is pressed against its stop.
    assert (missing[found.theta <= finger.lower] > 0.0).all()
    assert (missing[found.theta >= finger.upper] < 0.0).all()
    groups = found.theta.reshape(3, 20, 2)
    assert np.ptp(groups, axis=1).max() < 0.05  # the start does not matter
    assert (np.diff(groups.mean(axis=1), axis=0).sum(axis=1) > 0.2).all()  # more tension bends it


def test_the_finger_explores_postures_in_which_it_can_rest(finger):
    steps = [*islice(Exploration(Setup(finger, Settings()), 1), 90)]
    theta, tension = (np.array(part) for part in zip(*((s.theta, s.tension) for s in steps[1::3])))
    settled = settled_states(finger, theta, tension)
    assert len(settled.theta) == len(theta)
    np.testing.assert_allclose(settled.theta, theta, atol=0.05)
    assert (theta.std(axis=0) > 0.15 * (finger.upper - finger.lower)).all()


def test_a_network_tells_two_angles_from_one_tendon_where_the_finger_can_rest(finger):
    mae = initial_mae(finger, steps=300)
    states = rest_states(finger, 1000, np.random.default_rng(5))
    error = mae.estimate(states.tension, states.length).theta - states.theta
    spread = states.theta - states.theta.mean(axis=0)
    assert np.linalg.norm(error, axis=1).mean() < 0.25 * np.linalg.norm(spread, axis=1).mean()


def test_a_robot_with_enough_muscles_is_learned_everywhere(tmp_path):
    robot = Robot.load(write_robot(tmp_path))
    assert not has_followers(robot)
    theta = rest_states(robot, 500, np.random.default_rng(0)).theta
    assert ((theta - robot.lower) / (robot.upper - robot.lower)).std(axis=0).min() > 0.25
