# SPDX-License-Identifier: Apache-2.0
"""Joint stiffness of an arm whose muscles follow muscle stiffness control (MSC).

    K_θ = Gᵀ diag(k) G + Σ_i T_i ∂²l_i/∂θ²,    k = (1/K_stiff + ∂L_e/∂T)⁻¹

A muscle that MSC holds at T_bias gives way without resistance when it is shortened: counted as
slack, its k is zero (the one-sided value).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot


def muscle_stiffness(robot: Robot, theta: Array, tension: Array) -> Array:
    """Return k [N/m] of every muscle, shape (M,): MSC and the elastic unit in series."""
    compliance = robot.series_elastic.compliance(robot.routes.absolute_lengths(theta), tension)
    stiffness: Array = 1.0 / (1.0 / robot.stiffness + compliance)
    return stiffness


def joint_stiffness(
    robot: Robot, theta: Array, tension: Array, slack: NDArray[np.bool_] | None = None
) -> Array:
    """Return K_θ [N·m/rad], shape (D, D), gravity's gradient not counted.

    Args:
        robot: The body.
        theta: Posture [rad], shape (D,).
        tension: Muscle tensions [N], shape (M,).
        slack: Muscles that count as slack, shape (M,); none by default.
    """
    stiffness = muscle_stiffness(robot, theta, tension)
    if slack is not None:
        stiffness = np.where(slack, 0.0, stiffness)
    jacobian = robot.routes.muscle_jacobian(theta)
    geometric = np.einsum('m,mij->ij', tension, robot.routes.muscle_hessian(theta))
    joint: Array = jacobian.T @ (stiffness[:, None] * jacobian) + geometric
    return joint
