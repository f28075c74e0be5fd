# SPDX-License-Identifier: Apache-2.0
"""Lengths that contradict the joint sensors are reported, and false joint sensors are not."""

from types import SimpleNamespace

import numpy as np
import pytest
from exact_mae import ExactMae

from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.detectors.length_disagreement import LengthDisagreement
from musculoskeletal_ae.robot.robot import Robot

ARM = Robot.load('musashi_left_arm')
TENSION = np.full(ARM.muscle_count, 30.0)


def findings(theta, length_error, joint_error):
    """Return what the detector reports in 4 s in which an arm stands in a posture."""
    mae = ExactMae(ARM)
    mae.isolated, mae.is_calibrated = (), True
    detector, rng = LengthDisagreement(ARM), np.random.default_rng(0)
    detector.use(mae)
    length = mae.lengths(theta, TENSION) + length_error + rng.normal(0.0, 0.002, len(TENSION))
    sample = SimpleNamespace(length=length, bone_tension=TENSION, motor_tension=TENSION)
    message = SimpleNamespace(
        sample=sample, measured=theta + joint_error, dt=0.1, lengths_known=True
    )
    return [found for found in (detector.step(message) for _ in range(40)) if found is not None]


@pytest.mark.parametrize('muscle', range(ARM.muscle_count))
def test_one_wrong_length_is_reported_in_every_posture(muscle):
    # In some postures, an error of a joint sensor could explain most of the change of a length.
    for theta in ARM.random_postures(15, np.random.default_rng(1)):
        found = findings(theta, -0.08 * (np.arange(ARM.muscle_count) == muscle), 0.0)
        assert {(each.muscle, each.kind) for each in found} == {
            (muscle, ConditionKind.LENGTH_DISAGREES)
        }


@pytest.mark.parametrize('joint', range(ARM.joint_count))
def test_a_false_joint_sensor_is_not_blamed_on_a_length(joint):
    for theta in ARM.random_postures(15, np.random.default_rng(1)):
        assert not findings(theta, 0.0, 0.6 * (np.arange(ARM.joint_count) == joint))
