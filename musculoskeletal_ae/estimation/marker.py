# SPDX-License-Identifier: Apache-2.0
"""Computes joint angles from the pose of a marker at the end effector, reported by a camera."""

import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.robot.inverse_kinematics import inverse_kinematics
from musculoskeletal_ae.robot.robot import Robot

# Beyond these limits, the camera sees another marker or is not calibrated.
#: reject a pose if the end effector stays further than this from the marker's position [m]
MARKER_DISTANCE = 0.05
#: reject a pose if, in the nearest posture, the orientation of the end effector differs from the
#: marker's by more than this angle [rad]
MARKER_ANGLE = 0.3


def posture_of_marker(robot: Robot, pose: pin.SE3, start: Array) -> Array:
    """Return a posture in which the end effector has the pose of a marker.

    Args:
        robot: The nominal body.
        pose: Pose of the marker in the frame of the root link.
        start: Joint angles at which the search starts [rad], (D,).

    Returns:
        Joint angles [rad], (D,), with NaN for joints that do not move the end effector.

    Raises:
        MessageError: If the end effector cannot reach the pose.
    """
    posture = inverse_kinematics(robot, pose, start)
    if posture.distance > MARKER_DISTANCE or posture.angle > MARKER_ANGLE:
        raise MessageError(
            'out of reach',
            f'in the nearest posture, the end effector is {posture.distance:.3f} m and '
            f'{posture.angle:.2f} rad away from the pose of the marker; '
            f'legal: at most {MARKER_DISTANCE:g} m and {MARKER_ANGLE:g} rad; '
            'check which marker the camera sees, and how the camera is calibrated',
        )
    return posture.observed_theta
