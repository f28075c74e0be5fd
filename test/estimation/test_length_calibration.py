# SPDX-License-Identifier: Apache-2.0
"""Length calibration of a body that the network describes exactly."""

import re
from functools import cache

import numpy as np
import pytest
from readings import reading

from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.estimation.lengths import length_calibration
from musculoskeletal_ae.estimation.lengths.length_calibration import (
    LARGEST_RESIDUAL,
    LengthCalibration,
)
from musculoskeletal_ae.estimation.lengths.length_moments import WINDOW
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension
from musculoskeletal_ae.signals.wiring import Wiring

DT = 0.025  # time between two messages [s]
OFFSET = np.array([0.06, -0.09, 0.12, -0.05, 0.1, -0.13])


def states(tension, length):
    return np.array([length, tension, np.full(len(length), 25.0)])


def swinging(robot, mae):
    """Return a function that computes θ, T and l by a network at time t [s] of a slow swing."""

    @cache
    def at(t):
        middle, half = 0.5 * (robot.lower + robot.upper), 0.4 * (robot.upper - robot.lower)
        theta = middle + half * np.sin(np.array([0.11, 0.17])[: len(middle)] * t + 0.5)
        tension = np.full(robot.muscle_count, robot.tension.bias)
        for _ in range(3):
            jacobian, torque = (
                mae.muscle_jacobian(theta, tension),
                robot.kinematics.holding_torque(theta),
            )
            tension = least_tension(
                jacobian, torque, robot.tension.bias, robot.tension.limit
            ).tension
        return theta, tension, mae.lengths(theta, tension)

    return at


@pytest.fixture
def seldom(monkeypatch):
    # Fits take much CPU time. Fitting less often saves it, and the calibration takes no longer.
    monkeypatch.setattr(length_calibration, 'FIT_INTERVAL', 35.0)


@pytest.fixture(scope='module')
def swing(robot, mae):
    return swinging(robot, mae)


@pytest.fixture
def moment(swing):
    return lambda t: [values.copy() for values in swing(t)]


def run(calibration, moment, seconds, sees, begin=0.0):
    for n in range(round(seconds / WINDOW)):
        theta, tension, length = moment(begin + n * WINDOW)
        for k in range(round(WINDOW / DT)):  # joint angles arrive with two of three messages
            calibration.step(tension, length + OFFSET, DT, theta if sees and k % 3 else None)
        if calibration.is_done:
            break
    return calibration


def test_length_offsets_are_found_with_joint_sensors(robot, mae, moment):
    calibration = run(LengthCalibration(robot, mae), moment, 40.0, sees=True)
    assert calibration.is_done and calibration.time < 30.0
    np.testing.assert_allclose(calibration.offsets.offset, OFFSET, atol=1e-3)


@pytest.mark.usefixtures('seldom')
def test_length_offsets_are_found_without_joint_sensors(robot, mae, moment):
    calibration = run(LengthCalibration(robot, mae), moment, 90.0, sees=False)
    assert calibration.is_done and calibration.time < 60.0
    np.testing.assert_allclose(calibration.offsets.offset, OFFSET, atol=3e-3)


def rewired(moment, wiring):
    """Return `moment` as a driver with this wiring publishes it."""

    def published(t):
        theta, tension, length = moment(t)
        into = list(wiring.order)
        return theta, tension[into], np.array(wiring.sign) * length[into]

    return published


STRAIGHT = Wiring.straight(6)


@pytest.mark.parametrize('wiring', [STRAIGHT.exchanged(0, 3), STRAIGHT.reversed(4)])
def test_a_wrong_order_or_sign_is_named_and_no_offsets_are_accepted(robot, mae, moment, wiring):
    calibration = run(LengthCalibration(robot, mae), rewired(moment, wiring), 40.0, sees=True)
    assert not calibration.is_done and not calibration.offsets.known
    assert calibration.wiring.wiring == wiring
    assert calibration.problem.startswith(wiring.text(robot.muscles))
    assert calibration.remedy == (Step.CORRECT_WIRING, Step.CALIBRATE_LENGTHS)


