# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pinocchio as pin
import pytest
from differences import slopes
from robots import JOINTS, write_robot

from musculoskeletal_ae.robot.robot import Robot


def full_configuration(robot: Robot, theta):
    """Return the configuration q of the whole URDF at θ, computed without the code under test."""
    model = robot.description.model
    q = pin.neutral(model)
    position = robot.units.to_position(theta)
    for name, value in zip(robot.joints, position, strict=True):
        q[model.joints[model.getJointId(name)].idx_q] = value
    return q


def test_batched_points_are_where_pinocchio_puts_them(robot):
    theta = robot.random_postures(20, np.random.default_rng(1))
    model = robot.description.model
    data = model.createData()
    points = robot.routes.points(theta)
    for row, placed in zip(theta, points, strict=True):
        pin.framesForwardKinematics(model, data, full_configuration(robot, row))
        expected = [
            data.oMf[model.getFrameId(point.link, pin.FrameType.BODY)].act(point.xyz)
            for route in robot.description.routes
            for point in route
        ]
        np.testing.assert_allclose(placed, expected, atol=1e-12)


def test_holding_torque_is_the_gradient_of_potential_energy(robot):
    model = robot.description.model
    data = model.createData()

    def energy(theta):
        return pin.computePotentialEnergy(model, data, full_configuration(robot, theta))

    for theta in robot.random_postures(5, np.random.default_rng(2)):
        gradient = slopes(energy, theta)
        np.testing.assert_allclose(robot.kinematics.holding_torque(theta), gradient, atol=1e-6)


def test_holding_gradient_is_the_derivative_of_the_holding_torque(robot):
    kin = robot.kinematics
    for theta in robot.random_postures(5, np.random.default_rng(8)):
        expected = slopes(kin.holding_torque, theta, 1e-5)
        np.testing.assert_allclose(kin.holding_gradient(theta), expected, atol=1e-7)
        # The gradient of a torque that has a potential, such as that of weight, is symmetric.
        np.testing.assert_allclose(expected, expected.T, atol=1e-7)


def test_holding_torques_of_a_batch_are_those_of_its_rows(robot):
    theta = robot.random_postures(3, np.random.default_rng(3))
    rows = [robot.kinematics.holding_torque(row) for row in theta]
    np.testing.assert_array_equal(robot.kinematics.holding_torque(theta), rows)


def test_a_forward_raised_arm_needs_a_flexing_torque():
    robot = Robot.load('arm26')
    torque = robot.kinematics.holding_torque(np.array([-np.pi / 4, -np.pi / 4]))
    assert (torque < 0.0).all()


def test_end_effector_jacobian_is_the_motion_of_its_pose_in_root_axes(robot):
    step = 1e-6
    for theta in robot.random_postures(5, np.random.default_rng(4)):
        columns = []
        for unit in np.eye(robot.joint_count):
            up = robot.kinematics.end_effector_pose(theta + step * unit)
            down = robot.kinematics.end_effector_pose(theta - step * unit)
            turn = pin.log3(up.rotation @ down.rotation.T)
            columns.append(np.r_[up.translation - down.translation, turn] / (2 * step))
        jacobian = robot.kinematics.end_effector_jacobian(theta)
        np.testing.assert_allclose(jacobian, np.array(columns).T, atol=1e-7)


def test_limits_follow_the_order_of_theta(robot):
    model = robot.description.model
    lower, upper = (robot.units.to_position(limit) for limit in (robot.lower, robot.upper))
    for k, name in enumerate(robot.joints):
        at = model.joints[model.getJointId(name)].idx_q
        assert lower[k] == model.lowerPositionLimit[at]
        assert upper[k] == model.upperPositionLimit[at]


def test_the_order_of_joints_permutes_and_changes_nothing_else(tmp_path):
    one = Robot.load(write_robot(tmp_path / 'a', joints=('lift', 'swing', 'bend')))
    two = Robot.load(write_robot(tmp_path / 'b', joints=('bend', 'lift', 'swing')))
    theta = one.random_postures(10, np.random.default_rng(5))
    turned = theta[:, [2, 0, 1]]
    np.testing.assert_allclose(
        one.routes.absolute_lengths(theta), two.routes.absolute_lengths(turned), atol=1e-14
    )
    np.testing.assert_allclose(
        one.kinematics.holding_torque(theta)[:, [2, 0, 1]],
        two.kinematics.holding_torque(turned),
        atol=1e-12,
    )


def test_an_unlisted_joint_is_locked_and_its_link_still_weighs(tmp_path):
    bare = Robot.load(write_robot(tmp_path / 'a'))
    fingered = Robot.load(write_robot(tmp_path / 'b', finger=True))
    assert fingered.joint_count == bare.joint_count
    theta = np.array([-1.0, 0.1, -0.5])
    extra = fingered.kinematics.holding_torque(theta) - bare.kinematics.holding_torque(theta)
    assert np.abs(extra).max() > 0.01


@pytest.mark.parametrize('joints', [JOINTS, ('bend',)])
def test_links_may_have_the_names_of_joints(tmp_path, joints):
    one, two = (write_robot(tmp_path / name, joints=joints) for name in 'ab')
    for old, new in {'pillar': 'mount', 'shoulder': 'lift', 'upper': 'swing'}.items():
        for file in two.iterdir():
            text = file.read_text().replace(f'"{old}"', f'"{new}"')
            file.write_text(text.replace(f'link: {old}', f'link: {new}'))
    one, two = Robot.load(one), Robot.load(two)
    theta = one.random_postures(10, np.random.default_rng(8))
    for ask in (lambda r: r.routes.absolute_lengths, lambda r: r.kinematics.holding_torque):
        np.testing.assert_array_equal(ask(one)(theta), ask(two)(theta))


@pytest.mark.parametrize('name', ['musashi_left_arm', 'arm26'])
def test_every_joint_of_a_shipped_arm_moves_enough_inertia_to_be_simulated(name):
    robot = Robot.load(name)
    theta = robot.random_postures(50, np.random.default_rng(6))
    assert min(robot.kinematics.joint_inertia(row).min() for row in theta) >= 2e-3


def test_joint_inertia_is_the_diagonal_of_the_mass_matrix(robot):
    model = robot.kinematics.model
    at = [model.joints[model.getJointId(name)].idx_v for name in robot.joints]
    for theta in robot.random_postures(3, np.random.default_rng(7)):
        q = np.empty(model.nq)
        q[at] = robot.units.to_position(theta)
        mass = np.diag(pin.crba(model, model.createData(), q))[at]
        inertia = robot.kinematics.joint_inertia(theta)
        np.testing.assert_allclose(robot.units.to_effort(robot.units.to_effort(inertia)), mass)


def test_musashi_reaches_the_postures_of_the_paper():
    robot = Robot.load('musashi_left_arm')
    pitch, elbow = robot.joints.index('shoulder_pitch'), robot.joints.index('elbow_pitch')
    assert robot.upper[pitch] >= np.deg2rad(30.0) - 1e-4
    assert robot.lower[elbow] <= np.deg2rad(-90.0) <= robot.upper[elbow]
