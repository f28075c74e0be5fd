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


def findings(theta, length_error, joint_error, dt=0.1, is_fresh=lambda _: True):
    """Return what the detector reports in 4 s in which an arm stands in a posture.

    `is_fresh` says whether the message with a number has joint angles.
    """
    mae = ExactMae(ARM)
    mae.isolated, mae.is_calibrated = (), True
    detector, rng = LengthDisagreement(ARM), np.random.default_rng(0)
    detector.use(mae)
    length = mae.lengths(theta, TENSION) + length_error + rng.normal(0.0, 0.002, len(TENSION))
    sample = SimpleNamespace(length=length, bone_tension=TENSION, motor_tension=TENSION)
    measured = theta + joint_error
    found = []
    for n in range(round(4.0 / dt)):
        message = SimpleNamespace(
            sample=sample, measured=measured if is_fresh(n) else None, dt=dt, lengths_known=True
        )
        found.append(detector.step(message))
    return [each for each in found if each is not None]


@pytest.mark.parametrize('muscle', range(ARM.muscle_count))
def test_one_wrong_length_is_reported_in_every_posture(muscle):
    # In some postures, an error of a joint sensor could explain most of the change of a length.
    for theta in ARM.random_postures(15, np.random.default_rng(1)):
        found = findings(theta, -0.08 * (np.arange(ARM.muscle_count) == muscle), 0.0)
        assert {(each.muscle, each.kind) for each in found} == {
            (muscle, ConditionKind.LENGTH_DISAGREES)
        }


@pytest.mark.parametrize('phase', range(10))
def test_a_wrong_length_is_reported_within_seconds_if_few_messages_come_with_joint_angles(phase):
    """Joint sensors at 10 Hz measure half of 100 messages a second, because readings get old."""
    theta = 0.5 * (ARM.lower + ARM.upper)
    length_error = -0.08 * (np.arange(ARM.muscle_count) == 1)
    found = findings(theta, length_error, 0.0, dt=0.01, is_fresh=lambda n: (n + phase) % 10 >= 5)
    assert {each.muscle for each in found} == {1}


@pytest.mark.parametrize('joint', range(ARM.joint_count))
def test_a_false_joint_sensor_is_not_blamed_on_a_length(joint):
    for theta in ARM.random_postures(15, np.random.default_rng(1)):
        assert not findings(theta, 0.0, 0.6 * (np.arange(ARM.joint_count) == joint))
