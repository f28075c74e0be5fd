# SPDX-License-Identifier: Apache-2.0
"""What gravity and a push ask of the joints of one arm, and how that changes, compiled by numba.

    load(θ) = g(θ) − Jᵀ F

(paper, section "Simulation": the necessary torque from the geometric model). Pinocchio answers the
same, a test holds the two together; but it has no gradient with a push, and from Python takes as
long as all the rest of a step. With forces f_i at points c_i, every joint k at o_k with axis a_k
needs only sums over what it carries:

    τ_k       = a_k · Σ (c_i − o_k) × f_i
    ∂τ_k/∂θ_j = a_j · Σ f_i × ((c_i − o_k) × a_k)        for j at or before k, and symmetric
"""

import math
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.compiler import njit
from musculoskeletal_ae.robot.kinematics import Kinematics
from musculoskeletal_ae.robot.wrapping import Vector, cross, dot, plus, turned


class Tree(NamedTuple):
    """Pinocchio's joints, joint 0 being the root link, and the bodies that they carry."""

    parent: Ints  # (J,)
    master: Ints  # place in θ of what turns a joint, by q = ratio · θ + offset
    ratio: Array
    offset: Array
    slides: Bools
    #: pose in the parent = placement + sin q · first + (1 − cos q) · second, each (J, 4, 4);
    #: placement + q · first where it slides
    placement: Array
    first: Array
    second: Array
    axis: Array  # in the joint's frame, (J, 3)
    mass: Array  # [kg] (J,)
    carried: Array  # mass of all that a joint carries [kg] (J,)
    centre: Array  # of mass [m], in the joint's frame, (J, 3)
    gravity: Array  # [m/s²] (3,)
    carries: Bools  # whether a joint carries the end effector, (J,)
    effector_joint: int
    effector: Array  # its place in the frame of the joint that carries it [m], (3,)


@njit(cache=True)
def vector(a: Array) -> Vector:
    """Return a (3,) as a vector that takes no memory."""
    return a[0], a[1], a[2]


@njit(cache=True)
def place(tree: Tree, theta: Array, pose: Array) -> None:
    """Fill the joints' poses in the root link's frame, axes, and m c of their bodies, (J, 3, 6)."""
    pose[0] = 0.0
    pose[0, 0, 0] = pose[0, 1, 1] = pose[0, 2, 2] = 1.0
    for i in range(1, len(tree.parent)):
        up, angle = pose[tree.parent[i]], tree.ratio[i] * theta[tree.master[i]] + tree.offset[i]
        sine, rest = math.sin(angle), 1.0 - math.cos(angle)
        if tree.slides[i]:
            sine, rest = angle, 0.0
        own = tree.placement[i], tree.first[i], tree.second[i]
        for c in range(4):
            x = own[0][0, c] + sine * own[1][0, c] + rest * own[2][0, c]
            y = own[0][1, c] + sine * own[1][1, c] + rest * own[2][1, c]
            z = own[0][2, c] + sine * own[1][2, c] + rest * own[2][2, c]
            for r in range(3):
                pose[i, r, c] = up[r, 0] * x + up[r, 1] * y + up[r, 2] * z
        for r in range(3):
            pose[i, r, 3] += up[r, 3]
            pose[i, r, 4] = dot(pose[i, r], tree.axis[i])
            pose[i, r, 5] = tree.mass[i] * (dot(pose[i, r], tree.centre[i]) + pose[i, r, 3])


@njit(cache=True)
def hold(tree: Tree, theta: Array, wrench: Array, load: Array, gradient: Array) -> None:
    """Fill load [N·m] (D,) and ∂load/∂θ [N·m/rad] (D, D) at θ [rad] (D,).

    The wrench (6,) [N, N·m] acts on the end effector's origin, in axes of the root link; its
    torque's share in the gradient is left out.
    """
    joints = len(tree.parent)
    pose = np.empty((joints, 3, 6))
    place(tree, theta, pose)
    for i in range(joints - 1, 0, -1):
        for r in range(3):
            pose[tree.parent[i], r, 5] += pose[i, r, 5]
    load[:], gradient[:] = 0.0, 0.0
    down, hand = vector(tree.gravity), pose[tree.effector_joint]
    tip = plus(turned(hand, tree.effector), vector(hand[:, 3]))
    for k in range(1, joints):
        push, twist = vector(wrench[:3]), vector(wrench[3:])
        if not tree.carries[k]:
            push = twist = 0.0, 0.0, 0.0
        at, axis, moment = vector(pose[k, :, 3]), vector(pose[k, :, 4]), vector(pose[k, :, 5])
        if tree.slides[k]:
            force = plus(push, down, tree.carried[k])
            torque, bend = dot(axis, force), cross(axis, force)
        else:
            weight, arm = plus(moment, at, -tree.carried[k]), plus(tip, at, -1.0)
            turning = plus(plus(cross(weight, down), cross(arm, push)), twist)
            bending = cross(down, cross(weight, axis)), cross(push, cross(arm, axis))
            torque, bend = dot(axis, turning), plus(bending[0], bending[1])
        load[tree.master[k]] -= tree.ratio[k] * torque
        j = k
        while j > 0:
            if not tree.slides[j]:
                slope = tree.ratio[j] * tree.ratio[k] * dot(pose[j, :, 4], bend)
                gradient[tree.master[j], tree.master[k]] -= slope
                if j != k:
                    gradient[tree.master[k], tree.master[j]] -= slope
            j = tree.parent[j]


class Load:
    """Torque that holds N arms against gravity and a wrench, and its gradient."""

    def __init__(self, kinematics: Kinematics) -> None:
        kin, model = kinematics, kinematics.model
        effector = model.frames[kin.end_effector_frame]
        joint = int(effector.parentJoint)
        mass = np.array([inertia.mass for inertia in model.inertias])
        self.tree = Tree(
            parent=kin.parent,
            master=kin.theta_index,
            ratio=kin.ratio,
            offset=kin.offset,
            slides=kin.prismatic,
            placement=kin.placements,
            first=kin.first,
            second=kin.second,
            axis=kin.local_axis,
            mass=mass,
            carried=mass @ kin.hangs_on,
            centre=np.array([inertia.lever for inertia in model.inertias]),
            gravity=np.array(model.gravity.linear),
            carries=kin.hangs_on[joint].copy(),
            effector_joint=joint,
            effector=np.array(effector.placement.translation),
        )

    def __call__(self, theta: Array, wrench: Array | None = None) -> tuple[Array, Array]:
        """Return what `hold` fills, (N, D) and (N, D, D), for θ (N, D) and wrenches (N, 6)."""
        load, gradient = np.empty_like(theta), np.empty((*theta.shape, theta.shape[1]))
        pushes = np.zeros((len(theta), 6)) if wrench is None else wrench
        for arm in zip(theta, pushes, load, gradient, strict=True):
            hold(self.tree, *arm)
        return load, gradient