@pytest.mark.usefixtures('seldom')
def test_exchanged_muscles_are_named_without_joint_sensors(robot, mae, moment):
    wiring = STRAIGHT.exchanged(0, 3)
    calibration, begin = LengthCalibration(robot, mae), 0.0
    while not calibration.problem and begin < 120.0:
        run(calibration, rewired(moment, wiring), 5.0, sees=False, begin=begin)
        begin += 5.0
    assert not calibration.is_done
    assert calibration.wiring.wiring == wiring, calibration.problem


def test_length_offsets_are_found_from_a_stated_posture_if_the_arm_stands(robot, mae, moment):
    theta, *standing = moment(3.0)
    posture = tuple(theta.tolist())
    moved = run(LengthCalibration(robot, mae, posture), moment, 5.0, sees=False, begin=3.0)
    assert not moved.is_done and 'call estimator/zero again' in moved.progress
    calibration = run(
        LengthCalibration(robot, mae, posture), lambda _: (theta, *standing), 2.0, sees=False
    )
    assert calibration.is_done
    np.testing.assert_allclose(calibration.offsets.offset, OFFSET, atol=1e-3)


@pytest.mark.parametrize('is_standing', [True, False])
def test_an_offset_that_no_node_would_use_is_refused_with_its_muscle_and_the_remedy(
    robot, mae, moment, is_standing
):
    theta, tension, length = moment(3.0)
    far = length + 12.0 * (np.arange(6) == 4)
    posture = tuple(theta.tolist()) if is_standing else ()
    calibration = LengthCalibration(robot, mae, posture)
    calibration = run(calibration, lambda _: (theta, tension, far), 2.0, sees=True)
    assert not calibration.is_done and calibration.offsets is None
    problem = (
        rf'{robot.muscles[4]} has an offset of 12\.\d m; legal: .*10 m; .* estimator/zero again'
    )
    assert re.search(problem, calibration.problem)


def test_a_standing_arm_does_not_determine_the_length_offsets(robot, mae, moment):
    calibration = run(LengthCalibration(robot, mae), lambda _: moment(3.0), 3.0, sees=False)
    assert calibration.offsets is not None and not calibration.offsets.known
    assert f'0 of {length_calibration.ENOUGH:.0f} s of gentle motion' in calibration.progress


def test_a_posture_that_the_arm_cannot_have_is_refused(robot, mae):
    estimator = Estimator(robot)
    with pytest.raises(MusculoskeletalError, match='requires a checkpoint'):
        estimator.calibrate_lengths()
    estimator.use(mae)
    for posture in ((0.1,), tuple(robot.upper + 0.1)):
        with pytest.raises(MusculoskeletalError, match='legal'):
            estimator.calibrate_lengths(posture)
    assert estimator.body.offsets.known
    # Sensors of joints at their stops may read a little more than the limit. This is accepted.
    on_stop = tuple(robot.upper + 0.002)
    estimator.calibrate_lengths(on_stop)
    assert not estimator.body.offsets.known


def test_without_length_offsets_only_a_muscle_without_tension_is_an_anomaly(
    robot, calibrated, moment
):
    estimator = Estimator(robot)
    estimator.use(calibrated)
    estimator.calibrate_lengths()
    assert not estimator.body.offsets.known
    now, detected = 0.0, []
    for n in range(100):
        _, tension, length = moment(n * DT)
        now += DT
        estimator.commanded(now, length=length + OFFSET - estimator.body.offsets.offset)
        if n > 60:
            tension = tension * (np.arange(6) != 2)
        elif n == 60:
            assert 'calibrating the lengths' in str(estimator.report(now))
        estimator.take(reading(states(tension, length + OFFSET)), now, now)
        detected += [n] * estimator.body.has_anomaly
    assert detected and detected[0] > 76 and estimator.cause.startswith(robot.muscles[2])


