# SPDX-License-Identifier: Apache-2.0
"""Kinematics and gravity of the arm, by pinocchio, in the order of θ that muscles.yaml gives.

Pinocchio reads the URDF and answers for single postures. Training and simulation ask for the poses
of thousands at once; those are computed here with numpy (a test holds the two together). The pose
of a joint in its parent is its fixed placement times, by Rodrigues,

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
#: [m] that a joint slides count as one radian of one that turns, wherever both are judged alike:
#: the radius of the pinion by which a joint module moves what slides; chosen
RACK = 0.06


class Units(NamedTuple):
    """In what one joint's θ, torque and stiffness are."""

    theta: str
    torque: str
    stiffness: str


TURNS, SLIDES = Units('rad', 'N·m', 'N·m/rad'), Units('m', 'N', 'N/m')


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


def body_frames(model: pin.Model) -> list[pin.Frame]:
    """Return the frames of a model's links."""
    return [frame for frame in model.frames if frame.type == pin.FrameType.BODY]


def link_placement(model: pin.Model, link: str) -> tuple[int, pin.SE3]:
    """Return the joint of the tree that carries a link, and the link's pose in its frame."""
    frame = model.frames[model.getFrameId(link, pin.FrameType.BODY)]
    return int(frame.parentJoint), frame.placement


def reduced(model: pin.Model, locked: Sequence[int], at: Array) -> pin.Model:
    """Return a model with joints locked; a link may have the name of a joint, or be 'universe'.

    Pinocchio looks frames up by name alone there, and refuses or mistakes those that share one.
    """
    named, names = model.copy(), dict[str, str]()
    for i, frame in enumerate(named.frames):
        if i and frame.type != pin.FrameType.JOINT:
            names[f'{i} {frame.name}'] = frame.name
            frame.name = f'{i} {frame.name}'
    result = pin.buildReducedModel(named, locked, at)
    for frame in result.frames:
        frame.name = names.get(frame.name, frame.name)
    return result


def joint_space_inertia(model: pin.Model, data: pin.Data, q: Array) -> Array:
    """Return M [kg·m² or kg] (J−1, J−1); pinocchio fills its upper half only."""
    upper = np.triu(pin.crba(model, data, q))
    return upper + np.triu(upper, 1).T


def joint_axis(joint: pin.JointModel) -> Array:
    """Return the axis (3,) of a revolute or prismatic joint."""
    data = joint.createData()
    joint.calc(data, np.zeros(joint.idx_q + 1))
    return np.ravel(data.S).reshape(2, 3)[0 if joint.shortname() in PRISMATIC else 1]


