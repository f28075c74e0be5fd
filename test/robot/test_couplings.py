# SPDX-License-Identifier: Apache-2.0
"""Coupled joints, several end effectors, and values of single muscles."""

import re

import numpy as np
import pinocchio as pin
import pytest
from differences import slopes
from nominal_body import nominal_arm
from robots import read_muscles, write_muscles, write_robot

from musculoskeletal_ae.design.checks import check_robot
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.stiffness import muscle_hessian
from musculoskeletal_ae.simulation.load import LoadTree

ANGLES = np.array([-0.5, 0.1, 0.2])  # angles of bend, lift and swing [rad]
COUPLED = {'joint': 'finger', 'master': 'bend', 'ratio': -0.5, 'offset': 0.2}


def coupled_arm(directory, **top):
    write_robot(directory, finger=True, **top)
    document = read_muscles(directory)
    document['muscles'][4]['route'].append({'link': 'fingertip', 'xyz': [0.02, 0.01, 0.0]})
    return write_muscles(directory, document)


CURVED = {'joint': 'finger', 'master': 'bend', 'polynomial': [0.2, -0.5, 0.1, 0.2, -0.05]}


@pytest.fixture(scope='module', params=[COUPLED, CURVED], ids=['line', 'curve'])
def robot(tmp_path_factory, request):
    return Robot.load(coupled_arm(tmp_path_factory.mktemp('coupled'), couplings=[request.param]))


def energy(robot, theta):
    kin = robot.kinematics
    return pin.computePotentialEnergy(kin.model, kin.data, kin.tree.angles(theta))


def test_quantities_of_coupled_joints_are_derivatives_with_respect_to_theta(robot):
    kin = robot.kinematics
    assert robot.joints == ('bend', 'lift', 'swing')
    for theta in robot.random_postures(4, np.random.default_rng(0)):
        assert kin.tree.angles(theta).shape == (4,)
        gravity = slopes(lambda t: energy(robot, t), theta)
        np.testing.assert_allclose(kin.holding_torque(theta), gravity, atol=1e-6)
        gradient = slopes(kin.holding_torque, theta)
        np.testing.assert_allclose(kin.holding_gradient(theta), gradient, atol=1e-5)
        load, load_slope = LoadTree.of(kin).load(theta[None])
        np.testing.assert_allclose(load[0], kin.holding_torque(theta), atol=1e-9)
        np.testing.assert_allclose(load_slope[0], gradient, atol=1e-5)
        lengths = slopes(robot.routes.absolute_lengths, theta)
        np.testing.assert_allclose(robot.routes.muscle_jacobian(theta), lengths, atol=1e-7)
        inertia = pin.crba(kin.model, kin.data, kin.tree.angles(theta))
        gear = kin.tree.transmission(theta)
        whole = gear.T @ (np.triu(inertia) + np.triu(inertia, 1).T) @ gear
        np.testing.assert_allclose(kin.joint_inertia(theta), np.diag(whole))


def test_no_postures_have_no_moment_arms(robot):
    """Learning computes moment arms only of changed postures, and perhaps none has changed."""
    nothing = np.zeros((0, 3))
    assert robot.routes.muscle_jacobian(nothing).shape == (0, 8, 3)
    assert muscle_hessian(robot.routes.muscle_jacobian, nothing).shape == (0, 8, 3, 3)


def test_a_motion_over_a_curved_coupling_takes_the_work_that_its_energy_gains(robot):
    kin, rng = robot.kinematics, np.random.default_rng(1)
    theta, velocity, acceleration = rng.uniform(-0.5, 0.5, (3, robot.joint_count))

    def total(time):
        at = theta + velocity * time + 0.5 * acceleration * time**2
        rate = kin.tree.ratios(at) * (velocity + acceleration * time)[kin.tree.theta_index[1:]]
        kinetic = pin.computeKineticEnergy(kin.model, kin.data, kin.tree.angles(at), rate)
        return kinetic + energy(robot, at)

    power = (total(1e-5) - total(-1e-5)) / 2e-5
    assert kin.inverse_dynamics(theta, velocity, acceleration) @ velocity == pytest.approx(
        power, 1e-6
    )