@pytest.mark.parametrize('sees', [True, False])
def test_the_readings_of_an_isolated_muscle_do_not_disturb_the_length_calibration(
    monkeypatch, robot, mae, moment, sees
):
    # Begin only one fit, because fits without a muscle take longer.
    monkeypatch.setattr(length_calibration, 'FIRST_FIT', 19.0 if sees else 70.0)
    rng = np.random.default_rng(0)

    def disturbed(t):
        theta, tension, length = moment(t)
        tension[3], length[3] = rng.uniform(0.0, 300.0), rng.uniform(-5.0, 5.0)
        return theta, tension, length

    calibration = run(LengthCalibration(robot, mae.without((3,))), disturbed, 120.0, sees)
    assert calibration.is_done
    others = np.arange(6) != 3
    np.testing.assert_allclose(calibration.offsets.offset[others], OFFSET[others], atol=4e-3)


def test_an_isolated_muscle_gets_an_uncertain_length_offset(robot, mae, moment):
    theta, *standing = moment(3.0)
    calibration = LengthCalibration(robot, mae.without((3,)), tuple(theta.tolist()))
    calibration = run(calibration, lambda _: (theta, *standing), 2.0, sees=False)
    assert calibration.is_done
    off = np.abs(calibration.offsets.offset - OFFSET)
    assert off[3] < calibration.offsets.deviation[3] == LARGEST_RESIDUAL
    assert np.delete(off, 3).max() < 1e-3


@pytest.mark.filterwarnings('error::RuntimeWarning')
def test_length_calibration_of_an_arm_without_weight_stays_finite(mae):
    robot = Robot.load('arm26')
    # Without gravity, as in an arm whose joints all have vertical axes, weight carries no
    # information.
    robot.kinematics.model.gravity.linear = np.zeros(3)
    calibration = run(LengthCalibration(robot, mae), swinging(robot, mae), 6.0, sees=False)
    assert np.isfinite(calibration.offsets.offset).all()


def test_another_network_or_isolated_muscle_starts_the_length_calibration_again(robot, mae, moment):
    estimator = Estimator(robot)
    estimator.use(mae)
    estimator.calibrate_lengths()
    for now in np.arange(0.0, 4.0, 0.05):
        _, tension, length = moment(now)
        estimator.take(reading(states(tension, length + OFFSET)), now, now)
    reported = str(estimator.report(4.0))
    assert re.search('calibrating: [1-4] of', reported)
    estimator.isolate(())
    assert str(estimator.report(4.0)) == reported
    estimator.use(mae)  # any call of `use` counts as another network
    assert 'calibrating: 0 of' in str(estimator.report(4.0))
    for now in np.arange(4.0, 8.0, 0.05):
        _, tension, length = moment(now)
        estimator.take(reading(states(tension, length + OFFSET)), now, now)
    assert re.search('calibrating: [1-4] of', str(estimator.report(8.0)))
    estimator.isolate((3,))
    assert 'calibrating: 0 of' in str(estimator.report(8.0))


def test_lengths_that_no_posture_explains_call_for_joint_sensors_or_a_known_posture(
    robot, mae, moment, monkeypatch
):
    monkeypatch.setattr(length_calibration, 'ENOUGH', 4.0)
    monkeypatch.setattr(length_calibration, 'FIRST_FIT', 5.5)
    monkeypatch.setattr(length_calibration, 'LARGEST_RESIDUAL', 1.0)
    calibration = LengthCalibration(robot, mae)

    def reversed_signs(t):
        theta, tension, length = moment(t)
        return theta, tension, -length

    for begin in range(0, 30, 3):
        if not calibration.problem:
            run(calibration, reversed_signs, 3.0, sees=False, begin=float(begin))
    assert not calibration.is_done
    assert 'provide joint sensors; or set zero_posture, hold the arm' in calibration.progress


@pytest.mark.parametrize('dt', [0.005, 0.02, 0.05])
def test_the_first_estimate_takes_about_as_long_at_any_rate_of_the_messages(robot, mae, moment, dt):
    calibration, count = LengthCalibration(robot, mae), 0
    _, tension, length = moment(0.0)
    while calibration.offsets is None and count * dt < 5.0:
        calibration.step(tension, length + OFFSET, dt)
        count += 1
    assert 0.5 <= count * dt < 3.0
