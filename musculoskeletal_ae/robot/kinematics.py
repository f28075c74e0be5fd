# SPDX-License-Identifier: Apache-2.0
"""Kinematics and gravity of the arm, by pinocchio, in the order of θ that muscles.yaml gives.

Pinocchio reads the URDF and answers for single postures. Training asks for the link poses of many
thousand postures at once; those are computed here with numpy over pinocchio's own joint placements
and axes (a test holds the two together).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array

REVOLUTE = ('JointModelRX', 'JointModelRY', 'JointModelRZ', 'JointModelRevoluteUnaligned')
PRISMATIC = ('JointModelPX', 'JointModelPY', 'JointModelPZ', 'JointModelPrismaticUnaligned')


class JointPoses(NamedTuple):
    """World poses of pinocchio's joints for N postures; index 0 is the root link.

    Attributes:
        rotation: Shape (N, J, 3, 3).
        translation: Joint origins [m], shape (N, J, 3).
        axis: Joint axes in the root link's frame, shape (N, J, 3); index 0 is unused.
    """

    rotation: Array
    translation: Array
    axis: Array


class Kinematics:
    """Rigid-body side of a robot: link poses, gravity torque and end-effector Jacobian."""

    def __init__(self, full_model: pin.Model, joints: tuple[str, ...], end_effector: str) -> None:
        """Keep the listed joints of a model and lock all others at zero.

        Args:
            full_model: Pinocchio model of the whole URDF (fixed base).
            joints: Names of the D joints, in the order of θ; checked by the description.
            end_effector: Link that carries the marker and is pushed.
        """
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
        self._read_tree(ids)

    def _read_tree(self, ids: list[int]) -> None:
        joint_count = self.model.njoints
        self.parent = np.array(self.model.parents)
        self.placement_rotation = np.stack([m.rotation for m in self.model.jointPlacements])
        self.placement_translation = np.stack([m.translation for m in self.model.jointPlacements])
        self.local_axis = np.zeros((joint_count, 3))
        self.prismatic = np.zeros(joint_count, dtype=bool)
        pin.computeJointJacobians(self.model, self.data, pin.neutral(self.model))
        for i in range(1, joint_count):
            local = pin.getJointJacobian(self.model, self.data, i, pin.ReferenceFrame.LOCAL)
            # pinocchio returns one column as a plain vector
            subspace = local.reshape(6, -1)[:, self.model.joints[i].idx_v]
            self.prismatic[i] = self.model.joints[i].shortname() in PRISMATIC
            self.local_axis[i] = subspace[:3] if self.prismatic[i] else subspace[3:]
        #: position in θ of joint i of pinocchio's tree
        self.theta_index = np.full(joint_count, -1)
        self.theta_index[ids] = np.arange(len(ids))
        #: moved_by[i, k]: joint i of the tree hangs on joint k of θ
        self.moved_by = np.zeros((joint_count, len(ids)), dtype=bool)
        for i in range(1, joint_count):
            self.moved_by[i] = self.moved_by[self.parent[i]]
            self.moved_by[i, self.theta_index[i]] = True

    def link_attachment(self, link: str) -> tuple[int, Array, Array]:
        """Return (joint of the tree, rotation, translation) that carries a link's frame."""
        frame = self.model.frames[self.model.getFrameId(link, pin.FrameType.BODY)]
        return frame.parentJoint, frame.placement.rotation, frame.placement.translation

    def joint_poses(self, theta: Array) -> JointPoses:
        """Return the world poses of all joints for θ of shape (N, D)."""
        count, joints = len(theta), len(self.parent)
        rotation = np.zeros((count, joints, 3, 3))
        translation = np.zeros((count, joints, 3))
        axis = np.zeros((count, joints, 3))
        rotation[:, 0] = np.eye(3)
        for i in range(1, joints):
            up = self.parent[i]
            angle = theta[:, self.theta_index[i]]
            local = rotation[:, up] @ self.placement_rotation[i]
            offset = rotation[:, up] @ self.placement_translation[i]
            axis[:, i] = local @ self.local_axis[i]
            translation[:, i] = translation[:, up] + offset
            if self.prismatic[i]:
                rotation[:, i] = local
                translation[:, i] += axis[:, i] * angle[:, None]
            else:
                rotation[:, i] = local @ _axis_rotation(self.local_axis[i], angle)
        return JointPoses(rotation, translation, axis)

    def _q(self, theta: Array) -> Array:
        q = np.empty(self.model.nq)
        q[self.order] = theta
        return q

    def holding_torque(self, theta: Array) -> Array:
        """Return g(θ), the joint torque that holds the arm's own weight [N·m], shape (..., D)."""
        if theta.ndim > 1:
            return np.stack([self.holding_torque(row) for row in theta])
        gravity = pin.computeGeneralizedGravity(self.model, self.data, self._q(theta))
        torque: Array = gravity[self.order]
        return torque

    def joint_inertia(self, theta: Array) -> Array:
        """Return what each joint moves, the others held [kg·m² or kg]: (..., D) as θ."""
        if theta.ndim > 1:
            return np.stack([self.joint_inertia(row) for row in theta])
        inertia: Array = np.diag(pin.crba(self.model, self.data, self._q(theta)))[self.order]
        return inertia

    def end_effector_jacobian(self, theta: Array) -> Array:
        """Return J (6, D): rows linear [m/rad] then angular, at the end effector's origin.

        Axes are those of the root link, so a wrench F there is the joint torque Jᵀ F.
        """
        jacobian = pin.computeFrameJacobian(
            self.model,
            self.data,
            self._q(theta),
            self.end_effector_frame,
            pin.ReferenceFrame.LOCAL_WORLD_ALIGNED,
        )
        columns: Array = jacobian.reshape(6, -1)[:, self.order]
        return columns

    def end_effector_pose(self, theta: Array) -> pin.SE3:
        """Return the pose of the end effector in the root link's frame."""
        pin.forwardKinematics(self.model, self.data, self._q(theta))
        return pin.updateFramePlacement(self.model, self.data, self.end_effector_frame).copy()


def _axis_rotation(axis: Array, angle: Array) -> Array:
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    rotation: Array = np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross)
    return rotation
