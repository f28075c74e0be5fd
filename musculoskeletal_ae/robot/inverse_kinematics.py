# SPDX-License-Identifier: Apache-2.0
"""Joint angles from the pose of the end effector, started from an estimate.

    min_θ ‖p(θ) − p‖²/σ_p² + ‖log(R(θ)ᵀ R)‖²/σ_R² + ‖θ − θ_est‖²/σ_θ²,   lower ≤ θ ≤ upper

by damped least squares (Levenberg–Marquardt) over pinocchio's Jacobian. Where the pose says little
about a joint (near a singular posture), a camera's noise would turn it anywhere; the estimate,
taken as known to σ_θ, keeps it. A robot without joint sensors is watched by a camera
(paper, section "Musculoskeletal Humanoids"): this is how its θ gets into online learning.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot

# How far the pose of a usual camera's marker can be trusted: σ_p [m], σ_R [rad].
SPREADS = np.repeat([0.002, 0.01], 3)
POSITION_ONLY = np.repeat([0.002, 100.0], 3)  # however the hand is turned
ESTIMATE_SPREAD = 0.2  # σ_θ [rad]
ITERATIONS = 30
LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e6
SMALL_STEP = 1e-6  # [rad]


class Posture(NamedTuple):
    """A solution, and what it leaves of the position and of the orientation."""

    theta: Array  # θ [rad], (D,)
    distance: float  # [m]
    angle: float  # [rad]


def inverse_kinematics(
    robot: Robot, pose: pin.SE3, start: Array, spreads: Array = SPREADS
) -> Posture:
    """Return the joint angles that bring the end effector nearest to a pose.

    The pose is in the root link's frame and known to `spreads`, (6,) σ_p [m] and σ_R [rad]; the
    search starts at the estimate θ_est [rad] (D,).
    """
    kin, lower, upper = robot.kinematics, robot.lower, robot.upper
    theta, damping = np.clip(start, lower, upper), 1e-2
    error = _error(robot, pose, theta, start, spreads)
    prior = np.eye(len(theta)) / ESTIMATE_SPREAD
    for _ in range(ITERATIONS):
        jacobian = np.vstack([kin.end_effector_jacobian(theta) / spreads[:, None], prior])
        # At a limit, a joint that wants to go beyond is held.
        gradient = jacobian.T @ error
        held = (theta <= lower) & (gradient < 0.0) | (theta >= upper) & (gradient > 0.0)
        jacobian[:, held] = 0.0
        normal = jacobian.T @ jacobian
        scale = damping * np.maximum(np.diag(normal), 1e-3 * np.diag(normal).max() + 1e-12)
        step = np.linalg.solve(normal + np.diag(scale), jacobian.T @ error)
        tried = np.clip(theta + step, lower, upper)
        tried_error = _error(robot, pose, tried, start, spreads)
        if tried_error @ tried_error < error @ error:
            moved = np.abs(tried - theta).max()
            theta, error, damping = tried, tried_error, max(0.2 * damping, LEAST_DAMPING)
            if moved < SMALL_STEP:
                break
        else:
            damping *= 8.0
            if damping > MOST_DAMPING:
                break
    left = error[:6] * spreads
    return Posture(theta, float(np.linalg.norm(left[:3])), float(np.linalg.norm(left[3:])))


def _error(robot: Robot, pose: pin.SE3, theta: Array, start: Array, spreads: Array) -> Array:
    """Return what is missing in position, orientation and to the estimate, weighted, (6+D,)."""
    here = robot.kinematics.end_effector_pose(theta)
    turn = here.rotation @ pin.log3(here.rotation.T @ pose.rotation)
    missing = np.concatenate([pose.translation - here.translation, turn]) / spreads
    return np.concatenate([missing, (start - theta) / ESTIMATE_SPREAD])
