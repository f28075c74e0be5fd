# SPDX-License-Identifier: Apache-2.0
"""Passive elasticity of the joints: springs, ligaments and soft links.

    τ_passive = −K (θ − θ_0) − diag(d) θ̇ = b − K θ − diag(d) θ̇,    b = K θ_0

K is the stiffness matrix, d the damping of each joint, and θ_0 the posture in which the springs are
at rest. K is symmetric. An off-diagonal entry couples two joints, like a ligament or a soft link
that spans both joints. K has no negative eigenvalue, because passive parts only store energy. To
hold a posture, the muscles have to exert the torque g(θ) + K θ − b, where g(θ) holds the weight
(`Kinematics.holding_torque`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints


@dataclass(frozen=True, eq=False)
class JointElasticity:
    """Springs and dampers of D joints, in the order of θ."""

    stiffness: Array  # K [N·m/rad], symmetric, (D, D)
    preload: Array  # b = K θ_0, the torque of the springs at θ = 0 [N·m], (D,)
    damping: Array  # d [N·m·s/rad], (D,)

    @classmethod
    def none(cls, joint_count: int) -> JointElasticity:
        """Return the elasticity of joints without springs and dampers."""
        nothing = np.zeros(joint_count)
        return cls(np.zeros((joint_count, joint_count)), nothing, nothing)

    @cached_property
    def is_present(self) -> bool:
        """Whether any joint has a spring or a damper."""
        return bool(self.stiffness.any() or self.damping.any())

    @property
    def is_sprung(self) -> Bools:
        """Whether each joint has its own spring, (D,)."""
        return np.diag(self.stiffness) > 0.0

    @property
    def rest(self) -> Array:
        """Posture in which no spring exerts torque [rad], (D,); 0 for joints without a spring."""
        rest: Array = np.linalg.pinv(self.stiffness, hermitian=True) @ self.preload
        return rest

    def holding_torque(self, theta: Array) -> Array:
        """Return the torque K θ − b that holds the joints against their springs [N·m], (..., D).

        Args:
            theta: Joint angles θ [rad], (..., D).
        """
        torque: Array = theta @ self.stiffness - self.preload
        return torque

    def deviating(self, factor: Array, shift: Array) -> JointElasticity:
        """Return a copy whose springs deviate in stiffness and in the posture where they rest.

        Args:
            factor: Factor of the stiffness of each joint, (D,).
            shift: Displacement of `rest` [rad], (D,).
        """
        scale = np.sqrt(factor)
        stiffness = scale[:, None] * self.stiffness * scale
        return JointElasticity(stiffness, stiffness @ (self.rest + shift), self.damping)

    def scaled(self, radian: Array) -> JointElasticity:
        """Return the same springs and dampers for other units of the joint angles.

        Args:
            radian: Value of one unit of the new angles in the present units, (D,).
        """
        stiffness = radian[:, None] * self.stiffness * radian
        return JointElasticity(stiffness, radian * self.preload, radian**2 * self.damping)

    def of_joints(self, joints: Ints) -> JointElasticity:
        """Return the elasticity of some joints (indices), while all other joints are held at 0."""
        rows = np.ix_(joints, joints)
        return JointElasticity(self.stiffness[rows], self.preload[joints], self.damping[joints])