class Kinematics:
    """Rigid-body side of a robot: link poses, gravity torque and end-effector Jacobian."""

    def __init__(
        self,
        full_model: pin.Model,
        joints: Sequence[str],
        end_effector: str,
        couplings: Mapping[str, Coupling] | None = None,
    ) -> None:
        """Keep D joints of a URDF's model, in the order of θ, and what follows them.

        All others are locked at zero, or where they are when their master is.
        """
        couplings = couplings or {}
        followers = [name for name, coupling in couplings.items() if coupling.master in joints]
        kept, still = [*joints, *followers], pin.neutral(full_model)
        for name, coupling in couplings.items():
            if name not in followers:
                still[full_model.joints[full_model.getJointId(name)].idx_q] = coupling.offset
        locked = [full_model.getJointId(name) for name in full_model.names[1:] if name not in kept]
        self.model = reduced(full_model, locked, still)
        self.data = self.model.createData()
        ids = [self.model.getJointId(name) for name in joints]
        #: index into pinocchio's q and v for each entry of θ
        self.order = np.array([self.model.joints[i].idx_q for i in ids])
        self.lower: Array = self.model.lowerPositionLimit[self.order].copy()
        self.upper: Array = self.model.upperPositionLimit[self.order].copy()
        self._end_effector = end_effector
        self.end_effector_frame = self.model.getFrameId(end_effector, pin.FrameType.BODY)
        count = self.model.njoints
        self.parent = np.array(self.model.parents)
        #: joints whose parent is another one, with that
        self._hanging = [(i, parent) for i, parent in enumerate(self.parent.tolist()) if parent > 0]
        self.placement_rotation = np.stack([m.rotation for m in self.model.jointPlacements])
        self.placement_translation = np.stack([m.translation for m in self.model.jointPlacements])
        self.prismatic = np.array([joint.shortname() in PRISMATIC for joint in self.model.joints])
        #: of each joint of θ, (D,): whether it slides, what counts as a radian of it, its units
        self.slides = self.prismatic[ids]
        self.radian: Array = np.where(self.slides, RACK, 1.0)
        self.units = tuple(SLIDES if slides else TURNS for slides in self.slides)
        #: what a distance between postures is measured in, for people
        self.distance_unit = ' and '.join(sorted({unit.theta for unit in self.units}, reverse=True))
        self.local_axis = np.zeros((count, 3))
        # Pose in the parent = placement + a(θ) · first + b(θ) · second.
        self.placements = np.stack([m.homogeneous for m in self.model.jointPlacements])
        self.first, self.second = np.zeros((2, count, 4, 4))
        for i, turn in enumerate(self.placement_rotation[1:], 1):
            axis = joint_axis(self.model.joints[i])
            self.local_axis[i], cross = axis, pin.skew(axis)
            if self.prismatic[i]:
                self.first[i, :3, 3] = turn @ axis
            else:
                self.first[i, :3, :3], self.second[i, :3, :3] = turn @ cross, turn @ cross @ cross
        #: joints of pinocchio's tree: those of θ in its order, then the coupled ones
        self.tree = np.array([*ids, *(self.model.getJointId(name) for name in followers)])
        #: position in θ of joint i of the tree, and q_i = ratio · θ + offset, each (J,)
        self.theta_index = np.full(count, -1)
        self.ratio, self.offset = np.ones(count), np.zeros(count)
        self.theta_index[ids] = np.arange(len(ids))
        for name in followers:
            i, coupling = self.model.getJointId(name), couplings[name]
            self.theta_index[i] = list(joints).index(coupling.master)
            self.ratio[i], self.offset[i] = coupling.ratio, coupling.offset
        #: A = ∂q/∂θ (J−1, D), rows in the order of the tree; None where every joint is its own
        self.transmission: Array | None = None
        if followers:
            self.transmission = np.zeros((count - 1, len(ids)))
            self.transmission[np.arange(count - 1), self.theta_index[1:]] = self.ratio[1:]
        #: hangs_on[i, j]: joint i of the tree is or hangs on joint j of the tree
        self.hangs_on = np.eye(count, dtype=bool)
        for i in range(1, count):
            self.hangs_on[i] |= self.hangs_on[self.parent[i]]

    def attach(self, link: str, xyz: Array) -> tuple[int, Array]:
        """Return the joint of the tree that carries a link's point, and the point in its frame."""
        joint, placement = self.placement(link)
        return joint, placement.act(xyz)

    def placement(self, link: str) -> tuple[int, pin.SE3]:
        """Return the joint of the tree that carries a link, and the link's pose in its frame."""
        return link_placement(self.model, link)

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

    def tree_angles(self, theta: Array) -> Array:
        """Return q (..., J−1) of the tree's joints in pinocchio's order; θ (..., D)."""
        q: Array = theta[..., self.theta_index[1:]]
        return q if self.transmission is None else self.ratio[1:] * q + self.offset[1:]

    def of_theta(self, values: Array) -> Array:
        """Return what belongs to θ (..., D) of torques or derivatives for q (..., J−1)."""
        if self.transmission is None:
            mine: Array = values[..., self.order]
            return mine
        return values @ self.transmission

    def holding_torque(self, theta: Array) -> Array:
        """Return g(θ), the joint torque that holds the arm's own weight [N·m], shape (..., D)."""
        if theta.ndim > 1:
            return np.stack([self.holding_torque(row) for row in theta])
        return self.of_theta(
            pin.computeGeneralizedGravity(self.model, self.data, self.tree_angles(theta))
        )

    def inverse_dynamics(self, theta: Array, velocity: Array, acceleration: Array) -> Array:
        """Return M(θ) θ̈ + h(θ, θ̇), the joint torque of a motion [N·m], shape (D,)."""
        rates = self.ratio[1:] * np.array([velocity, acceleration])[:, self.theta_index[1:]]
        return self.of_theta(pin.rnea(self.model, self.data, self.tree_angles(theta), *rates))

    def gravity_gradient(self, theta: Array) -> Array:
        """Return ∂g/∂θ [N·m/rad], shape (D, D), at θ (D,)."""
        q = self.tree_angles(theta)
        gradient = pin.computeGeneralizedGravityDerivatives(self.model, self.data, q)
        return self.of_theta(self.of_theta(gradient).T).T

    def joint_inertia(self, theta: Array) -> Array:
        """Return what each joint moves, the others held [kg·m² or kg], shape (D,), at θ (D,)."""
        inertia = joint_space_inertia(self.model, self.data, self.tree_angles(theta))
        return np.diag(self.of_theta(self.of_theta(inertia).T))

    def end_effector_jacobian(self, theta: Array) -> Array:
        """Return J (6, D): rows linear [m/rad] then angular, at the end effector's origin.

        Axes are those of the root link, so a wrench F there is the joint torque Jᵀ F.
        """
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        q, frame = self.tree_angles(theta), self.end_effector_frame
        jacobian = pin.computeFrameJacobian(self.model, self.data, q, frame, axes)
        return self.of_theta(jacobian.reshape(6, -1))

    def link_pose(self, theta: Array, link: str) -> pin.SE3:
        """Return the pose of a link in the root link's frame."""
        frame = self.model.getFrameId(link, pin.FrameType.BODY)
        pin.forwardKinematics(self.model, self.data, self.tree_angles(theta))
        return pin.updateFramePlacement(self.model, self.data, frame).copy()

    def end_effector_pose(self, theta: Array) -> pin.SE3:
        """Return the pose of the end effector in the root link's frame."""
        return self.link_pose(theta, self._end_effector)
