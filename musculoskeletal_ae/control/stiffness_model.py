# SPDX-License-Identifier: Apache-2.0
"""How stiff the joints are at a posture and tension, as the MAE sees it.

    K_θ(T) = Gᵀ diag(k(T)) G + Σ_i T_i ∂²l_i/∂θ²,    k = (1/K_stiff + ∂L_e/∂T)⁻¹

G, its slope ∂²l/∂θ² and the elongation L_e(T), which is −l(θ, T) up to a constant, are read by
entering the MAE with ① (paper, section "Control", third: variable stiffness). What a push meets is
K_θ + ∂g/∂θ, since the arm's weight moves as well.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

LEVELS = 8  # tensions between T_bias and limit at which the elongation is read
# [rad] for the slope of G; small against the bends of a route, large against errors of the MAE.
STEP = 0.05
GRAVITY_STEP = 1e-4  # [rad]


class StiffnessModel(NamedTuple):
    """Joint stiffness around one posture.

    Attributes:
        jacobian: G [m/rad], shape (M, D).
        hessian: ∂²l/∂θ² [m/rad²], shape (M, D, D).
        compliance: ∂L_e/∂T [m/N] as polynomials of T, highest power first, shape (3, M).
        modules: K_stiff [N/m].
    """

    jacobian: Array
    hessian: Array
    compliance: Array
    modules: float

    def muscle_stiffness(self, tension: Array) -> tuple[Array, Array]:
        """Return k [N/m] and dk/dT [1/m] of every muscle, each of shape (M,)."""
        square, linear, constant = self.compliance
        compliance = (square * tension + linear) * tension + constant
        # A network may err so far that a wire seems to shorten under tension; call it rigid.
        slope = np.where(compliance > 0.0, 2.0 * square * tension + linear, 0.0)
        k = 1.0 / (1.0 / self.modules + np.maximum(compliance, 0.0))
        return k, -k * k * slope

    def joint_stiffness(self, tension: Array) -> Array:
        """Return K_θ [N·m/rad] at T (M,), shape (D, D), gravity's gradient not counted."""
        k, _ = self.muscle_stiffness(tension)
        elastic = self.jacobian.T @ (k[:, None] * self.jacobian)
        joint: Array = elastic + np.einsum('m,mij->ij', tension, self.hessian)
        return joint

    def slope(self, tension: Array) -> Array:
        """Return ∂K_jj/∂T_i [N·m/rad/N] at T (M,), shape (D, M)."""
        _, bend = self.muscle_stiffness(tension)
        slope: Array = (self.jacobian**2 * bend[:, None]).T + np.einsum('mjj->jm', self.hessian)
        return slope


def stiffness_model(robot: Robot, mae: Mae, theta: Array, tension: Array) -> StiffnessModel:
    """Read the model off the MAE at θ (D,) and T (M,)."""
    joints, muscles = robot.joint_count, robot.muscle_count
    offsets = STEP * np.eye(joints)
    postures = np.concatenate([theta[None], theta + offsets, theta - offsets])  # (2D+1, D)
    around = mae.muscle_jacobian(postures, np.tile(tension, (len(postures), 1)))  # (2D+1, M, D)
    raw = (around[1 : joints + 1] - around[joints + 1 :]).transpose(1, 2, 0) / (2.0 * STEP)
    levels = np.linspace(robot.tension.bias, robot.tension.limit, LEVELS)
    lengths = mae.lengths(np.tile(theta, (LEVELS, 1)), np.tile(levels[:, None], muscles))
    cubic: Array = np.polyfit(levels, -lengths, 3)  # (4, M)
    return StiffnessModel(
        jacobian=around[0],
        hessian=0.5 * (raw + raw.transpose(0, 2, 1)),
        compliance=cubic[:3] * np.array([3.0, 2.0, 1.0])[:, None],
        modules=robot.stiffness,
    )


def gravity_gradient(robot: Robot, theta: Array) -> Array:
    """Return ∂g/∂θ [N·m/rad] at θ (D,), shape (D, D)."""
    offsets = GRAVITY_STEP * np.eye(len(theta))
    holding = robot.kinematics.holding_torque
    forward, backward = holding(theta + offsets), holding(theta - offsets)
    gradient: Array = (forward - backward).T / (2.0 * GRAVITY_STEP)
    return gradient


def push_deflection(robot: Robot, theta: Array, stiffness: Array, wrench: Array) -> Array:
    """Return by how much a small push turns the joints, (K_θ + ∂g/∂θ)⁻¹ Jᵀ F [rad], shape (D,).

    Args:
        robot: For its weight and hand.
        theta: Where it rests [rad], shape (D,).
        stiffness: K_θ [N·m/rad], shape (D, D).
        wrench: F on the end effector [N, N·m], axes of the root link, shape (6,).
    """
    torque = robot.kinematics.end_effector_jacobian(theta).T @ wrench
    turn: Array = np.linalg.inv(stiffness + gravity_gradient(robot, theta)) @ torque
    return turn
