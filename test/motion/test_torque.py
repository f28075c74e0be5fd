# SPDX-License-Identifier: Apache-2.0
"""Torque control is exact with an exact network, and reports the torque that muscles lack."""

import numpy as np
import pytest
from control_bench import inputs
from exact_mae import ExactMae
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import write_robot

from musculoskeletal_ae.control.settings import Settings, Setup
from musculoskeletal_ae.motion.torque import (
    BAND,
    HOLD,
    POSITION_GAIN,
    WALL_AT,
    GravityCompensation,
    TorqueControl,
)
from musculoskeletal_ae.robot.robot import Robot

ROBOT = Robot.load('musashi_left_arm')
MAE = ExactMae(ROBOT)
THETA = np.array([0.1, -0.4, 0.2, -1.0, 0.1])
LIMIT = np.full(ROBOT.muscle_count, 200.0)
DT = 0.01


def settled(control, target=THETA, effort=None, theta=THETA, limit=LIMIT):
    effort = np.zeros(5) if effort is None else effort
    wanted = inputs(MAE, theta, limit, ROBOT)._replace(target=target, effort=effort)
    for _ in range(50):
        command = control.step(wanted)
    return command.value


def torque_of(tension):
    return -MAE.muscle_jacobian(THETA, tension).T @ tension


@settings(max_examples=15)
@given(st.lists(st.floats(-1.0, 1.0), min_size=5, max_size=5))
def test_weight_and_effort_appear_at_the_joints(effort):
    tension = settled(TorqueControl(Setup(ROBOT, Settings())), effort=np.array(effort))
    wanted = ROBOT.kinematics.holding_torque(THETA) + effort
    np.testing.assert_allclose(torque_of(tension), wanted, atol=0.1 * np.linalg.norm(wanted))


def test_the_position_gain_exerts_torque_towards_the_target():
    control = TorqueControl(Setup(ROBOT, Settings()))
    offset = np.array([0.1, -0.1, 0.1, 0.1, -0.1])
    extra = torque_of(settled(control, THETA + offset)) - ROBOT.kinematics.holding_torque(THETA)
    np.testing.assert_allclose(extra, POSITION_GAIN * offset, atol=0.2)


@pytest.mark.parametrize('control', [TorqueControl, GravityCompensation])
def test_a_prismatic_joint_is_held_as_by_a_pinion(control, tmp_path):
    robot = Robot.load(write_robot(tmp_path, slider=True))
    mae, middle = ExactMae(robot), 0.5 * (robot.lower + robot.upper)

    def torque(theta):
        held = control(Setup(robot, Settings()))
        there, here = (inputs(mae, each, robot.tension.limit, robot) for each in (middle, theta))
        held.enter(there)
        held.step(there._replace(target=middle))
        for _ in range(300):
            tension = held.step(here._replace(target=middle)).value
        return -mae.muscle_jacobian(theta, tension).T @ tension

    theta = middle - robot.units.to_theta(np.array([0.02, 0.02, 0.02, 0.0012]))
    extra = torque(theta) - robot.kinematics.holding_torque(theta)
    force = robot.units.to_effort(extra)[-1]
    np.testing.assert_allclose([*extra[:3], 0.06 * force], extra[0], atol=0.1)
    assert extra[0] > 0.1


def test_tensions_change_no_faster_than_the_rate_limit_allows():
    control = TorqueControl(Setup(ROBOT, Settings(rate_limit=0.05)))
    before = np.full(ROBOT.muscle_count, 150.0)
    control.enter(inputs(MAE, THETA, LIMIT, ROBOT, tension=before))
    for _ in range(50):
        now = inputs(MAE, THETA, LIMIT, ROBOT)._replace(target=THETA)
        tension = control.step(now).value
        assert np.abs(tension - before).max() <= ROBOT.stiffness[0] * 0.05 * DT + 1e-9
        before = tension


def test_torque_beyond_the_muscles_is_reported():
    control = TorqueControl(Setup(ROBOT, Settings()))
    tension = settled(control, effort=np.array([0.0, 90.0, 0.0, 0.0, 0.0]))
    assert (tension <= 200.0 + 1e-6).all()
    assert control.missing_torque[1] == pytest.approx(90.0, abs=60.0)
    assert control.missing_torque[1] > 10.0


def carried(control, theta):
    """Return the torque that the arm exerts at θ in addition to gravity compensation [N·m]."""
    tension = settled(control, target=theta, theta=theta)
    pulled = -MAE.muscle_jacobian(theta, tension).T @ tension
    return pulled - ROBOT.kinematics.holding_torque(theta)


def test_gravity_compensation_carries_the_weight_and_no_more():
    np.testing.assert_allclose(
        carried(GravityCompensation(Setup(ROBOT, Settings())), THETA), 0.0, atol=0.1
    )


@pytest.mark.parametrize('way', [1.0, -1.0])
def test_gravity_compensation_resists_a_motion_by_its_band_at_most(way):
    control = GravityCompensation(Setup(ROBOT, Settings()))
    carried(control, THETA)
    little = carried(control, THETA + way * 0.5 * BAND)
    np.testing.assert_allclose(little, -way * 0.5 * BAND * HOLD, atol=0.15)
    far = carried(control, THETA + way * 0.2)
    np.testing.assert_allclose(far, -way * BAND * HOLD, atol=0.15)
    np.testing.assert_allclose(control.held, THETA + way * (0.2 - BAND), atol=1e-3)


def test_gravity_compensation_pushes_back_from_the_joint_limits():
    theta = THETA.copy()
    theta[3] = ROBOT.lower[3]
    pushed = carried(GravityCompensation(Setup(ROBOT, Settings())), theta)
    assert pushed[3] > 10.0 * WALL_AT
    np.testing.assert_allclose(np.delete(pushed, 3), 0.0, atol=0.15)
