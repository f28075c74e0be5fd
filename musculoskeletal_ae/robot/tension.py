# SPDX-License-Identifier: Apache-2.0
"""Muscle tensions that produce a joint torque, by quadratic programming.

    min ‖T − T_wish‖²   subject to   −Gᵀ T = τ,   T_low ≤ T ≤ T_high

T_wish = 0 is the least tension that holds τ (Kawamura 2016; the QP bound of the control
experiment), T_wish = 60 N the well-tensed arm by which `check_robot` judges.
"""

from __future__ import annotations

import numpy as np
import quadprog
from numpy.typing import NDArray

from musculoskeletal_ae.exceptions import InfeasibleError

Array = NDArray[np.float64]

SOFT_WEIGHT = 1e-7  # [N·m/N]², against torques of some N·m and tensions of some hundred N


def holding_tension(
    muscle_jacobian: Array, torque: Array, low: Array | float, high: Array | float, wish: float
) -> Array:
    """Return the tensions nearest to a wished one that produce a joint torque.

    Args:
        muscle_jacobian: G [m/rad], shape (M, D).
        torque: τ [N·m], shape (D,).
        low: Least tension [N], scalar or shape (M,).
        high: Highest tension [N], scalar or shape (M,).
        wish: Tension each muscle would like to have [N].

    Returns:
        T [N], shape (M,).

    Raises:
        InfeasibleError: If no tension within the limits produces the torque.
    """
    muscles, joints = muscle_jacobian.shape
    eye = np.eye(muscles)
    constraints = np.hstack([-muscle_jacobian, eye, -eye])
    bounds = np.concatenate(
        [torque, np.broadcast_to(low, muscles), -np.broadcast_to(high, muscles)]
    )
    try:
        solution = quadprog.solve_qp(eye, np.full(muscles, wish), constraints, bounds, joints)
    except ValueError as error:
        raise InfeasibleError(
            f'no tension within its limits produces the torque {np.round(torque, 2)} N·m'
        ) from error
    tension: Array = solution[0]
    return tension


def nearest_tension(
    muscle_jacobian: Array, torque: Array, low: Array | float, high: Array | float
) -> Array:
    """Return the tensions within their limits that come nearest to a joint torque.

        min ‖τ + Gᵀ T‖² + ε ‖T‖²   subject to   T_low ≤ T ≤ T_high

    The small weight ε picks the least of equally near tensions (Kawamura 2016, soft form).
    Arguments and result as for `holding_tension`.
    """
    muscles = len(muscle_jacobian)
    eye = np.eye(muscles)
    quadratic = muscle_jacobian @ muscle_jacobian.T + SOFT_WEIGHT * eye
    constraints = np.hstack([eye, -eye])
    bounds = np.concatenate([np.broadcast_to(low, muscles), -np.broadcast_to(high, muscles)])
    tension: Array = quadprog.solve_qp(quadratic, -muscle_jacobian @ torque, constraints, bounds)[0]
    return tension
