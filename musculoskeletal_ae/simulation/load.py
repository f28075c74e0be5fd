# SPDX-License-Identifier: Apache-2.0
"""What gravity and a push ask of the joints, with its slope, compiled by numba for many arms.

    load(θ) = g(θ) − Jᵀ F

(paper, section "Simulation": the necessary torque from the geometric model). Pinocchio says the
same, one posture a call, and a test holds the two together. With forces f_i at points c_i, every
joint k needs only R_k = Σ (c_i − o_k) f_iᵀ over what it carries:

    τ_k       = a_k · Σ (c_i − o_k) × f_i
    ∂τ_k/∂θ_j = a_jᵀ R_k a_k − (a_j · a_k) tr R_k        for j at or before k, and symmetric
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.robot.kinematics import Kinematics
from musculoskeletal_ae.robot.tree import Tree, tree_poses


class Weights(NamedTuple):
    """What the joints of a tree carry, and how θ turns them; index 0 is the root link."""

    tree: Tree
    #: position in θ of each joint, and q = ratio · θ + offset; (J,)
    theta_index: Ints
    ratio: Array
    offset: Array
    mass: Array  # [kg], (J,)
    centre: Array  # of mass, in the joint's frame [m], (J, 3)
    gravity: Array  # [m/s²], (3,)
    effector_joint: int  # that carries the end effector
    effector: Array  # its origin in that joint's frame [m], (3,)

    @classmethod
    def of(cls, kin: Kinematics) -> Weights:
        """Return those of a robot."""
        inertias, frame = kin.model.inertias, kin.model.frames[kin.end_effector_frame]
        return cls(
            Tree.of(kin), kin.theta_index.astype(np.int64), kin.ratio, kin.offset,
            np.array([inertia.mass for inertia in inertias]),
            np.array([inertia.lever for inertia in inertias]),
            np.array(kin.model.gravity.linear), int(frame.parentJoint),
            np.array(frame.placement.translation),
        )  # fmt: skip


class Scratch(NamedTuple):
    """Space for one arm; J joints with the root link."""

    q: Array  # (J−1,)
    rotation: Array  # (J, 3, 3)
    origin: Array  # (J, 3)
    axis: Array  # (J, 3)
    mass: Array  # carried by each joint [kg], (J,)
    moment: Array  # Σ m c of that [kg·m], (J, 3)


def loads(weights: Weights, theta: Array, wrench: Array) -> tuple[Array, Array]:
    """Return load [N·m] (N, D) and ∂load/∂θ [N·m/rad] (N, D, D) at θ [rad] (N, D).

    The wrench (N, 6) [N, N·m] acts on the end effector's origin, in axes of the root link; its
    torque's share in the gradient is left out.
    """
    torque = np.empty_like(theta)
    slope = np.empty((*theta.shape, theta.shape[1]))
    _fill(weights, theta, wrench, torque, slope)
    return torque, slope


@njit(cache=True, nogil=True)
def _fill(weights: Weights, theta: Array, wrench: Array, torque: Array, slope: Array) -> None:
    scratch = new_scratch(weights)
    for n in range(theta.shape[0]):
        load(weights, scratch, theta[n], wrench[n], torque[n], slope[n])


@njit(cache=True, nogil=True)
def new_scratch(weights: Weights) -> Scratch:
    """Return space for `load`."""
    count = weights.mass.shape[0]
    frames = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3))
    return Scratch(np.empty(count - 1), *frames, np.empty(count), np.empty((count, 3)))


@njit(cache=True, nogil=True)
def cross(a: Array, b: Array) -> tuple[float, float, float]:
    """Return a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, nogil=True)
def dot(a: Array, b: Array) -> float:
    """Return a · b, of three."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)
def load(
    weights: Weights, scratch: Scratch, theta: Array, wrench: Array, torque: Array, slope: Array
) -> None:
    """Fill torque (D,) and slope (D, D) as `loads` for one arm, θ (D,), wrench (6,)."""
    tree = weights.tree
    q, rotation, origin, axis, mass, moment = scratch
    count = mass.shape[0]
    torque[:], slope[:] = 0.0, 0.0
    for i in range(1, count):
        q[i - 1] = weights.ratio[i] * theta[weights.theta_index[i]] + weights.offset[i]
    tree_poses(tree, q, rotation, origin, axis)
    for i in range(1, count):
        mass[i] = weights.mass[i]
        for r in range(3):
            moment[i, r] = mass[i] * (origin[i, r] + dot(rotation[i, r], weights.centre[i]))
    hand = weights.effector_joint
    point, pull, bend = np.empty((3, 3))
    force, arm = np.empty((2, 3)), np.empty((2, 3))
    for r in range(3):
        point[r] = origin[hand, r] + dot(rotation[hand, r], weights.effector)
    for k in range(count - 1, 0, -1):  # from the tips: children before those that carry them
        carries = False
        j = hand
        while j > 0:
            carries = carries or j == k
            j = tree.parent[j]
        for r in range(3):
            force[0, r], arm[0, r] = weights.gravity[r], moment[k, r] - mass[k] * origin[k, r]
            force[1, r], arm[1, r] = 0.0, 0.0
            if carries:
                force[1, r], arm[1, r] = wrench[r], point[r] - origin[k, r]
        a, pull[:], bend[:] = axis[k], 0.0, 0.0
        if tree.prismatic[k]:
            for r in range(3):
                pull[r] = mass[k] * force[0, r] + force[1, r]
            bend[0], bend[1], bend[2] = cross(a, pull)
        else:
            for f in range(2):
                turning, along, trace = (
                    cross(arm[f], force[f]),
                    dot(force[f], a),
                    dot(arm[f], force[f]),
                )
                for r in range(3):
                    pull[r] += turning[r]
                    bend[r] += arm[f, r] * along - a[r] * trace
            if carries:
                for r in range(3):
                    pull[r] += wrench[3 + r]
        at, ratio = weights.theta_index[k], weights.ratio[k]
        torque[at] -= ratio * dot(a, pull)
        j = k
        while j > 0:
            if not tree.prismatic[j]:
                share = ratio * weights.ratio[j] * dot(axis[j], bend)
                slope[weights.theta_index[j], at] -= share
                if j != k:
                    slope[at, weights.theta_index[j]] -= share
            j = tree.parent[j]
        mass[tree.parent[k]] += mass[k]
        for r in range(3):
            moment[tree.parent[k], r] += moment[k, r]
