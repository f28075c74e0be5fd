# SPDX-License-Identifier: Apache-2.0
"""Joint stiffness of an arm under muscle stiffness control (MSC) or position control.

    K_θ = Gᵀ diag(k) G + Σ_i T_i ∂²l_i/∂θ²,    k = (1/K_stiff + ∂L_e/∂T)⁻¹

K_θ is the joint stiffness, and G = ∂l/∂θ. k is the stiffness of each muscle, with the control
stiffness K_stiff and the elongation L_e of its elastic element. T_i is the tension and l_i the
length of muscle i. `check_robot` takes G and L_e from the geometric model, the controller from the
network.

A muscle that MSC holds at T_bias does not resist shortening. The one-sided stiffness therefore
counts such a muscle as slack, with k = 0. For position-controlled modules, K_stiff is infinite. The
stiffness against an external wrench is K_θ + ∂g/∂θ, because the torque g of the arm's weight
changes with θ as well.
"""

from collections.abc import Callable

import numpy as np

from musculoskeletal_ae.arrays import Array

#: assume at least this ∂L_e/∂T of an elastic element and its tendon [m/N], to avoid a division by
#: zero
LEAST_COMPLIANCE = 1e-7


def muscle_stiffness(module: Array, compliance: Array) -> Array:
    """Return the stiffness of a muscle module and its elastic element in series [N/m].

    Args:
        module: Control stiffness of the module [N/m]; infinite for a position-controlled module.
        compliance: Derivative of the elongation with respect to tension [m/N].
    """
    return 1.0 / (1.0 / module + np.maximum(compliance, LEAST_COMPLIANCE))


def muscle_hessian(
    muscle_jacobian: Callable[[Array], Array], theta: Array, step: Array | float = 1e-5
) -> Array:
    """Return the second derivatives ∂²l/∂θ² of the muscle lengths [m/rad²], (..., M, D, D).

    They are computed by central differences of the muscle Jacobian.

    Args:
        muscle_jacobian: Function of θ [rad], (..., D), that returns the muscle Jacobian ∂l/∂θ
            [m/rad], (..., M, D).
        theta: Joint angles [rad], (..., D).
        step: Half width of the differences [rad], scalar or (D,).
    """
    offsets, middle = step * np.eye(theta.shape[-1]), theta[..., None, :]
    difference = muscle_jacobian(middle + offsets) - muscle_jacobian(middle - offsets)
    raw = np.moveaxis(difference, -3, -1) / (2.0 * step)
    return 0.5 * (raw + raw.swapaxes(-1, -2))


def joint_stiffness(jacobian: Array, hessian: Array, stiffness: Array, tension: Array) -> Array:
    """Return the joint stiffness [N·m/rad], (..., D, D).

    Args:
        jacobian: Muscle Jacobian ∂l/∂θ [m/rad], (..., M, D).
        hessian: Second derivatives ∂²l/∂θ² [m/rad²], (..., M, D, D).
        stiffness: Stiffness of each muscle [N/m], (..., M).
        tension: Tensions [N], (..., M).
    """
    elastic = jacobian.swapaxes(-1, -2) @ (stiffness[..., None] * jacobian)
    return elastic + np.einsum('...m,...mij->...ij', tension, hessian)
