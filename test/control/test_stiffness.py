# SPDX-License-Identifier: Apache-2.0
"""Predicted stiffness, compared with the geometric model and with a push on the nominal arm."""

import numpy as np
import pytest
from exact_mae import ExactMae
from nominal_body import stiffness_ratios

from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.motion.methods import MARGINS, StiffnessModel, stiffness_command
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.stiffness import joint_stiffness, muscle_hessian

THETA = np.array([0.1, -0.4, 0.2, -1.0, 0.1])


@pytest.fixture(scope='module')
def robot():
    return Robot.load('musashi_left_arm')


@pytest.fixture(scope='module')
def mae(robot):
    return ExactMae(robot)


def solve(robot, mae, desired):
    torque = robot.kinematics.holding_torque(THETA)
    return stiffness_command(robot, mae, THETA, torque, desired, robot.tension.limit)


def test_the_model_read_off_an_exact_network_is_the_geometric_one(robot, mae):
    tension = np.random.default_rng(0).uniform(40.0, 190.0, robot.muscle_count)
    model = StiffnessModel.read(robot, mae, THETA, tension)
    jacobian = robot.routes.muscle_jacobian
    k = robot.muscle_stiffness(THETA, tension)
    true = joint_stiffness(jacobian(THETA), muscle_hessian(jacobian, THETA), k, tension)
    # The model approximates the elongation by a cubic polynomial. The geometric moment arms do not
    # include the stretch of the tendons. Together these differences reach 1 %.
    np.testing.assert_allclose(model.joint_stiffness(tension), true, atol=0.01 * np.trace(true))
    np.testing.assert_allclose(model.muscle_stiffness(tension)[0], k, rtol=0.05)


def test_the_slope_of_joint_stiffness_by_tension_is_the_difference_quotient(robot, mae):
    tension = np.full(robot.muscle_count, 90.0)
    model = StiffnessModel.read(robot, mae, THETA, tension)
    for i, step in enumerate(1e-3 * np.eye(robot.muscle_count)):
        ahead, behind = (model.joint_stiffness(tension + s * step) for s in (1.0, -1.0))
        np.testing.assert_allclose(
            model.slope(tension)[:, i], np.diag(ahead - behind) / 2e-3, rtol=1e-5, atol=1e-8
        )


@pytest.mark.parametrize('joint', range(5))
def test_a_stiffness_within_the_reported_range_is_met_and_the_posture_held(robot, mae, joint):
    free = solve(robot, mae, np.zeros(5)).stiffness
    torque = robot.kinematics.holding_torque(THETA)
    for share in (0.1, 0.5, 0.9):
        desired = np.zeros(5)
        desired[joint] = free.lowest[joint] + share * (free.highest[joint] - free.lowest[joint])
        solution = solve(robot, mae, desired)
        tension = solution.tension
        assert solution.stiffness.expected[joint, joint] == pytest.approx(desired[joint], rel=0.01)
        held = -mae.muscle_jacobian(THETA, tension).T @ tension
        np.testing.assert_allclose(held, torque, atol=0.03)
        assert (tension >= robot.tension.bias + MARGINS[-2] - 1e-6).all()
        assert (tension <= robot.tension.limit + 1e-6).all()


def test_no_tension_that_holds_the_posture_leaves_the_reported_range(robot, mae):
    free = solve(robot, mae, np.zeros(5)).stiffness
    assert (free.lowest < free.highest).all()
    rng = np.random.default_rng(4)
    for _ in range(20):
        stiffness = solve(robot, mae, rng.uniform(0.0, 60.0, 5)).stiffness
        assert (np.diag(stiffness.expected) >= free.lowest * 0.98).all()
        assert (np.diag(stiffness.expected) <= free.highest * 1.02).all()


def test_a_stiffness_beyond_the_range_gives_the_end_of_the_range(robot, mae):
    free = solve(robot, mae, np.zeros(5)).stiffness
    for beyond, end in ((1e4, free.highest), (1e-3, free.lowest)):
        stiffness = solve(robot, mae, np.array([0.0, 0.0, 0.0, 0.0, beyond])).stiffness
        assert stiffness.expected[4, 4] == pytest.approx(end[4], rel=0.02)


def test_torque_beyond_the_muscles_leaves_no_range_and_is_reported(robot, mae):
    solution = stiffness_command(robot, mae, THETA, np.full(5, 300.0), np.full(5, 20.0), 200.0)
    assert np.linalg.norm(solution.missing_torque) > 100.0
    np.testing.assert_array_equal(solution.stiffness.lowest, solution.stiffness.highest)
    assert np.isfinite(solution.length).all()


def test_a_push_turns_the_nominal_arm_by_the_predicted_ratio(robot, mae):
    measured, predicted = stiffness_ratios(robot, mae, (0, 1)).T
    np.testing.assert_allclose(measured / predicted, 1.0, atol=0.05)
    assert predicted.max() > 1.2  # a ratio of 1 would be a trivial prediction


@pytest.mark.thorough
def test_a_push_turns_bodies_with_friction_by_about_the_predicted_ratio(robot, mae):
    # The push is much larger than friction. The ratio of a single arm still differs by 0.1 from the
    # prediction, so this test compares the mean of three arms.
    arms = [EmulatedArm(robot, seed) for seed in range(3)]
    ratios = [stiffness_ratios(robot, mae, (1,), arm, push=3.0) for arm in arms]
    measured, predicted = np.mean(ratios, axis=0)[0]
    assert predicted > 1.25
    assert measured == pytest.approx(predicted, abs=0.2)
