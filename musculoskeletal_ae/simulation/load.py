# SPDX-License-Identifier: Apache-2.0
"""What gravity and a push ask of the joints, for N arms at once.

    load(θ) = g(θ) − Jᵀ F

(paper, section "Simulation": the necessary torque from the geometric model). Pinocchio answers for
one posture; here the same is an array operation over N, and a test holds the two together. With
forces f_i at points c_i, every joint k needs only R_k = Σ (c_i − o_k) f_iᵀ over what it carries:

    τ_k       = a_k · Σ (c_i − o_k) × f_i
    ∂τ_k/∂θ_j = a_jᵀ R_k a_k − (a_j · a_k) tr R_k        for j at or before k, and symmetric
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array, library
from musculoskeletal_ae.robot.kinematics import Kinematics

#: flattened (r fᵀ) @ this gives r × f and, in the last column, r · f
CROSS_AND_DOT = np.zeros((9, 4))
CROSS_AND_DOT[[5, 7, 6, 2, 1, 3], [0, 0, 1, 1, 2, 2]] = [1.0, -1.0] * 3
CROSS_AND_DOT[[0, 4, 8], 3] = 1.0


class Load:
    """Torque that holds N arms against gravity and a wrench, and its gradient."""

    def __init__(self, kinematics: Kinematics) -> None:
        kin, model = kinematics, kinematics.model
        self._kinematics = kin
        #: pinocchio's joint of each entry of θ, then the coupled ones; ∂q/∂θ of them, if there are
        self._tree = kin.tree
        self._gear = None if kin.transmission is None else kin.transmission[kin.tree - 1]
        self._slides = kin.prismatic[self._tree]
        # Columns that a pose maps to the joint's axis, its origin and its centre of mass.
        self._columns = np.zeros((len(kin.parent), 4, 3))
        self._columns[:, :3, 0] = kin.local_axis
        self._columns[:, 3, 1:] = 1.0
        self._columns[:, :3, 2] = [inertia.lever for inertia in model.inertias]
        self._gravity: Array = np.array(model.gravity.linear)
        carries = kin.hangs_on[:, self._tree].T.astype(float)  # (D or more, joints of the tree)
        self._carried: Array = carries * np.array([inertia.mass for inertia in model.inertias])
        self._carried_mass: Array = self._carried.sum(axis=1)[:, None]
        effector = model.frames[kin.end_effector_frame]
        self._effector_joint = int(effector.parentJoint)
        self._effector = np.append(effector.placement.translation, 1.0)
        self._carries_effector: Array = carries[:, self._effector_joint]
        # before[j, k]: joint k hangs on joint j, or is it
        before = kin.hangs_on[np.ix_(self._tree, self._tree)].T
        self._upper: Array = before * ~self._slides[:, None] * 1.0
        self._strict: Array = self._upper * ~np.eye(len(before), dtype=bool)
        self._cross_and_dot = CROSS_AND_DOT

    def __call__(self, theta: Array, wrench: Array | None = None) -> tuple[Array, Array]:
        """Return load [N·m] (N, D) and ∂load/∂θ [N·m/rad] (N, D, D) at θ [rad] (N, D).

        The wrench (N, 6) [N, N·m] acts on the end effector's origin, in axes of the root link; its
        torque's share in the gradient is left out.
        """
        poses = self._kinematics.transforms(theta)
        placed = (poses @ self._columns)[..., :3, :]  # (N, joints of the tree, 3, 3)
        joints = placed[:, self._tree]
        axis, origin, centre = joints[..., 0], joints[..., 1], placed[..., 2]  # (N, …, 3)
        moment = self._carried @ centre - self._carried_mass * origin
        spread = moment[..., None] * self._gravity  # R of the weights, (N, D, 3, 3)
        if wrench is not None:
            point = poses[:, self._effector_joint, :3] @ self._effector
            arm = (point[:, None] - origin) * self._carries_effector[:, None]
            spread = spread + arm[..., None] * wrench[:, None, None, :3]
        turning = spread.reshape(*axis.shape[:2], 9) @ self._cross_and_dot  # (N, D, 4)
        pull, bend = turning[..., :3], (spread @ axis[..., None])[..., 0] - turning[..., 3:] * axis
        if self._slides.any():
            xp = library(axis)
            force = xp.broadcast_to(self._carried_mass * self._gravity, axis.shape)
            if wrench is not None:
                force = force + self._carries_effector[:, None] * wrench[:, None, :3]
            pull = xp.where(self._slides[:, None], force, pull)
            bend = xp.where(self._slides[:, None], xp.linalg.cross(axis, force), bend)
        if wrench is not None:
            rotary = self._carries_effector * ~self._slides
            pull = pull + rotary[:, None] * wrench[:, None, 3:]
        torque = (axis * pull).sum(axis=-1)
        slope = axis @ bend.swapaxes(1, 2)
        gradient = slope * self._upper + (slope * self._strict).swapaxes(1, 2)
        if self._gear is not None:
            torque, gradient = torque @ self._gear, self._gear.T @ gradient @ self._gear
        return -torque, -gradient
