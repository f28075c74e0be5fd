# SPDX-License-Identifier: Apache-2.0
"""Muscle tensions that produce a joint torque, by quadratic programming.

    hard:   min ‖T − T_wish‖²            subject to   −Gᵀ T = τ,   T_low ≤ T ≤ T_high
    soft:   min ‖τ + Gᵀ T‖² + ε ‖T‖²     subject to                T_low ≤ T ≤ T_high

(Kawamura 2016). T_wish = 0 is the least tension that holds τ, also the QP bound of the control
experiment; T_wish = 60 N the well-tensed arm by which `check_robot` judges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import quadprog

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import InfeasibleError

SOFT_WEIGHT = 1e-7  # [N·m/N]², against torques of some N·m and tensions of some hundred N


class Exertion(NamedTuple):
    """Tensions and what they leave undone.

    Attributes:
        tension: T [N], shape (M,).
        missing_torque: τ + Gᵀ T, the part of τ that T does not produce [N·m], shape (D,).
    """

    tension: Array
    missing_torque: Array


def holding_tension(
    muscle_jacobian: Array,
    torque: Array,
    low: Array | float,
    high: Array | float,
    wish: Array | float,
) -> Array:
    """Return the tensions nearest to a wished one that produce a joint torque.

    Args:
        muscle_jacobian: G [m/rad], shape (M, D).
        torque: τ [N·m], shape (D,).
        low: Least tension [N], scalar or shape (M,).
        high: Highest tension [N], scalar or shape (M,).
        wish: Tension each muscle would like to have [N], scalar or shape (M,).

    Returns:
        T [N], shape (M,).

    Raises:
        InfeasibleError: If no tension within the limits produces the torque, or an entry of G or τ
            is not finite.
    """
    muscles, joints = muscle_jacobian.shape
    constraints, bounds = _limits(muscles, low, high)
    return _solve(
        np.eye(muscles),
        np.array(np.broadcast_to(wish, muscles), dtype=float),
        np.hstack([-muscle_jacobian, constraints]),
        np.concatenate([torque, bounds]),
        joints,
    )


def nearest_tension(
    muscle_jacobian: Array, torque: Array, low: Array | float, high: Array | float
) -> Array:
    """Return the tensions within their limits that come nearest to a joint torque (soft form).

    The small weight ε picks the least of equally near tensions. Arguments, result and errors as
    for `holding_tension`.
    """
    muscles = len(muscle_jacobian)
    quadratic = muscle_jacobian @ muscle_jacobian.T + SOFT_WEIGHT * np.eye(muscles)
    return _solve(quadratic, -muscle_jacobian @ torque, *_limits(muscles, low, high), 0)


def least_tension(
    muscle_jacobian: Array, torque: Array, low: Array | float, high: Array | float
) -> Exertion:
    """Return the least tensions that produce a joint torque, or else come nearest to it.

    Hard where it can be, soft where the limits do not allow it. Arguments as for
    `holding_tension`.

    Raises:
        InfeasibleError: If an entry of G or τ is not finite.
    """
    try:
        tension = holding_tension(muscle_jacobian, torque, low, high, 0.0)
    except InfeasibleError:
        tension = nearest_tension(muscle_jacobian, torque, low, high)
        return Exertion(tension, torque + muscle_jacobian.T @ tension)
    return Exertion(tension, np.zeros(len(torque)))


def _limits(muscles: int, low: Array | float, high: Array | float) -> tuple[Array, Array]:
    eye = np.eye(muscles)
    bounds = np.concatenate([np.broadcast_to(low, muscles), -np.broadcast_to(high, muscles)])
    return np.hstack([eye, -eye]), bounds


def _solve(
    quadratic: Array, linear: Array, constraints: Array, bounds: Array, equalities: int
) -> Array:
    # quadprog answers a NaN with zeros, as if all were well.
    if not all(np.isfinite(part).all() for part in (linear, constraints, bounds)):
        raise InfeasibleError('a muscle Jacobian or torque is not finite')
    try:
        solution = quadprog.solve_qp(quadratic, linear, constraints, bounds, equalities)
    except ValueError as error:
        raise InfeasibleError(
            'no tension within its limits produces the torque '
            f'{np.round(bounds[:equalities], 2)} N·m'
        ) from error
    tension: Array = solution[0]
    return tension
