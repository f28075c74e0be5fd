# SPDX-License-Identifier: Apache-2.0
"""Inverse kinematics of a marker pose: it determines θ as far as it can.

Joints that the pose does not determine stay at their estimates.
"""

import numpy as np

from musculoskeletal_ae.emulator.modules import camera_reading
from musculoskeletal_ae.robot.inverse_kinematics import POSITION_ONLY, SPREADS, inverse_kinematics
from musculoskeletal_ae.robot.robot import Robot

ARM = Robot.load('musashi_left_arm')
POSTURES = ARM.random_postures(100, np.random.default_rng(0), -0.1)


def test_a_pose_is_reached_within_the_noise_of_the_camera_from_a_distant_estimate():
    for theta in POSTURES:
        pose = ARM.kinematics.end_effector_pose(theta)
        posture = inverse_kinematics(ARM, pose, theta + 0.15)
        assert posture.distance < 3.0 * SPREADS[0] and posture.angle < 3.0 * SPREADS[3]


def test_an_estimate_that_agrees_with_the_pose_is_not_changed():
    for theta in POSTURES:
        pose = ARM.kinematics.end_effector_pose(theta)
        for spreads in (SPREADS, POSITION_ONLY):
            posture = inverse_kinematics(ARM, pose, theta, spreads)
            np.testing.assert_allclose(posture.theta, theta, atol=1e-9)


def test_noise_of_the_camera_turns_joints_by_less_than_0_2_rad():
    """The search ends when a better fit would only follow the noise of the camera.

    Without this rule, θ could change by 0.41 rad.
    """
    rng = np.random.default_rng(1)
    theta = ARM.random_postures(400, rng)
    observed = [camera_reading(ARM.kinematics.end_effector_pose(each), rng) for each in theta]
    solutions = [
        inverse_kinematics(ARM, *known).theta for known in zip(observed, theta, strict=True)
    ]
    assert np.linalg.norm(np.array(solutions) - theta, axis=1).max() < 0.2
