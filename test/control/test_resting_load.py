# SPDX-License-Identifier: Apache-2.0
"""A resting arm whose load changes says so, although it keeps its posture."""

import numpy as np
import pinocchio as pin
import pytest
from exact_mae import ExactMae

from musculoskeletal_ae.control.resting_load import RestingLoad
from musculoskeletal_ae.mae.residuals import TouchStatistics
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import TensionProgramme

DT = 0.05
ARM = Robot.load('musashi_left_arm')
POSTURE = ARM.random_postures(1, np.random.default_rng(3))[0]
DOWN = np.array([0.0, 0.0, -9.81])


class Resting:
    """An arm at rest at its target: its muscles hold it exactly there, whatever the load.

    `is_measured` says whether the residual torque of the healthy arm (1 N·m) has been measured.
    """

    def __init__(self, is_measured=True):
        self.mae = ExactMae(ARM)
        time = 120.0 if is_measured else 0.0
        self.mae.touch = TouchStatistics(self.mae.friction, np.ones(ARM.joint_count), time)
        self.check = RestingLoad(ARM)
        self.check.use(self.mae)

    def rest(self, turned=0.0, force=(0.0, 0.0, 0.0), error=0.0, seconds=5.0):
        """Rest, and return whether the check then reports another load.

        Args:
            turned: Angle by which the base is turned about the x axis [°].
            force: Force on the hand [N], in the axes of the root link.
            error: Torque by which the learned body is wrong in this posture [N·m].
            seconds: Time to rest [s].
        """
        kinematics, model = ARM.kinematics, pin.Model(ARM.kinematics.model)
        model.gravity.linear = pin.exp3(np.radians([turned, 0.0, 0.0])).T @ DOWN
        angles = kinematics.tree.angles(POSTURE)
        torque = pin.computeGeneralizedGravity(model, model.createData(), angles)
        torque = torque - kinematics.end_effector_jacobian(POSTURE)[:3].T @ force + error
        jacobian = self.mae.muscle_jacobian(POSTURE, np.full(ARM.muscle_count, 60.0))
        pull = TensionProgramme(jacobian, torque, 10.0, 400.0).nearest(60.0)
        for _ in range(round(seconds / DT)):
            self.check.step(POSTURE, POSTURE, pull, DT)
        return self.check.has_changed

    def move(self):
        """Begin the next motion."""
        self.check.step(None, POSTURE, None, DT)


@pytest.mark.parametrize('turned', [90.0, 180.0])
def test_a_base_turned_under_a_resting_arm_is_reported_although_the_arm_keeps_its_posture(turned):
    arm = Resting()
    assert not arm.rest()
    assert arm.rest(turned)
    assert 'N·m' in arm.check.text and 'base that has been turned' in arm.check.text
    assert not arm.rest()


def test_a_push_on_the_hand_is_another_load_until_the_next_motion():
    arm = Resting()
    assert not arm.rest() and arm.rest(force=-3.0 * DOWN)
    arm.move()
    assert not arm.check.has_changed


def test_a_changed_load_is_reported_for_as_long_as_it_remains():
    arm = Resting()
    assert not arm.rest() and arm.rest(180.0)
    assert arm.rest(180.0, seconds=90.0)


def test_a_payload_may_be_picked_up_and_put_down():
    arm = Resting()
    for mass in 0.0, 3.0:
        assert not arm.rest(force=mass * DOWN)
    arm.move()
    for mass in 3.0, 0.0:
        assert not arm.rest(force=mass * DOWN)


def test_an_error_of_the_learned_body_in_one_posture_is_no_changed_load():
    arm = Resting()
    for _ in range(3):
        assert not arm.rest(error=4.0)


def test_slow_changes_of_a_long_rest_are_no_changed_load():
    arm = Resting()
    for error in np.arange(0.0, 3.0, 0.1):
        assert not arm.rest(error=error)


@pytest.mark.parametrize('seconds', [2.0, 2.9, 5.0])
def test_another_network_neither_hides_nor_makes_a_changed_load(seconds):
    arm = Resting()
    assert not arm.rest(seconds=seconds)
    arm.check.use(arm.mae)
    assert not arm.rest(error=4.0)
    assert arm.rest(180.0, error=4.0)
    arm.check.use(arm.mae)
    assert arm.rest(180.0)


def test_a_network_that_has_not_measured_the_residual_torque_ends_the_report():
    arm = Resting()
    assert not arm.rest() and arm.rest(180.0)
    arm.mae.touch = None
    arm.check.use(arm.mae)
    assert not arm.rest(180.0)


def test_without_a_measured_residual_torque_no_changed_load_is_reported():
    arm = Resting(is_measured=False)
    assert not arm.rest() and not arm.rest(180.0)
