# SPDX-License-Identifier: Apache-2.0
"""Kinematics and gravity of the arm, by pinocchio, in the order of θ that muscles.yaml gives.

Pinocchio reads the URDF and answers for single postures. Training and simulation ask for the poses
of thousands at once; those are computed here with numpy (a test holds the two together). The pose
of a joint in its parent is its fixed placement times, by Rodrigues,

    exp([a]ₓ θ) = 1 + sin θ [a]ₓ + (1 − cos θ) [a]ₓ²

or 1 + θ a for one that slides: a sum of constant matrices, the same operation for every joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array

REVOLUTE = ('JointModelRX', 'JointModelRY', 'JointModelRZ', 'JointModelRevoluteUnaligned')
PRISMATIC = ('JointModelPX', 'JointModelPY', 'JointModelPZ', 'JointModelPrismaticUnaligned')


class JointPoses(NamedTuple):
    """Poses of pinocchio's joints in the root link's frame for N postures; index 0 is that link."""

    rotation: Array  # (N, J, 3, 3)
    translation: Array  # joint origins [m], (N, J, 3)
    axis: Array  # (N, J, 3); zero at index 0


class Kinematics:
    """Rigid-body side of a robot: link poses, gravity torque and end-effector Jacobian."""

    def __init__(self, full_model: pin.Model, joints: Sequence[str], end_effector: str) -> None:
        """Keep D joints of a URDF's model, in the order of θ; lock all others at zero."""
        locked = [
            full_model.getJointId(name) for name in full_model.names[1:] if name not in joints
        ]
        self.model = pin.buildReducedModel(full_model, locked, pin.neutral(full_model))
        self.data = self.model.createData()
        ids = [self.model.getJointId(name) for name in joints]
        #: index into pinocchio's q and v for each entry of θ
        self.order = np.array([self.model.joints[i].idx_q for i in ids])
        self.lower: Array = self.model.lowerPositionLimit[self.order].copy()
        self.upper: Array = self.model.upperPositionLimit[self.order].copy()
        self.end_effector_frame = self.model.getFrameId(end_effector, pin.FrameType.BODY)
        count = self.model.njoints
        self.parent = np.array(self.model.parents)
        self.placement_rotation = np.stack([m.rotation for m in self.model.jointPlacements])
        self.placement_translation = np.stack([m.translation for m in self.model.jointPlacements])
        self.prismatic = np.array([joint.shortname() in PRISMATIC for joint in self.model.joints])
        self.local_axis = np.zeros((count, 3))
        # Pose in the parent = placement + a(θ) · first + b(θ) · second.
        self._placement = np.stack([m.homogeneous for m in self.model.jointPlacements])
        self._first, self._second = np.zeros((2, count, 4, 4))
        for i, turn in enumerate(self.placement_rotation[1:], 1):
            joint = self.model.joints[i].createData()
            self.model.joints[i].calc(joint, pin.neutral(self.model))
            axis = np.ravel(joint.S).reshape(2, 3)[0 if self.prismatic[i] else 1]
            self.local_axis[i], cross = axis, pin.skew(axis)
            if self.prismatic[i]:
                self._first[i, :3, 3] = turn @ axis
            else:
                self._first[i, :3, :3], self._second[i, :3, :3] = turn @ cross, turn @ cross @ cross
        #: position in θ of joint i of pinocchio's tree
        self.theta_index = np.full(count, -1)
        self.theta_index[ids] = np.arange(len(ids))
        #: moved_by[i, k]: joint i of the tree hangs on joint k of θ
        self.moved_by = np.zeros((count, len(ids)), dtype=bool)
        for i in range(1, count):
            self.moved_by[i] = self.moved_by[self.parent[i]]
            self.moved_by[i, self.theta_index[i]] = True

    def attach(self, link: str, xyz: Array) -> tuple[int, Array]:
        """Return the joint of the tree that carries a link's point, and the point in its frame."""
        frame = self.model.frames[self.model.getFrameId(link, pin.FrameType.BODY)]
        return frame.parentJoint, frame.placement.act(xyz)

    def in_parents(self, theta: Array) -> Array:
        """Return homogeneous poses (N, J, 4, 4) of joints in their parents; θ (N, D)."""
        angle = theta[:, self.theta_index[1:], None, None]
        first, second = np.sin(angle), 1.0 - np.cos(angle)
        if self.prismatic.any():
            slides = self.prismatic[1:, None, None]
            first, second = np.where(slides, angle, first), np.where(slides, 0.0, second)
        poses = np.empty((len(theta), *self._placement.shape))
        poses[:, 0] = self._placement[0]
        poses[:, 1:] = self._placement[1:] + first * self._first[1:] + second * self._second[1:]
        return poses

    def transforms(self, theta: Array) -> Array:
        """Return homogeneous poses (N, J, 4, 4) in the root link's frame, index 0; θ (N, D)."""
        poses = self.in_parents(theta)
        for i in range(2, len(self.parent)):
            if self.parent[i] > 0:
                poses[:, i] = poses[:, self.parent[i]] @ poses[:, i]
        return poses

    def joint_poses(self, theta: Array) -> JointPoses:
        """Return the poses of all joints in parts, for θ of shape (N, D)."""
        poses = self.transforms(theta)
        rotation = poses[..., :3, :3]
        axis = np.einsum('njab,jb->nja', rotation, self.local_axis)
        return JointPoses(rotation, poses[..., :3, 3], axis)

    def _q(self, theta: Array) -> Array:
        q = np.empty(self.model.nq)
        q[self.order] = theta
        return q

    def holding_torque(self, theta: Array) -> Array:
        """Return g(θ), the joint torque that holds the arm's own weight [N·m], shape (..., D)."""
        if theta.ndim > 1:
            return np.stack([self.holding_torque(row) for row in theta])
        return pin.computeGeneralizedGravity(self.model, self.data, self._q(theta))[self.order]

    def gravity_gradient(self, theta: Array) -> Array:
        """Return ∂g/∂θ [N·m/rad], shape (D, D), at θ (D,)."""
        gradient = pin.computeGeneralizedGravityDerivatives(self.model, self.data, self._q(theta))
        return gradient[np.ix_(self.order, self.order)]

    def joint_inertia(self, theta: Array) -> Array:
        """Return what each joint moves, the others held [kg·m² or kg], shape (D,), at θ (D,)."""
        return np.diag(pin.crba(self.model, self.data, self._q(theta)))[self.order]

    def end_effector_jacobian(self, theta: Array) -> Array:
        """Return J (6, D): rows linear [m/rad] then angular, at the end effector's origin.

        Axes are those of the root link, so a wrench F there is the joint torque Jᵀ F.
        """
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        q, frame = self._q(theta), self.end_effector_frame
        jacobian = pin.computeFrameJacobian(self.model, self.data, q, frame, axes)
        return jacobian.reshape(6, -1)[:, self.order]

    def end_effector_pose(self, theta: Array) -> pin.SE3:
        """Return the pose of the end effector in the root link's frame."""
        pin.forwardKinematics(self.model, self.data, self._q(theta))
        return pin.updateFramePlacement(self.model, self.data, self.end_effector_frame).copy()
