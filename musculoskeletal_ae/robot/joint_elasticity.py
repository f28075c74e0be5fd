# SPDX-License-Identifier: Apache-2.0
"""Passive elasticity of the joints: springs, ligaments, soft links and passive tendons.

    τ_passive = −K (θ − θ_0) − diag(d) θ̇ − h(θ) = b − K θ − diag(d) θ̇ − h(θ),    b = K θ_0

K is the stiffness matrix, d the damping of each joint, and θ_0 the posture in which the springs are
at rest. K is symmetric. An off-diagonal entry couples two joints, like a ligament or a soft link
that spans both joints. K has no negative eigenvalue, because passive parts only store energy. h(θ)
holds the joints against passive tendons (`passive_tendons.py`); most robots have none. To hold a
posture, the muscles have to exert the torque g(θ) + K θ − b + h(θ), where g(θ) holds the weight
(`Kinematics.holding_torque`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.robot.passive_tendons import PassiveTendons


@dataclass(frozen=True, eq=False)
class JointElasticity:
    """Springs and dampers of D joints, in the order of θ.

    The stiffness matrix is that of the springs at the joints. `stiffness_at` includes the passive
    tendons.
    """

    stiffness: Array  # stiffness matrix K of the springs [N·m/rad], symmetric, (D, D)
    preload: Array  # b = K θ_0, the torque of the springs at θ = 0 [N·m], (D,)
    damping: Array  # damping d of each joint [N·m·s/rad], (D,)
    tendons: PassiveTendons = field(default_factory=lambda: PassiveTendons.none(0))

    def __post_init__(self) -> None:
        """If there are no passive tendons, set empty ones for the right number of joints."""
        if not self.tendons:
            object.__setattr__(self, 'tendons', PassiveTendons.none(len(self.preload)))

    @classmethod
    def none(cls, joint_count: int) -> JointElasticity:
        """Return the elasticity of joints without springs and dampers."""
        nothing = np.zeros(joint_count)
        return cls(np.zeros((joint_count, joint_count)), nothing, nothing)

    @cached_property
    def is_present(self) -> bool:
        """Whether any joint has a spring, a damper or a passive tendon."""
        return bool(self.stiffness.any() or self.damping.any() or self.tendons)

    @property
    def is_sprung(self) -> Bools:
        """Whether each joint has its own spring or a passive tendon, (D,)."""
        sprung: Bools = self.typical_stiffness > 0.0
        return sprung

    @cached_property
    def typical_stiffness(self) -> Array:
        """Stiffness of each joint [N·m/rad], (D,), with that of passive tendons at their centre."""
        stiffness: Array = np.diag(self.stiffness) + self.tendons.typical_stiffness
        return stiffness

    @property
    def rest(self) -> Array:
        """Posture in which no spring of K exerts torque [rad], (D,); 0 for unsprung joints."""
        rest: Array = np.linalg.pinv(self.stiffness, hermitian=True) @ self.preload
        return rest

    def holding_torque(self, theta: Array) -> Array:
        """Return the torque K θ − b + h(θ) that holds the joints [N·m], (..., D).

        Args:
            theta: Joint angles θ [rad], (..., D).
        """
        torque: Array = theta @ self.stiffness - self.preload
        if self.tendons:
            torque += self.tendons.hold(theta)[0]
        return torque

    def stiffness_at(self, theta: Array) -> Array:
        """Return the derivative of `holding_torque` [N·m/rad], (..., D, D), at θ (..., D)."""
        stiffness: Array = np.broadcast_to(self.stiffness, (*theta.shape, theta.shape[-1]))
        return stiffness + self.tendons.hold(theta)[1] if self.tendons else stiffness

    def deviating(self, factor: Array, shift: Array) -> JointElasticity:
        """Return a copy whose springs deviate in stiffness and in the posture where they rest.

        Args:
            factor: Factor of the stiffness of each joint, (D,).
            shift: Displacement of `rest` [rad], (D,).
        """
        scale = np.sqrt(factor)
        stiffness = scale[:, None] * self.stiffness * scale
        preload, tendons = stiffness @ (self.rest + shift), self.tendons.deviating(factor, shift)
        return JointElasticity(stiffness, preload, self.damping, tendons)

    def scaled(self, radian: Array) -> JointElasticity:
        """Return the same springs and dampers for other units of the joint angles.

        Args:
            radian: Value of one unit of the new angles in the present units, (D,).
        """
        stiffness = radian[:, None] * self.stiffness * radian
        preload, damping = radian * self.preload, radian**2 * self.damping
        return JointElasticity(stiffness, preload, damping, self.tendons.scaled(radian))

    def of_joints(self, joints: Ints) -> JointElasticity:
        """Return the elasticity of some joints (indices), while all other joints are held at 0."""
        rows = np.ix_(joints, joints)
        preload, damping = self.preload[joints], self.damping[joints]
        tendons = self.tendons.of_joints(joints)
        return JointElasticity(self.stiffness[rows], preload, damping, tendons)