def test_a_muscle_at_a_coupled_joint_crosses_its_master(tmp_path):
    coupled_arm(tmp_path, couplings=[COUPLED])
    document = read_muscles(tmp_path)
    route = [
        {'link': 'lower', 'xyz': [0.0, 0.02, -0.2]},
        {'link': 'fingertip', 'xyz': [0.02, 0, 0]},
    ]
    document['muscles'].append({'name': 'closer', 'route': route})
    robot = Robot.load(write_muscles(tmp_path, document))
    theta = robot.random_postures(5, np.random.default_rng(0))
    moves = np.abs(robot.routes.muscle_jacobian(theta)).max(axis=0) > 1e-9
    np.testing.assert_array_equal(robot.routes.crossed[-1], moves[-1])
    assert robot.routes.crossed[-1].tolist() == [True, False, False]


def test_the_emulated_joint_follows_its_master(robot):
    arm = nominal_arm(robot)
    before = arm.theta
    arm.command_length(arm.sense().muscles.length - 0.01)
    arm.step(0.4)
    assert np.abs(arm.theta - before).max() > 0.01
    # A muscle is attached to the link that the coupled joint moves, so its via points show whether
    # the joint follows.
    np.testing.assert_allclose(
        arm.route_points(), robot.routes.points(arm.theta[None])[0], atol=1e-9
    )


MIMIC = '<mimic joint="bend" multiplier="-0.5" offset="0.2"/><axis xyz="0 0 1"/>'


def test_a_urdf_mimic_is_followed_and_joints_held_fixed_are_named(tmp_path):
    robot = Robot.load(coupled_arm(tmp_path / 'listed', couplings=[COUPLED]))
    coupled_arm(tmp_path)
    plain = Robot.load(tmp_path)
    assert plain.description.held_joints == ('finger',)
    assert plain.description.notes == ['held fixed at 0: finger']
    urdf = tmp_path / 'robot.urdf'
    urdf.write_text(urdf.read_text().replace('<axis xyz="0 0 1"/>', MIMIC))
    mimic = Robot.load(tmp_path)
    assert mimic.description.notes == ['finger = -0.5 · bend +0.2']
    theta = mimic.random_postures(5, np.random.default_rng(0))
    expected = robot.routes.absolute_lengths(theta)
    np.testing.assert_array_equal(mimic.routes.absolute_lengths(theta), expected)


def test_a_mimic_is_followed_in_a_default_namespace_and_wheels_elsewhere_are_held(tmp_path):
    urdf = coupled_arm(tmp_path) / 'robot.urdf'
    wheels = ''.join(
        f'<link name="{name}"/><joint name="{name}" type="continuous"><parent link="base"/>'
        f'<child link="{name}"/>{mimic}</joint>'
        for name, mimic in {'left': '', 'right': '<mimic joint="left"/>'}.items()
    )
    text = urdf.read_text().replace('<axis xyz="0 0 1"/>', MIMIC).replace('</robot>', wheels)
    urdf.write_text(text.replace('<robot', '<robot xmlns="http://any"') + '</robot>')
    notes = Robot.load(tmp_path).description.notes
    assert notes == ['finger = -0.5 · bend +0.2', 'held fixed at 0: left, right']


@pytest.mark.parametrize(
    ('couplings', 'expected'),
    [
        ([COUPLED, {'joint': 'bend', 'master': 'finger'}], 'follows itself'),
        ([{'joint': 'finger', 'master': 'toe'}], "unknown joint 'toe'"),
        ([{**COUPLED, 'ratio': 'x'}], r'couplings\[0\].ratio: expected float, got str'),
        ([COUPLED | CURVED], 'expected polynomial, or ratio and offset, got both'),
        ([{**CURVED, 'polynomial': []}], r'couplings\[0\].polynomial: '),
    ],
)
def test_a_wrong_coupling_is_refused(tmp_path, couplings, expected):
    directory = coupled_arm(tmp_path, joints=['lift', 'swing'], couplings=couplings)
    with pytest.raises(RobotDescriptionError, match=expected):
        Robot.load(directory)


@pytest.mark.parametrize('limit', ['', '<limit lower="0" upper="0" effort="0" velocity="0"/>'])
def test_a_continuous_joint_may_mimic_a_listed_one_since_it_needs_no_limits(tmp_path, limit):
    urdf = coupled_arm(tmp_path) / 'robot.urdf'
    mimic = 'type="continuous"><axis xyz="0 0 1"/><mimic joint="bend" multiplier="2"/>' + limit
    joint, rest = urdf.read_text().split('<joint name="finger" type="revolute">')
    rest = re.sub(r'<axis.*?<limit.*?/>', '', rest, count=1, flags=re.DOTALL)
    urdf.write_text(f'{joint}<joint name="finger" {mimic}{rest}')
    robot = Robot.load(tmp_path)
    assert robot.description.notes == ['finger = 2 · bend']
    angles = dict(zip(robot.kinematics.model.names[1:], robot.kinematics.tree.angles(ANGLES)))
    assert angles['finger'] == 2.0 * angles['bend']


