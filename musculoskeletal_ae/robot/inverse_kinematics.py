# SPDX-License-Identifier: Apache-2.0
"""Compute joint angles from the pose of the end effector, starting from an estimate.

    θ = IK(P_marker, θ_initial = θ_est):  min_θ ‖p(θ) − p‖²/σ_p² + ‖log(R(θ)ᵀ R)‖²/σ_R²

(paper, §II-A) within the joint limits. p and R are the measured position and orientation of the end
effector, p(θ) and R(θ) those at the joint angles θ, and σ_p and σ_R the standard deviations of the
measurement. The sum is minimised by damped least squares (Levenberg–Marquardt) with pinocchio's
Jacobian.

Near a singular posture the pose determines some joints poorly, and camera noise would move them
arbitrarily. Every step is therefore damped, and the search ends when a step reduces the sum by less
than `LEAST_GAIN`, a change that noise alone can cause. A robot without joint sensors learns online
from the resulting θ.
"""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot

#: standard deviations of a marker's pose measured by a typical camera, σ_p [m] and σ_R [rad], (6,)
SPREADS = np.repeat([0.002, 0.01], 3)
#: standard deviations that leave the orientation free
POSITION_ONLY = np.repeat([0.002, 100.0], 3)
ITERATIONS = 30  # largest number of steps
LEAST_DAMPING = 1e-6  # smallest damping, relative to the diagonal of JᵀJ
MOST_DAMPING = 1e6  # largest damping, relative to the diagonal of JᵀJ
#: prior standard deviation of a step, which damps joints that the pose does not determine [rad]
STEP_SPREAD = 0.1
LEAST_GAIN = 1.0  # decrease of the minimised sum below which the search ends


class Posture(NamedTuple):
    """A solution of the inverse kinematics, with its remaining errors."""

    theta: Array  # θ [rad], (D,)
    distance: float  # remaining error of the position [m]
    angle: float  # remaining error of the orientation [rad]
    observed_theta: Array  # θ, with NaN for joints that do not move the end effector, (D,)


def inverse_kinematics(
    robot: Robot, pose: pin.SE3, start: Array, spreads: Array = SPREADS
) -> Posture:
    """Return the posture that brings the end effector nearest to a pose.

    Args:
        robot: The geometric model.
        pose: The pose in the root link's frame.
        start: Joint angles at which the search starts [rad], (D,).
        spreads: Standard deviations of the measured position [m] and orientation [rad], (6,).
    """
    kin, lower, upper = robot.kinematics, robot.lower, robot.upper
    theta, damping = np.clip(start, lower, upper), 1e-2
    error = _error(robot, pose, theta, spreads)
    for _ in range(ITERATIONS):
        jacobian = kin.end_effector_jacobian(theta) / spreads[:, None]
        # Hold a joint at its limit if the step would exceed it.
        gradient = jacobian.T @ error
        held = (theta <= lower) & (gradient < 0.0) | (theta >= upper) & (gradient > 0.0)
        jacobian[:, held] = 0.0
        normal = jacobian.T @ jacobian
        scale = damping * np.maximum(np.diag(normal), 1e-3 * np.diag(normal).max())
        step = np.linalg.solve(normal + np.diag(scale + STEP_SPREAD**-2), jacobian.T @ error)
        candidate = np.clip(theta + step, lower, upper)
        new_error = _error(robot, pose, candidate, spreads)
        gain = error @ error - new_error @ new_error
        if gain > 0.0:
            theta, error, damping = candidate, new_error, max(0.2 * damping, LEAST_DAMPING)
            if gain < LEAST_GAIN:
                break
        else:
            damping *= 8.0
            if damping > MOST_DAMPING:
                break
    distance, angle = np.linalg.norm((error * spreads).reshape(2, 3), axis=1).tolist()
    moves_end_effector = kin.end_effector_jacobian(theta).any(axis=0)
    return Posture(theta, distance, angle, np.where(moves_end_effector, theta, np.nan))


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
