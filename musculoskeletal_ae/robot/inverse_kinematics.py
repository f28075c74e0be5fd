# SPDX-License-Identifier: Apache-2.0
"""Joint angles from the pose of the end effector, started from an estimate.

    θ = IK(P_marker, θ_initial = θ_est):  min_θ ‖p(θ) − p‖²/σ_p² + ‖log(R(θ)ᵀ R)‖²/σ_R²

(paper, §II-A) in the joint limits, by damped least squares
(Levenberg–Marquardt) over pinocchio's Jacobian. Nothing pulls θ towards the estimate, but where the
pose says little about a joint (near a singular posture), a camera's noise would turn it anywhere;
so no step is free of damping, and the search ends once a step gains less than the noise amounts to.
A robot without joint sensors is watched by a camera: this is how its θ gets into online learning.
"""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot

# Standard deviations of a marker's pose from a typical camera: σ_p [m], σ_R [rad].
SPREADS = np.repeat([0.002, 0.01], 3)
POSITION_ONLY = np.repeat([0.002, 100.0], 3)  # for any orientation
ITERATIONS = 30
LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e6  # shares of JᵀJ
STEP_SPREAD = 0.1  # [rad] σ that damps every step, for joints that the pose does not determine
LEAST_GAIN = 1.0  # lowest decrease of the sum above; a smaller one ends the search


class Posture(NamedTuple):
    """A solution, with its errors of position and orientation."""

    theta: Array  # θ [rad], (D,)
    distance: float  # [m]
    angle: float  # [rad]
    seen: Array  # θ, NaN of joints that do not move the end effector: of them a pose says nothing


def inverse_kinematics(
    robot: Robot, pose: pin.SE3, start: Array, spreads: Array = SPREADS
) -> Posture:
    """Return the joint angles that bring the end effector nearest to a pose.

    Args:
        robot: The geometric model.
        pose: The pose in the root link's frame.
        start: θ_est [rad] (D,), at which the search starts.
        spreads: Standard deviations of the pose, σ_p [m] and σ_R [rad], (6,).
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
        tried = np.clip(theta + step, lower, upper)
        tried_error = _error(robot, pose, tried, spreads)
        gain = error @ error - tried_error @ tried_error
        if gain > 0.0:
            theta, error, damping = tried, tried_error, max(0.2 * damping, LEAST_DAMPING)
            if gain < LEAST_GAIN:
                break
        else:
            damping *= 8.0
            if damping > MOST_DAMPING:
                break
    distance, angle = np.linalg.norm((error * spreads).reshape(2, 3), axis=1).tolist()
    seen = np.where(kin.end_effector_jacobian(theta).any(axis=0), theta, np.nan)
    return Posture(theta, distance, angle, seen)


def _error(robot: Robot, pose: pin.SE3, theta: Array, spreads: Array) -> Array:
    """Return the weighted error of position and orientation, (6,)."""
    here = robot.kinematics.end_effector_pose(theta)
    turn = here.rotation @ pin.log3(here.rotation.T @ pose.rotation)
    missing: Array = np.concatenate([pose.translation - here.translation, turn]) / spreads
    return missing
