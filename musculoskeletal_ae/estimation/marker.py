# SPDX-License-Identifier: Apache-2.0
"""Joint angles from the pose of a marker at the end effector, as a camera reports it."""

import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.robot.inverse_kinematics import inverse_kinematics
from musculoskeletal_ae.robot.robot import Robot

#: A pose that the arm cannot reach to within these is that of another marker, or of a camera whose
#: calibration is wrong.
MARKER_DISTANCE, MARKER_ANGLE = 0.05, 0.3  # [m], [rad]


def posture_of_marker(robot: Robot, pose: pin.SE3, start: Array) -> Array:
    """Return θ that brings the end effector to a pose, NaN for joints that do not move it.

    Args:
        robot: The nominal body.
        pose: In the frame of the root link.
        start: θ where the search begins [rad], (D,).

    Raises:
        MessageError: If the pose is out of reach.
    """
    posture = inverse_kinematics(robot, pose, start)
    if posture.distance > MARKER_DISTANCE or posture.angle > MARKER_ANGLE:
        raise MessageError(
            'out of reach', f'{posture.distance:.3f} m and {posture.angle:.2f} rad are left'
        )
    return posture.observed_theta