@pytest.mark.parametrize('master', ['wrist', 'toe'])
def test_a_mimic_of_a_fixed_joint_is_refused_with_the_names_of_urdf_and_joint(tmp_path, master):
    urdf = coupled_arm(tmp_path) / 'robot.urdf'
    mimic = f'<axis xyz="0 0 1"/><mimic joint="{master}"/>'
    urdf.write_text(urdf.read_text().replace('<axis xyz="0 0 1"/>', mimic))
    with pytest.raises(RobotDescriptionError) as error:
        Robot.load(tmp_path)
    assert f"{urdf}: joint 'finger': mimic: unknown joint '{master}'" in str(error.value)
    assert 'muscles.yaml' not in str(error.value)


def test_a_joint_that_is_listed_as_free_follows_none(tmp_path):
    directory = coupled_arm(tmp_path, couplings=[{'joint': 'bend', 'master': 'lift'}])
    with pytest.raises(RobotDescriptionError, match="joint 'bend' follows 'lift'"):
        Robot.load(directory)


def test_several_end_effectors_are_drawn_and_the_first_one_used(tmp_path):
    write_robot(tmp_path, end_effectors=['lower', 'tool'])
    document = read_muscles(tmp_path)
    with pytest.raises(RobotDescriptionError, match='got both'):
        Robot.load(tmp_path)
    del document['end_effector']
    robot = Robot.load(write_muscles(tmp_path, document))
    assert robot.description.end_effectors == ('lower', 'tool')
    assert robot.description.end_effector == 'lower'


def test_a_muscle_has_a_tension_and_stiffness_of_its_own(tmp_path):
    write_robot(tmp_path, tension={'limit': 300.0})
    document = read_muscles(tmp_path)
    document['muscles'][1] |= {'tension': {'bias': 10.0, 'max': 350.0}, 'stiffness': 5000.0}
    robot = Robot.load(write_muscles(tmp_path, document))
    assert robot.tension.bias[:3].tolist() == [30.0, 10.0, 30.0]
    assert robot.tension.limit[:3].tolist() == [300.0, 300.0, 300.0]
    assert robot.tension.max[:3].tolist() == [500.0, 350.0, 500.0]
    assert robot.stiffness[:3].tolist() == [10000.0, 5000.0, 10000.0]
    check = check_robot(robot, 20)
    assert np.nanmin(check.tension[:, 1]) >= 10.0 - 1e-6
    document['muscles'][1]['tension'] = {'bias': 400.0}
    with pytest.raises(RobotDescriptionError, match=r"'pull_front_in': .*tension: expected bias"):
        Robot.load(write_muscles(tmp_path, document))


def test_a_via_point_that_is_listed_twice_is_accepted_with_a_warning(tmp_path):
    write_robot(tmp_path)
    document = read_muscles(tmp_path)
    route = document['muscles'][0]['route']
    before = Robot.load(tmp_path)
    route.insert(1, dict(route[0]))
    robot = Robot.load(write_muscles(tmp_path, document))
    (warning,) = robot.description.warnings
    assert 'route[1] is the same point' in warning
    theta = robot.random_postures(3, np.random.default_rng(0))
    expected = before.routes.absolute_lengths(theta)
    np.testing.assert_array_equal(robot.routes.absolute_lengths(theta), expected)


WRAP = {'wrap': 'cylinder', 'link': 'upper', 'xyz': [0, 0, 0], 'axis': [0, 0, 1], 'radius': 0.02}


@pytest.mark.parametrize(
    ('place', 'change', 'expected'),
    [
        (0, {}, 'a point before and after each wrap'),
        (1, {'wrap': 'cone'}, "one of cylinder, pulley, sphere, got 'cone'"),
        (1, {'radius': 0.0}, '> 0'),
        (1, {'side': [0, 0, 1]}, 'beside the axis'),
    ],
)
def test_a_wrong_wrap_is_refused(tmp_path, place, change, expected):
    document = read_muscles(write_robot(tmp_path))
    document['muscles'][0]['route'].insert(place, WRAP | change)
    with pytest.raises(RobotDescriptionError, match=expected):
        Robot.load(write_muscles(tmp_path, document))
