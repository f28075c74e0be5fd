# SPDX-License-Identifier: Apache-2.0
"""The tree of joints: how they hang on each other, and their poses for many postures at once.

The pose of a joint in its parent is its fixed placement times, by Rodrigues,

    exp([a]ₓ θ) = 1 + sin θ [a]ₓ + (1 − cos θ) [a]ₓ²

or 1 + θ a for one that slides: a sum of constant matrices, the same operation for every joint.

A coupled joint of the tree turns by q = ratio · θ_master + offset. With A = ∂q/∂θ, what pinocchio
says of all joints of the tree becomes Aᵀ g, Aᵀ M A and J A.
"""

from collections.abc import Mapping, Sequence
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


class Coupling(NamedTuple):
    """A joint that follows another: q = ratio · θ_master + offset."""

    master: str  # a joint that follows none
    ratio: float
    offset: float  # [rad] or [m]


def resolved(couplings: Mapping[str, Coupling]) -> dict[str, Coupling]:
    """Return couplings to joints that follow none; a ValueError names one that follows itself."""
    result = {}
    for slave, (master, ratio, offset) in couplings.items():
        seen = {slave}
        while master in couplings:
            if master in seen:
                told = f'joint {slave!r} follows itself, over {", ".join(sorted(seen))}'
                raise ValueError(told)
            seen.add(master)
            master, gear, shift = couplings[master]
            ratio, offset = ratio * gear, ratio * shift + offset
        result[slave] = Coupling(master, ratio, offset)
    return result


def joint_axis(joint: pin.JointModel) -> Array:
    """Return the axis (3,) of a revolute or prismatic joint."""
    data = joint.createData()
    joint.calc(data, np.zeros(joint.idx_q + 1))
    return np.ravel(data.S).reshape(2, 3)[0 if joint.shortname() in PRISMATIC else 1]


class JointTree:
    """The joints of a pinocchio model, by pinocchio's number; 0 is the root link.

    Attributes:
        order: Position in pinocchio's q and v of each entry of θ, (D,).
        parent: Of each joint, (J,).
        placement_rotation: Fixed placement in the parent, (J, 3, 3).
        placement_translation: The same [m], (J, 3).
        prismatic: Whether a joint slides, (J,).
        local_axis: In the joint's own frame, (J, 3).
        placements: Fixed placement in the parent, homogeneous, (J, 4, 4).
        first: The pose in the parent is placement + a(θ) · first + b(θ) · second, (J, 4, 4).
        second: See `first`.
        theta_index: Position in θ of what moves a joint, -1 for the root link, (J,).
        ratio: Of q = ratio · θ + offset, (J,).
        offset: See `ratio`.
        transmission: A = ∂q/∂θ (J−1, D), rows in pinocchio's order; None where every joint is its
            own master.
        hangs_on: hangs_on[i, j]: joint i is joint j, or hangs on it, (J, J).
    """

    def __init__(
        self, model: pin.Model, joints: Sequence[str], couplings: Mapping[str, Coupling]
    ) -> None:
        """Take the tree of a model whose joints are those of θ and those coupled to them."""
        count, ids = model.njoints, [model.getJointId(name) for name in joints]

        self.order = np.array([model.joints[i].idx_q for i in ids])
        self.parent = np.array(model.parents)
        #: joints whose parent is another one, with that
        self._hanging = [(i, parent) for i, parent in enumerate(self.parent.tolist()) if parent > 0]
        self.placement_rotation = np.stack([m.rotation for m in model.jointPlacements])
        self.placement_translation = np.stack([m.translation for m in model.jointPlacements])
        self.prismatic = np.array([joint.shortname() in PRISMATIC for joint in model.joints])
        self.local_axis = np.zeros((count, 3))
        self.placements = np.stack([m.homogeneous for m in model.jointPlacements])
        self.first, self.second = np.zeros((2, count, 4, 4))
        for i, turn in enumerate(self.placement_rotation[1:], 1):
            axis = joint_axis(model.joints[i])
            self.local_axis[i], cross = axis, pin.skew(axis)
            if self.prismatic[i]:
                self.first[i, :3, 3] = turn @ axis
            else:
                self.first[i, :3, :3], self.second[i, :3, :3] = turn @ cross, turn @ cross @ cross
        self.theta_index = np.full(count, -1)
        self.ratio, self.offset = np.ones(count), np.zeros(count)
        self.theta_index[ids] = np.arange(len(ids))
        for name, coupling in couplings.items():
            i = model.getJointId(name)
            self.theta_index[i] = list(joints).index(coupling.master)
            self.ratio[i], self.offset[i] = coupling.ratio, coupling.offset
        self.transmission: Array | None = None
        if couplings:
            self.transmission = np.zeros((count - 1, len(ids)))
            self.transmission[np.arange(count - 1), self.theta_index[1:]] = self.ratio[1:]
        self.hangs_on = np.eye(count, dtype=bool)
        for i in range(1, count):
            self.hangs_on[i] |= self.hangs_on[self.parent[i]]

    def in_parents(self, theta: Array) -> Array:
        """Return homogeneous poses (N, J, 4, 4) of joints in their parents; θ (N, D)."""
        angle = theta[:, self.theta_index, None, None]
        if self.transmission is not None:
            angle = self.ratio[:, None, None] * angle + self.offset[:, None, None]
        first, second = np.sin(angle), 1.0 - np.cos(angle)
        if self.prismatic.any():
            slides = self.prismatic[:, None, None]
            first, second = np.where(slides, angle, first), np.where(slides, 0.0, second)
        return self.placements + first * self.first + second * self.second

    def transforms(self, theta: Array) -> Array:
        """Return homogeneous poses (N, J, 4, 4) in the root link's frame, index 0; θ (N, D)."""
        poses = self.in_parents(theta)
        for i, parent in self._hanging:
            poses[:, i] = poses[:, parent] @ poses[:, i]
        return poses

    def joint_poses(self, theta: Array) -> JointPoses:
        """Return the poses of all joints in parts, for θ of shape (N, D)."""
        poses = self.transforms(theta)
        rotation = poses[..., :3, :3]
        axis = np.einsum('njab,jb->nja', rotation, self.local_axis)
        return JointPoses(rotation, poses[..., :3, 3], axis)

    def angles(self, theta: Array) -> Array:
        """Return q (..., J−1) of the tree's joints in pinocchio's order; θ (..., D)."""
        q: Array = theta[..., self.theta_index[1:]]
        return q if self.transmission is None else self.ratio[1:] * q + self.offset[1:]

    def of_theta(self, values: Array) -> Array:
        """Return what belongs to θ (..., D) of torques or derivatives for q (..., J−1)."""
        if self.transmission is None:
            mine: Array = values[..., self.order]
            return mine
        return values @ self.transmission
