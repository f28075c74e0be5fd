# SPDX-License-Identifier: Apache-2.0
"""Rigid-body kinematics and dynamics of the arm, with θ in the order of muscles.yaml.

Pinocchio reads the URDF and computes link poses, gravity, inertia and Jacobians of single postures.
Training, learning and the view need the poses of thousands of postures, which `joint_tree.py`
computes from the same placements. A test checks that pinocchio and `joint_tree.py` agree.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.joint_elasticity import JointElasticity
from musculoskeletal_ae.robot.joint_tree import Coupling, JointTree
from musculoskeletal_ae.robot.joint_units import JointUnits


def body_frames(model: pin.Model) -> list[pin.Frame]:
    """Return the frames of a model's links."""
    return [frame for frame in model.frames if frame.type == pin.FrameType.BODY]


def link_placement(model: pin.Model, link: str) -> tuple[int, pin.SE3]:
    """Return the joint that carries a link, and the link's pose in the frame of the joint."""
    frame = model.frames[model.getFrameId(link, pin.FrameType.BODY)]
    return int(frame.parentJoint), frame.placement


def reduced(model: pin.Model, locked: Sequence[int], at: Array) -> pin.Model:
    """Return a copy of the model in which the joints in `locked` are fixed.

    A link may have the name of a joint, or be called 'universe'. `buildReducedModel` looks frames
    up by name and would reject or confuse such frames, so all frames get unique names meanwhile.

    Args:
        model: The model, which is not changed.
        locked: Indices of the joints to fix.
        at: Positions of all joints; those in `locked` are fixed at theirs.
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
    """Return the joint-space inertia [kg·m² or kg] of all joints of the tree, (J−1, J−1).

    J counts the root link as joint 0 (`JointTree`). `q` are the positions of the joints, (J−1,).
    """
    # Add the lower triangle, which pinocchio does not fill.
    upper = np.triu(pin.crba(model, data, q))
    return upper + np.triu(upper, 1).T


class Kinematics:
    """Link poses, end-effector Jacobian, inertia and joint torques of a robot."""

    def __init__(
        self,
        full_model: pin.Model,
        joints: Sequence[str],
        end_effector: str,
        couplings: Mapping[str, Coupling] | None = None,
        elasticity: JointElasticity | None = None,
    ) -> None:
        """Reduce a URDF's model to the joints of θ and the joints coupled to them.

        All other joints are locked at zero. A joint that is coupled to a locked joint is locked at
        the offset of its coupling.

        Args:
            full_model: Model of the whole URDF.
            joints: The D joints of θ, in order.
            end_effector: Link for poses and external wrenches.
            couplings: Coupling of each coupled joint; their terms refer to positions.
            elasticity: Springs and dampers of the joints; None if there are none.
        """
        #: springs and dampers of the joints
        self.elasticity = elasticity or JointElasticity.none(len(joints))
        couplings = couplings or {}
        followers = [name for name, coupling in couplings.items() if coupling.master in joints]
        kept, still = [*joints, *followers], pin.neutral(full_model)
        for name, coupling in couplings.items():
            if name not in followers:
                still[full_model.joints[full_model.getJointId(name)].idx_q] = coupling.terms[0]
        locked = [full_model.getJointId(name) for name in full_model.names[1:] if name not in kept]
        self.model = reduced(full_model, locked, still)
        self.data = self.model.createData()
        ids = [self.model.getJointId(name) for name in joints]
        order = np.array([self.model.joints[i].idx_q for i in ids])
        #: units of the joints of θ
        self.units = JointUnits.of_model(self.model, joints)
        self.lower: Array = self.units.to_theta(self.model.lowerPositionLimit[order])
        self.upper: Array = self.units.to_theta(self.model.upperPositionLimit[order])
        self._end_effector = end_effector
        self.end_effector_frame = self.model.getFrameId(end_effector, pin.FrameType.BODY)
        own = {name: couplings[name] for name in followers}
        self.tree = JointTree(self.model, self.units, own)

    def attach(self, link: str, xyz: Array) -> tuple[int, Array]:
        """Return the joint that carries a link, and a point of the link in the frame of the joint.

        Args:
            link: Name of the link.
            xyz: The point in the frame of the link [m], (3,).

        Returns:
            Index of the joint, and the point in the frame of the joint [m], (3,).
        """
        joint, placement = self.placement(link)
        return joint, placement.act(xyz)

    def placement(self, link: str) -> tuple[int, pin.SE3]:
        """Return the joint that carries a link, and the link's pose in the frame of the joint."""
        return link_placement(self.model, link)

    def with_elasticity(self, elasticity: JointElasticity) -> Kinematics:
        """Return a copy with other springs and dampers."""
        changed = copy.copy(self)
        changed.elasticity = elasticity
        return changed

    def holding_torque(self, theta: Array) -> Array:
        """Return the torque that holds the arm against its weight and its springs.

            g(θ) + K θ − b + h(θ)

        g(θ) holds the weight, K θ − b the springs of the joints, and h(θ) passive tendons
        (`JointElasticity`).

        Args:
            theta: Joint angles θ [rad], (..., D).

        Returns:
            The torque [N·m], (..., D).
        """
        weight = self.weight_torque(theta)
        if not self.elasticity.is_present:
            return weight
        return weight + self.elasticity.holding_torque(theta)

    def weight_torque(self, theta: Array) -> Array:
        """Return the torque that holds the weight of the arm [N·m], (..., D), at θ (..., D)."""
        if theta.ndim > 1:
            return np.stack([self.weight_torque(row) for row in theta])
        return self.tree.of_theta(self._gravity(theta), theta)

    def _gravity(self, theta: Array) -> Array:
        """Return the torque of every joint of the tree that holds the weight [N·m], (J−1,).

        `theta` are the joint angles θ [rad], (D,), from which those of coupled joints follow.
        """
        q = self.tree.angles(theta)
        return np.array(pin.computeGeneralizedGravity(self.model, self.data, q))

    def inverse_dynamics(self, theta: Array, velocity: Array, acceleration: Array) -> Array:
        """Return the joint torque that a motion requires [N·m], (D,).

            M(θ) θ̈ + c(θ, θ̇) + K θ − b + h(θ) + diag(d) θ̇

        M is the inertia, and c the torque of weight and velocity. The other terms are those of the
        springs, passive tendons and dampers of the joints (`JointElasticity`).

        Args:
            theta: Joint angles θ [rad], (D,).
            velocity: Joint velocities θ̇ [rad/s], (D,).
            acceleration: Joint accelerations θ̈ [rad/s²], (D,).
        """
        tree, rates = self.tree, np.array([velocity, acceleration])[:, self.tree.theta_index[1:]]
        if tree.is_geared:
            squared_velocity = rates[0] ** 2
            rates = tree.ratios(theta) * rates
            rates[1] += tree.curvatures(theta) * squared_velocity
        torque = pin.rnea(self.model, self.data, tree.angles(theta), *rates)
        result, elasticity = tree.of_theta(torque, theta), self.elasticity
        if elasticity.is_present:
            result = result + elasticity.holding_torque(theta) + elasticity.damping * velocity
        return result

    def holding_gradient(self, theta: Array) -> Array:
        """Return the derivative of `holding_torque` with respect to θ [N·m/rad], (D, D), at θ (D,).

        It is the sum of the derivative of the weight's torque and the stiffness of the springs.
        """
        tree, q = self.tree, self.tree.angles(theta)
        gradient = pin.computeGeneralizedGravityDerivatives(self.model, self.data, q)
        result = tree.of_both(gradient, theta)
        if tree.is_nonlinear:
            of_curvature = self._gravity(theta) * tree.curvatures(theta)
            result = result + np.diag(of_curvature @ tree.moved_by)
        return result + self.elasticity.stiffness_at(theta)

    def joint_inertia(self, theta: Array) -> Array:
        """Return the inertia that each joint moves while all other joints are held [kg·m²], (D,).

        `theta` are the joint angles [rad], (D,).
        """
        inertia = joint_space_inertia(self.model, self.data, self.tree.angles(theta))
        return np.diag(self.tree.of_both(inertia, theta))

    def end_effector_jacobian(self, theta: Array) -> Array:
        """Return the Jacobian J of the end effector's origin, in the axes of the root link, (6, D).

        The first three rows are linear [m/rad], the last three angular [rad/rad]. A wrench F on the
        origin produces the joint torque Jᵀ F. `theta` are the joint angles [rad], (D,).
        """
        axes, tree = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED, self.tree
        q, frame = tree.angles(theta), self.end_effector_frame
        jacobian = pin.computeFrameJacobian(self.model, self.data, q, frame, axes)
        jacobian = jacobian.reshape(6, -1)
        return jacobian @ tree.transmission(theta) if tree.is_geared else jacobian[:, tree.order]

    def link_pose(self, theta: Array, link: str) -> pin.SE3:
        """Return the pose of a link in the root link's frame at θ (D,)."""
        frame = self.model.getFrameId(link, pin.FrameType.BODY)
        pin.forwardKinematics(self.model, self.data, self.tree.angles(theta))
        return pin.updateFramePlacement(self.model, self.data, frame).copy()

    def end_effector_pose(self, theta: Array) -> pin.SE3:
        """Return the pose of the end effector in the root link's frame at θ (D,)."""
        return self.link_pose(theta, self._end_effector)
