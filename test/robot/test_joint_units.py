# SPDX-License-Identifier: Apache-2.0
"""Files, messages and texts state prismatic joints in metres and newtons; θ is in rad inside."""

import numpy as np
import pytest
from robots import write_robot

from musculoskeletal_ae.emulator.faults import ArmReadings, Faults
from musculoskeletal_ae.estimation.lengths.length_calibration import stated_theta
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.joint_sensors import ORDER, JointFault, corrected
from musculoskeletal_ae.signals.muscle_states import MuscleReadings

WRIST = 3  # index of the prismatic joint in θ; its limits are 0 and 0.05 m
POLYNOMIAL = [0.1, 20.0, -3.0]  # of the position of `finger`, for the position of `wrist` [m]


@pytest.fixture(scope='module')
def robot(tmp_path_factory) -> Robot:
    """Return an arm whose prismatic joint has a spring, and moves a coupled joint."""
    springs = [
        {'joint': 'wrist', 'stiffness': 300.0, 'rest_angle': 0.02, 'damping': 5.0},
    ]
    coupling = {'joint': 'finger', 'master': 'wrist', 'polynomial': POLYNOMIAL}
    folder = tmp_path_factory.mktemp('slider')
    return Robot.load(
        write_robot(
            folder, slider=True, finger=True, joint_elasticity=springs, couplings=[coupling]
        )
    )


def test_60_mm_of_a_prismatic_joint_are_one_radian(robot):
    assert robot.upper[WRIST] == pytest.approx(0.05 / 0.06)
    assert robot.posture_text(robot.upper).endswith('wrist 0.05 m')
    assert robot.units[WRIST].torque_text(0.6) == '10.00 N'
    assert robot.units[WRIST].stiffness_text(0.36) == '100.00 N/m'
    assert robot.units[0].torque_text(0.6) == '0.60 N·m'


def test_errors_of_revolute_and_prismatic_joints_are_two_numbers(robot):
    off = np.zeros((2, robot.joint_count))
    off[:, 0], off[:, WRIST] = 0.02, [0.1, np.nan]
    assert robot.units.error_text(off) == '0.0200 rad and 6.00 mm'
    assert robot.units.error_text(np.full((2, robot.joint_count), np.nan)) == ''


def test_a_joint_follows_a_prismatic_joint_by_its_position_in_metres(robot):
    tree = robot.kinematics.tree
    for share in (0.0, 0.3, 1.0):
        theta = robot.lower + share * (robot.upper - robot.lower)
        position = dict(zip(robot.kinematics.model.names[1:], tree.angles(theta), strict=True))
        assert position['wrist'] == pytest.approx(0.05 * share)
        expected = np.polynomial.Polynomial(POLYNOMIAL)(0.05 * share)
        assert position['finger'] == pytest.approx(expected)


def test_springs_of_prismatic_joints_are_stated_in_newtons_per_metre(robot):
    assert 'wrist: spring of 300 N/m, at rest at 0.02 m' in robot.description.notes
    theta = robot.units.to_theta(np.array([-1.0, 0.0, 0.0, 0.03]))
    springs = robot.kinematics.elasticity
    assert robot.units.to_effort(springs.holding_torque(theta))[WRIST] == pytest.approx(3.0)
    outside = robot.units.elasticity_outside(springs)
    assert outside.damping[WRIST] == pytest.approx(5.0)


def test_variances_of_prismatic_joints_are_published_in_square_metres(robot):
    variance = robot.units.covariance_of_positions(np.diag([1.0, 1.0, 1.0, 1.0]))
    np.testing.assert_allclose(np.diag(variance), [1.0, 1.0, 1.0, 0.0036])


def test_a_stated_posture_is_in_metres_and_so_are_its_legal_limits(robot):
    theta = stated_theta(robot, (-1.0, 0.0, 0.0, 0.03))
    np.testing.assert_allclose(theta, [-1.0, 0.0, 0.0, 0.5])
    for posture in ((-1.0, 0.0, 0.0, 0.3), (0.0,)):
        with pytest.raises(MusculoskeletalError, match=r', 0 to 0\.05 m$'):
            stated_theta(robot, posture)


def test_faults_of_the_sensor_of_a_prismatic_joint_are_in_metres(robot):
    nothing = np.zeros(robot.muscle_count)
    faults = Faults(robot, np.random.default_rng(0))
    faults.set(['bias:theta:wrist:0.006', 'bias:theta:bend:0.2'])
    read = faults.apply(ArmReadings(np.zeros(4), MuscleReadings(length=nothing))).theta
    np.testing.assert_allclose(read, [0.2, 0.0, 0.0, 0.1])


def test_exchanged_sensors_publish_the_positions_of_each_other(robot):
    fault = JointFault(ORDER, (0, WRIST))
    theta = corrected(np.array([[0.03, 0.0, 0.0, 1.0]]), [fault], robot.units)
    np.testing.assert_allclose(theta, [[0.06, 0.0, 0.0, 0.5]])
