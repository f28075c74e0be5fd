# SPDX-License-Identifier: Apache-2.0
"""Joint stiffness of an arm whose muscles follow muscle stiffness control (MSC).

    K_θ = Gᵀ diag(k) G + Σ_i T_i ∂²l_i/∂θ²,    k = (1/K_stiff + ∂L_e/∂T)⁻¹

`check_robot` takes G and L_e from the geometric model, control from the network. A muscle that MSC
holds at T_bias gives way without resistance when it is shortened: counted as slack, its k is zero
(the one-sided value). What a push meets is K_θ + ∂g/∂θ, since the arm's weight moves as well.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from musculoskeletal_ae.arrays import Array


def muscle_stiffness(module: float, compliance: Array) -> Array:
    """Return k [N/m] of MSC with K_stiff [N/m] and an elastic unit of ∂L_e/∂T [m/N] in series."""
    stiffness: Array = 1.0 / (1.0 / module + compliance)
    return stiffness


def muscle_hessian(
    muscle_jacobian: Callable[[Array], Array], theta: Array, step: float = 1e-5
) -> Array:
    """Return ∂²l/∂θ² [m/rad²], shape (M, D, D), by central differences of G.

    Args:
        muscle_jacobian: Maps θ (N, D) to G [m/rad] (N, M, D).
        theta: θ [rad], shape (D,).
        step: Δθ [rad].
    """
    offsets = step * np.eye(len(theta))
    difference = muscle_jacobian(theta + offsets) - muscle_jacobian(theta - offsets)
    raw = difference.transpose(1, 2, 0) / (2.0 * step)
    hessian: Array = 0.5 * (raw + raw.transpose(0, 2, 1))
    return hessian


def joint_stiffness(
    muscle_jacobian: Array, hessian: Array, stiffness: Array, tension: Array
) -> Array:
    """Return K_θ [N·m/rad], shape (D, D), gravity's gradient not counted.

    Args:
        muscle_jacobian: G [m/rad], shape (M, D).
        hessian: ∂²l/∂θ² [m/rad²], shape (M, D, D).
        stiffness: k of each muscle [N/m], shape (M,); 0 for a slack one.
        tension: T [N], shape (M,).
    """
    elastic = muscle_jacobian.T @ (stiffness[:, None] * muscle_jacobian)
    joint: Array = elastic + np.einsum('m,mij->ij', tension, hessian)
    return joint
