# SPDX-License-Identifier: Apache-2.0
import numpy as np
from differences import slopes
from hypothesis import given, settings
from hypothesis import strategies as st

from musculoskeletal_ae.robot import routes
from musculoskeletal_ae.robot.robot import Robot

MUSASHI = Robot.load('musashi_left_arm')


def test_muscle_jacobian_is_the_derivative_of_length(robot):
    for theta in robot.random_postures(10, np.random.default_rng(0)):
        expected = slopes(robot.routes.absolute_lengths, theta)
        np.testing.assert_allclose(robot.routes.muscle_jacobian(theta), expected, atol=1e-8)


@settings(max_examples=50)
@given(st.lists(st.floats(-3.0, 3.0), min_size=5, max_size=5))
def test_muscle_jacobian_is_the_derivative_of_length_beyond_the_limits_too(angles):
    theta = np.array(angles)
    expected = slopes(MUSASHI.routes.absolute_lengths, theta)
    # Where a tendon passes close to a joint's centre, its length is strongly curved. The numerical
    # derivative is then less accurate, so a relative tolerance is needed.
    np.testing.assert_allclose(
        MUSASHI.routes.muscle_jacobian(theta), expected, atol=1e-6, rtol=1e-3
    )


def test_relative_length_is_zero_at_theta_zero(robot):
    zero = np.zeros(robot.joint_count)
    np.testing.assert_array_equal(robot.routes.relative_lengths(zero), np.zeros(robot.muscle_count))
    no_tension = robot.muscle_lengths(zero, np.zeros(robot.muscle_count))
    np.testing.assert_array_equal(no_tension, np.zeros(robot.muscle_count))


def test_a_muscle_under_tension_is_shorter_at_the_motor(robot):
    theta = robot.random_postures(5, np.random.default_rng(2))
    tension = np.full((5, robot.muscle_count), 100.0)
    loose = robot.muscle_lengths(theta, 0.0 * tension)
    assert (robot.muscle_lengths(theta, tension) < loose).all()


def test_a_batch_of_any_size_agrees_with_single_postures(robot, monkeypatch):
    theta = robot.random_postures(7, np.random.default_rng(3))
    single = [robot.routes.muscle_jacobian(row) for row in theta]
    lengths = [robot.routes.absolute_lengths(row) for row in theta]
    monkeypatch.setattr(routes, 'CHUNK', 3)
    np.testing.assert_allclose(robot.routes.muscle_jacobian(theta), single, atol=1e-15)
    np.testing.assert_allclose(robot.routes.absolute_lengths(theta), lengths, atol=1e-15)


def test_leading_axes_of_theta_are_kept(robot):
    theta = robot.random_postures(6, np.random.default_rng(4))
    folded = theta.reshape(2, 3, -1)
    for function in (
        robot.routes.absolute_lengths,
        robot.routes.muscle_jacobian,
        robot.kinematics.holding_torque,
    ):
        rows = function(theta)
        np.testing.assert_array_equal(function(folded), rows.reshape(2, 3, *rows.shape[1:]))


def test_an_empty_batch_gives_empty_arrays(robot):
    theta = np.zeros((0, robot.joint_count))
    shape = (0, robot.muscle_count, robot.joint_count)
    assert robot.routes.absolute_lengths(theta).shape == shape[:2]
    assert robot.routes.muscle_jacobian(theta).shape == shape


def test_a_flexor_shortens_when_its_joint_flexes():
    robot = Robot.load('arm26')
    jacobian = robot.routes.muscle_jacobian(np.array([0.0, -0.8]))
    flexor, elbow = robot.muscles.index('brachialis'), robot.joints.index('elbow')
    # The elbow flexes towards negative angles. Then l shortens, so G is positive, and the torque
    # −G T is negative.
    assert jacobian[flexor, elbow] > 0.0


def test_the_gradient_by_a_point_is_the_derivative_of_length(robot):
    routes, rng = robot.routes, np.random.default_rng(6)
    poses = robot.kinematics.tree.joint_poses(robot.random_postures(5, rng))
    point = routes.point + rng.normal(0.0, 1e-3, routes.point.shape)
    lengths, by_point = routes.moved(poses, point)
    moves = rng.normal(size=routes.point.shape)
    owner = np.zeros(len(point), dtype=int)
    owner[routes.first], owner[routes.second] = routes.muscle, routes.muscle
    ahead, behind = (routes.moved(poses, point + h * moves)[0] for h in (1e-7, -1e-7))
    expected = np.zeros_like(lengths)
    np.add.at(expected.T, owner, np.einsum('npj,pj->pn', by_point, moves))
    np.testing.assert_allclose((ahead - behind) / 2e-7, expected, atol=1e-6)
    theta = robot.random_postures(5, np.random.default_rng(6))
    at_rest = routes.moved(robot.kinematics.tree.joint_poses(theta), routes.point)[0]
    np.testing.assert_allclose(at_rest, routes.absolute_lengths(theta), atol=1e-12)
