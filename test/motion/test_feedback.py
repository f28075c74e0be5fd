# SPDX-License-Identifier: Apache-2.0
"""At rest, the controller corrects the posture and reduces unnecessary tension."""

import numpy as np
import pytest
from exact_mae import ExactMae
from robots import write_robot

from musculoskeletal_ae.control.settings import Settings, Setup
from musculoskeletal_ae.motion.activities import Inputs
from musculoskeletal_ae.motion.feedback import (
    CORRECTION,
    DEADBAND,
    RELIEF_INTERVAL,
    SETTLING,
    Feedback,
)
from musculoskeletal_ae.robot.actuation import RELIEF
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension

DT = 0.01
GAIN = 0.5


@pytest.fixture(scope='module')
def robot():
    return Robot.load('arm26')


def rested(robot):
    """Return the feedback of an arm that has just settled, without a correction so far."""
    feedback = Feedback(Setup(robot, Settings()))
    while not feedback.correction.any():
        step(feedback, robot, np.ones(robot.joint_count), holding(robot))
    feedback.reset()
    return feedback


def jacobian(robot):
    return robot.routes.muscle_jacobian(0.5 * (robot.lower + robot.upper))


def holding(robot, desired=0.0):
    return holding_tension(robot, 0.5 * (robot.lower + robot.upper), desired)


def step(feedback, robot, error, tension, gain=GAIN, motor=None, dt=DT, mae=None):
    limit = np.full(robot.muscle_count, robot.tension.limit)
    nothing = np.zeros(robot.muscle_count)
    inputs = Inputs(
        mae=mae or ExactMae(robot),
        sample=None,
        motor_tension=tension if motor is None else motor,
        bone_tension=tension,
        theta=np.zeros(robot.joint_count),
        length=nothing,
        tension=nothing,
        limit=limit,
        target=None,
        effort=nothing,
        dt=dt,
    )
    feedback.at_rest(error, jacobian(robot), inputs, gain)


def test_feedback_waits_until_the_arm_has_settled(robot):
    feedback = Feedback(Setup(robot, Settings()))
    error = np.full(robot.joint_count, 0.1)
    steps = 0
    while not feedback.correction.any():
        step(feedback, robot, error, holding(robot))
        steps += 1
    assert steps * DT == pytest.approx(SETTLING, abs=2 * DT)


def test_the_least_tension_is_not_relieved(robot):
    feedback = rested(robot)
    step(feedback, robot, np.zeros(robot.joint_count), holding(robot))
    assert feedback.relief == pytest.approx(np.zeros(robot.muscle_count), abs=1e-9)


def test_relief_pays_out_antagonists_and_exerts_no_torque(robot):
    feedback = rested(robot)
    needless = holding(robot, desired=90.0)
    before, steps = feedback.relief, 0
    while (feedback.relief == before).all():
        step(feedback, robot, np.zeros(robot.joint_count), needless)
        steps += 1
    assert steps * DT <= RELIEF_INTERVAL + 2 * DT
    change = feedback.relief - before
    # The relief covers one more step than this loop counted: the last step of `rested`, in which
    # the arm was at rest already.
    expected = GAIN * (steps + 1) * DT * (needless - holding(robot)) / robot.stiffness
    assert change == pytest.approx(expected, abs=1e-9)
    assert jacobian(robot).T @ change == pytest.approx(np.zeros(robot.joint_count), abs=1e-9)
    assert change @ needless > 0.0


@pytest.mark.parametrize('wound', [0.2, -0.2])
def test_tension_that_friction_keeps_in_a_tendon_after_winding_in_is_paid_out(robot, wound):
    feedback = rested(robot)
    least = holding(robot)
    motor = least * np.exp(wound)
    for _ in range(20):
        step(feedback, robot, np.zeros(robot.joint_count), least, motor=motor)
    if wound < 0.0:  # after paying out, a correction would have to wind in, and is not made
        assert feedback.relief == pytest.approx(np.zeros(robot.muscle_count), abs=1e-9)
    else:
        assert (feedback.relief > 0.0).all()
        shares = feedback.relief / (motor - least)
        assert shares == pytest.approx(np.full(robot.muscle_count, shares[0]))


def test_correction_and_relief_are_bounded_and_a_reset_clears_them(robot):
    feedback = rested(robot)
    error = np.full(robot.joint_count, 1.0)
    tension = holding(robot, desired=150.0)
    for _ in range(300):
        step(feedback, robot, error, tension, dt=0.1)
    assert np.abs(feedback.correction).max() == pytest.approx(CORRECTION)
    assert np.abs(feedback.relief).max() == pytest.approx(RELIEF)
    feedback.reset()
    assert not feedback.correction.any()
    assert not feedback.relief.any()


def test_errors_within_the_dead_band_are_not_corrected(robot):
    feedback = rested(robot)
    error = np.full(robot.joint_count, 0.9 * DEADBAND)
    step(feedback, robot, error, holding(robot))
    assert not feedback.correction.any()
    step(feedback, robot, 2.0 * error, holding(robot))
    assert feedback.correction == pytest.approx(GAIN * DT * 2.0 * error)


def test_errors_below_the_standard_deviation_of_the_estimate_are_not_corrected(robot):
    feedback, mae = rested(robot), ExactMae(robot)
    deviation = np.array([3.0 * DEADBAND, 0.5 * DEADBAND])
    mae.covariance = np.diag(deviation**2)
    error = np.full(robot.joint_count, 2.0 * DEADBAND)
    step(feedback, robot, error, holding(robot), mae=mae)
    assert feedback.correction == pytest.approx(GAIN * DT * error * [0.0, 1.0])


def test_60_mm_of_a_prismatic_joint_count_as_one_radian(tmp_path):
    robot = Robot.load(write_robot(tmp_path, slider=True))
    feedback, units = rested(robot), robot.units
    step(feedback, robot, units.to_theta(np.array([0.0, 0.0, 0.0, 0.0017])), holding(robot))
    assert not feedback.correction.any()
    tension = holding(robot)
    for _ in range(300):
        step(feedback, robot, np.ones(robot.joint_count), tension, dt=0.1)
    correction = units.to_position(feedback.correction)
    assert correction == pytest.approx(CORRECTION * np.array([1.0, 1.0, 1.0, 0.06]))


def test_without_gain_nothing_is_corrected(robot):
    feedback = Feedback(Setup(robot, Settings()))
    for _ in range(200):
        step(feedback, robot, np.ones(robot.joint_count), holding(robot), gain=0.0)
    assert not feedback.correction.any()
