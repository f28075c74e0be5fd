# SPDX-License-Identifier: Apache-2.0
"""False joint sensors are named; systematic offsets and changed muscles are not."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from musculoskeletal_ae.estimation.detectors.joint_sensor_trust import JointSensorTrust
from musculoskeletal_ae.experiments.detection import observe
from musculoskeletal_ae.signals.joint_trust_message import SensorTrust

DT = 0.5


class Arm:
    """A model arm in random postures, and the check of its joint sensors."""

    def __init__(self, robot, mae):
        self.robot, self.mae, self.time = robot, mae, 0.0
        self.check, self.rng = JointSensorTrust(robot), np.random.default_rng(0)
        self.check.use(mae)

    def go(self, seconds, read=lambda theta, _: theta, longer=0.0):
        """Move; `read` converts θ and the time since now [s] to the readings of the sensors."""
        begin = self.time
        while self.time < begin + seconds:
            self.time += DT
            theta = self.robot.random_postures(1, self.rng)[0]
            tension = self.robot.tension.bias + self.rng.uniform(10.0, 60.0, 6)
            length = self.robot.muscle_lengths(theta, tension) + longer
            observation = observe(self.mae, length, tension, tension, DT)
            joints = read(theta.copy(), self.time - begin)
            observation = replace(observation, joints=joints, now=self.time)
            self.check.step_healthy(observation, None)

    @property
    def doubted(self):
        return self.check.trust.doubted


@pytest.fixture(scope='module')
def learned_once(robot, calibrated):
    arm = Arm(robot, calibrated)
    arm.go(120.0, systematic)
    assert arm.doubted == ()
    return arm


@pytest.fixture
def arm(learned_once):
    """Return an arm that has moved for 2 min; its sensors have systematic offsets."""
    return deepcopy(learned_once)


def systematic(theta, _=0.0):
    return theta + np.array([0.05, -0.04])


def slip(size):
    return lambda theta, _: systematic(theta) + np.array([0.0, size])


@pytest.mark.parametrize('size', [0.1, -0.1, 0.5])
def test_a_sensor_that_slips_is_doubted_until_it_agrees_again(arm, size):
    begin = arm.time
    arm.go(30.0, slip(size))
    assert arm.doubted == (1,)
    trust = arm.check.trust
    assert trust.deviation[1] == pytest.approx(size, abs=0.05)
    assert abs(trust.since[1] - begin) < 4.0
    arm.go(30.0, systematic)
    assert arm.doubted == ()


def test_a_sensor_that_is_repaired_late_is_trusted_again_however_long_the_arm_moved(arm):
    for wrong in (arm.time, 400.0):  # as long as the arm had moved before, and much longer
        arm.go(wrong, slip(0.5))
        assert arm.doubted == (1,)
        arm.go(30.0, systematic)
        assert arm.doubted == ()


def test_a_sensor_that_is_repaired_while_the_lengths_are_calibrated_is_trusted_again(arm):
    arm.go(30.0, slip(0.5))
    arm.check.forget()
    arm.go(30.0, slip(0.5))
    assert arm.doubted == (1,)
    arm.go(30.0, systematic)
    assert arm.doubted == ()


def test_a_restarted_estimator_doubts_a_slipped_sensor_until_it_is_repaired(arm):
    arm.go(30.0, slip(0.5))
    restarted = Arm(arm.robot, arm.mae)
    restarted.check.begin_in_doubt(arm.check.doubts, 0.0)
    restarted.go(100.0, slip(0.5))
    assert restarted.doubted == (1,)
    restarted.go(30.0, systematic)
    assert restarted.doubted == ()


@pytest.mark.parametrize('rate', [0.005, 0.01])
def test_a_sensor_that_drifts_is_doubted(arm, rate):
    arm.go(40.0, lambda theta, t: systematic(theta) + np.array([rate * t, 0.0]))
    assert arm.doubted == (0,)


def test_a_network_that_has_learned_little_does_not_blame_a_sensor_for_a_small_error(robot, mae):
    arm = Arm(robot, mae)
    arm.go(120.0, systematic)
    arm.go(30.0, slip(0.3))
    assert arm.doubted == ()


def test_two_exchanged_sensors_are_both_doubted(arm):
    arm.go(10.0, lambda theta, _: systematic(theta)[::-1])
    assert arm.doubted == (0, 1)


def test_a_single_sensor_is_judged_as_well(robot, calibrated):
    arm = Arm(robot, calibrated)
    arm.go(120.0, lambda theta, _: np.array([np.nan, theta[1]]))
    arm.go(30.0, lambda theta, _: np.array([np.nan, theta[1] + 0.1]))
    assert arm.doubted == (1,)


@pytest.mark.parametrize(
    ('muscle', 'change'),
    [
        pytest.param(m, change, marks=[] if m % 3 == n else pytest.mark.thorough)
        for m in range(6)
        for n, change in enumerate((0.005, -0.02, 0.05))
    ],
)
def test_the_changed_length_of_a_muscle_is_not_blamed_on_a_sensor(arm, muscle, change):
    arm.go(30.0, systematic, longer=change * (np.arange(6) == muscle))
    assert arm.doubted == ()


def test_a_sensor_that_the_user_confirms_is_trusted_with_its_new_readings(arm):
    arm.go(20.0, slip(0.3))
    assert arm.check.confirm() == (1,)
    assert arm.check.trust.trust[1] is SensorTrust.CONFIRMED
    arm.go(60.0, slip(0.3))
    assert arm.doubted == ()


class TurnedMae:
    """A network whose second joint angle has another zero, as if it had learned another body."""

    def __init__(self, mae, turn):
        self._mae, self._turn = mae, np.array([0.0, turn])

    def __getattr__(self, name):
        return getattr(self._mae, name)

    def estimate(self, tension, length):
        estimate = self._mae.estimate(tension, length)
        return estimate._replace(theta=estimate.theta - self._turn)

    def lengths(self, theta, tension):
        return self._mae.lengths(theta + self._turn, tension)

    def muscle_jacobian(self, theta, tension):
        return self._mae.muscle_jacobian(theta + self._turn, tension)


def test_a_right_sensor_that_was_confirmed_is_not_doubted_while_the_network_learns_from_it(
    robot, mae
):
    arm = Arm(robot, TurnedMae(mae, 1.0))
    arm.go(10.0)
    assert arm.doubted == (1,)
    assert arm.check.confirm() == (1,)
    arm.go(20.0)
    assert arm.doubted == ()
    arm.mae = mae  # the network has learned
    arm.check.use(mae)
    arm.go(100.0)
    assert arm.doubted == ()
