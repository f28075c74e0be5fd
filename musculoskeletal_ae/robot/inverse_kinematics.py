# SPDX-License-Identifier: Apache-2.0
"""Compute joint angles from the pose of the end effector, starting from an estimate.

    θ = IK(P_marker, θ_initial = θ_est):  min_θ ‖p(θ) − p‖²/σ_p² + ‖log(R(θ)ᵀ R)‖²/σ_R²

(paper, §II-A) within the joint limits. p and R are the measured position and orientation of the end
effector, with the standard deviations σ_p and σ_R. p(θ) and R(θ) are its position and orientation
at the joint angles θ. The sum is minimised by damped Gauss–Newton (`gauss_newton`) with pinocchio's
Jacobian.

Near a singular posture the pose determines some joints poorly, and camera noise would move them
arbitrarily. Every step is therefore damped, and the search ends with the step that reduces the sum
by less than `LEAST_GAIN`, a change that noise alone can cause. A robot without joint sensors learns
online from the resulting θ.
"""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.gauss_newton import minimise_each
from musculoskeletal_ae.robot.robot import Robot

#: by default, expect these standard deviations σ_p [m] and σ_R [rad] of a marker's pose, as of a
#: typical camera, (6,)
SPREADS = np.repeat([0.002, 0.01], 3)
#: like SPREADS, but with σ_R so large that any orientation is accepted
POSITION_ONLY = np.repeat([0.002, 100.0], 3)
ROUNDS = 30  # end the search after this many steps
#: damp each step by this prior standard deviation, so that joints that the pose does not determine
#: hardly move [rad]
STEP_SPREAD = 0.1
LEAST_GAIN = 1.0  # end the search once a step reduces the minimised sum by less than this

# Beyond these limits, the camera sees another marker or is not calibrated.
#: reject a pose if the end effector stays further than this from the marker's position [m]
MARKER_DISTANCE = 0.05
#: reject a pose if, in the nearest posture, the orientation of the end effector differs from the
#: marker's by more than this angle [rad]
MARKER_ANGLE = 0.3


class Posture(NamedTuple):
    """A solution of the inverse kinematics, with its remaining errors."""

    theta: Array  # joint angles θ of the solution [rad], (D,)
    distance: float  # distance of the end effector from the pose [m]
    angle: float  # angle between the orientations of end effector and pose [rad]
    #: θ, with NaN for joints that do not move the end effector and therefore remain unknown, (D,)
    observed_theta: Array


def inverse_kinematics(
    robot: Robot, pose: pin.SE3, start: Array, spreads: Array = SPREADS
) -> Posture:
    """Return the posture that brings the end effector nearest to a pose.

    Args:
        robot: The geometric model, whose joint limits bound the solution.
        pose: The pose in the root link's frame.
        start: Joint angles at which the search starts [rad], (D,).
        spreads: Standard deviations of the measured position [m] and orientation [rad], (6,).
    """
    kin = robot.kinematics

    def residuals(theta: Array) -> tuple[Array, Array]:
        slope = -kin.end_effector_jacobian(theta) / spreads[:, None]
        return _error(robot, pose, theta, spreads), slope

    theta = minimise_each(
        residuals,
        start,
        STEP_SPREAD**-2,
        ROUNDS,
        bounds=(robot.lower, robot.upper),
        least_damping=1.0,
        enough=LEAST_GAIN,
    )
    error = _error(robot, pose, theta, spreads)
    distance, angle = np.linalg.norm((error * spreads).reshape(2, 3), axis=1).tolist()
    moves_end_effector = kin.end_effector_jacobian(theta).any(axis=0)
    return Posture(theta, distance, angle, np.where(moves_end_effector, theta, np.nan))


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


def _error(robot: Robot, pose: pin.SE3, theta: Array, spreads: Array) -> Array:
    """Return the errors of the end effector's position and orientation in a posture, (6,).

    Args:
        robot: The geometric model.
        pose: The pose to reach, in the root link's frame.
        theta: Joint angles [rad], (D,).
        spreads: Values [m] and [rad] by which the errors are divided, (6,).
    """
    here = robot.kinematics.end_effector_pose(theta)
    turn = here.rotation @ pin.log3(here.rotation.T @ pose.rotation)
    error: Array = np.concatenate([pose.translation - here.translation, turn]) / spreads
    return error
