# SPDX-License-Identifier: Apache-2.0
"""`proposed` on the geometric model, where the optimum is known, and on a small trained network."""

from __future__ import annotations

import numpy as np
import pytest
from exact_mae import ExactMae

from musculoskeletal_ae.control import methods as control
from musculoskeletal_ae.control.methods import first_command, msc_compensation
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.emulator.individual import NOMINAL, Individual
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.mae.descent import descend, loss
from musculoskeletal_ae.mae.network import to_mae
from musculoskeletal_ae.mae.training import initial_training
from musculoskeletal_ae.mae.units import Mask
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension


@pytest.fixture(scope='module', params=['musashi_left_arm', 'arm26'])
def robot(request):
    return Robot.load(request.param)


def holdable(robot, seed):
    """Return a random posture, its holding torque and the least tension."""
    rng = np.random.default_rng(seed)
    for theta in robot.random_postures(100, rng):
        torque = robot.kinematics.holding_torque(theta)
        jacobian = robot.routes.muscle_jacobian(theta)
        try:
            return theta, torque, holding_tension(jacobian, torque, 30.0, 200.0, 0.0)
        except InfeasibleError:
            continue
    raise AssertionError('no posture can be held')


@pytest.mark.parametrize('seed', range(3))
def test_with_an_exact_body_image_the_arm_settles_at_the_target_with_the_least_tension(robot, seed):
    theta, torque, least = holdable(robot, seed)
    bias = np.full(robot.muscle_count, robot.tension.bias)
    found = control.proposed(robot, ExactMae(robot), theta, torque, bias, robot.tension.limit)
    arm = EmulatedArm(robot, 0, Individual(robot, 0, NOMINAL))
    arm.reset(theta + 0.1)
    for _ in range(150):
        arm.command_length(found.length)
        arm.step(0.02)
    assert np.linalg.norm(arm.theta - theta) < 0.01
    # The wire's stretch grows with its length, which lowers its torque by up to half a percent.
    assert np.linalg.norm(found.tension) == pytest.approx(np.linalg.norm(least), rel=0.02)
    assert not found.missing_torque.any()


def test_no_other_tension_that_holds_the_posture_is_smaller(robot):
    theta, torque, _ = holdable(robot, 7)
    mae, limit = ExactMae(robot), robot.tension.limit
    start = np.full(robot.muscle_count, 30.0)
    found = control.proposed(robot, mae, theta, torque, start, limit)
    jacobian = mae.muscle_jacobian(theta, found.tension)
    np.testing.assert_allclose(jacobian.T @ found.tension, -torque, atol=0.02)
    for wish in np.random.default_rng(0).uniform(30.0, limit, (10, robot.muscle_count)):
        other = holding_tension(jacobian, torque, robot.tension.bias, limit, wish)
        assert np.linalg.norm(found.tension) <= np.linalg.norm(other) + 0.1


def test_torque_beyond_the_muscles_is_told_and_tensions_stay_within_their_limits(robot):
    theta, torque, _ = holdable(robot, 1)
    limit = np.linspace(60.0, 120.0, robot.muscle_count)
    found = control.proposed(robot, ExactMae(robot), theta, torque + 500.0, limit, limit)
    assert (found.tension >= 30.0 - 1e-6).all()
    assert (found.tension <= limit + 1e-6).all()
    assert np.linalg.norm(found.missing_torque) > 100.0


def test_an_image_that_is_not_finite_is_refused_and_never_commanded(robot):
    theta, torque, _ = holdable(robot, 1)
    torque[0] = np.nan
    bias = np.full(robot.muscle_count, 30.0)
    with pytest.raises(InfeasibleError, match='not finite'):
        control.proposed(robot, ExactMae(robot), theta, torque, bias, 200.0)


def test_the_command_lies_below_the_length_by_what_the_module_needs_to_pull(robot):
    theta, _, least = holdable(robot, 2)
    mae = ExactMae(robot)
    short = mae.lengths(theta, least) - first_command(robot, mae, theta, least)
    np.testing.assert_allclose(30.0 + robot.stiffness * short, least)
    assert msc_compensation(robot, np.full(robot.muscle_count, 30.0)).max() == 0.0


def test_preset_paper_lowers_the_printed_loss():
    robot = Robot.load('arm26')
    network, _ = initial_training(robot, 'paper', steps=200)
    mae = to_mae(network, robot.joints, robot.muscles, 'paper', 'briefly, for a test')
    theta, torque, _ = holdable(robot, 0)
    tension = np.full(6, 100.0)
    terms = control.paper_terms(robot, mae, theta, torque, tension)
    start = mae.encode(Mask.THETA_TENSION, theta, tension)
    end = descend(mae, start, terms, control.SEARCH)
    assert loss(terms, mae.decode_scaled(end)) < 0.9 * loss(terms, mae.decode_scaled(start))
    found = control.proposed_paper(robot, mae, theta, torque, tension)
    np.testing.assert_allclose(found.tension, mae.decode(end).tension)
