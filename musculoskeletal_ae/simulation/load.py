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

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.kinematics import Kinematics

#: flattened (r fᵀ) @ this gives r × f and, in the last column, r · f
CROSS_AND_DOT = np.zeros((9, 4))
CROSS_AND_DOT[[5, 7, 6, 2, 1, 3], [0, 0, 1, 1, 2, 2]] = [1.0, -1.0] * 3
CROSS_AND_DOT[[0, 4, 8], 3] = 1.0


class Load:
    """Torque that holds N arms against gravity and a wrench, and its gradient."""

    def __init__(self, kinematics: Kinematics) -> None:
        """Read masses, centres of mass and joint axes from pinocchio's model."""
        kin, model = kinematics, kinematics.model
        count = len(kin.parent)
        self._parent = [int(i) for i in kin.parent]
        #: pinocchio's joint of each entry of θ
        self._tree = np.argsort(kin.theta_index[1:]) + 1
        self._theta_index = kin.theta_index[1:]
        # Pose in the parent = fixed + a(θ) · first + b(θ) · second, a = sin θ and b = 1 − cos θ
        # (Rodrigues), or a = θ and b = 0 for a joint that slides.
        self._fixed, self._first, self._second = np.zeros((3, count, 4, 4))
        for i in range(count):
            turn, axis = kin.placement_rotation[i], kin.local_axis[i]
            self._fixed[i, :3, :3], self._fixed[i, 3, 3] = turn, 1.0
            self._fixed[i, :3, 3] = kin.placement_translation[i]
            if kin.prismatic[i]:
                self._first[i, :3, 3] = turn @ axis
            else:
                cross = np.cross(axis, np.eye(3)).T
                self._first[i, :3, :3], self._second[i, :3, :3] = turn @ cross, turn @ cross @ cross
        self._slides = kin.prismatic[self._tree]
        mass = np.array([inertia.mass for inertia in model.inertias])
        # Columns that a pose maps to the joint's axis, its origin and its centre of mass.
        self._columns = np.zeros((count, 4, 3))
        self._columns[:, :3, 0] = kin.local_axis
        self._columns[:, 3, 1:] = 1.0
        self._columns[:, :3, 2] = [inertia.lever for inertia in model.inertias]
        self._gravity: Array = np.array(model.gravity.linear)
        carries = kin.moved_by.T.astype(float)  # (D, count)
        self._carried: Array = carries * mass
        self._carried_mass: Array = self._carried.sum(axis=1)[:, None]
        effector = model.frames[kin.end_effector_frame]
        self._effector_joint = int(effector.parentJoint)
        self._effector = np.append(effector.placement.translation, 1.0)
        self._carries_effector: Array = carries[:, self._effector_joint]
        before = kin.moved_by[self._tree].T  # before[j, k]: joint k hangs on joint j, or is it
        self._upper: Array = before * ~self._slides[:, None] * 1.0
        self._strict: Array = self._upper * ~np.eye(len(before), dtype=bool)

    def __call__(self, theta: Array, wrench: Array | None = None) -> tuple[Array, Array]:
        """Return load [N·m] (N, D) and ∂load/∂θ [N·m/rad] (N, D, D).

        Args:
            theta: θ [rad], shape (N, D).
            wrench: Force [N] and torque [N·m] on the end effector's origin, axes of the root
                link, shape (N, 6). The torque's share in the gradient is left out.
        """
        poses = self._poses(theta)
        placed = (poses @ self._columns)[..., :3, :]  # (N, count, 3, 3)
        joints = placed[:, self._tree]
        axis, origin, centre = joints[..., 0], joints[..., 1], placed[..., 2]  # (N, D or count, 3)
        moment = self._carried @ centre - self._carried_mass * origin
        spread = moment[..., None] * self._gravity  # R of the weights, (N, D, 3, 3)
        if wrench is not None:
            point = poses[:, self._effector_joint, :3] @ self._effector
            arm = (point[:, None] - origin) * self._carries_effector[:, None]
            spread = spread + arm[..., None] * wrench[:, None, None, :3]
        turning = spread.reshape(*axis.shape[:2], 9) @ CROSS_AND_DOT  # (N, D, 4)
        pull, bend = turning[..., :3], (spread @ axis[..., None])[..., 0] - turning[..., 3:] * axis
        if self._slides.any():
            force = self._force(wrench, len(theta))
            pull = np.where(self._slides[:, None], force, pull)
            bend = np.where(self._slides[:, None], np.cross(axis, force), bend)
        if wrench is not None:
            rotary = self._carries_effector * ~self._slides
            pull = pull + rotary[:, None] * wrench[:, None, 3:]
        torque = (axis * pull).sum(axis=-1)
        slope = axis @ bend.swapaxes(1, 2)
        return -torque, -(slope * self._upper + (slope * self._strict).swapaxes(1, 2))

    def _poses(self, theta: Array) -> Array:
        """Return the pose of every joint in the root link's frame, shape (N, count, 4, 4)."""
        angle = theta[:, self._theta_index, None, None]
        first, second = np.sin(angle), 1.0 - np.cos(angle)
        if self._slides.any():
            slides = self._slides[self._theta_index, None, None]
            first, second = np.where(slides, angle, first), np.where(slides, 0.0, second)
        poses = np.empty((len(theta), *self._fixed.shape))
        poses[:, 0] = self._fixed[0]
        poses[:, 1:] = self._fixed[1:] + first * self._first[1:] + second * self._second[1:]
        for i in range(2, len(self._parent)):
            if self._parent[i] > 0:
                poses[:, i] = poses[:, self._parent[i]] @ poses[:, i]
        return poses

    def _force(self, wrench: Array | None, count: int) -> Array:
        force = np.broadcast_to(self._carried_mass * self._gravity, (count, len(self._tree), 3))
        if wrench is not None:
            force = force + self._carries_effector[:, None] * wrench[:, None, :3]
        return force
