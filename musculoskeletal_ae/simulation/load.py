# SPDX-License-Identifier: Apache-2.0
"""Joint torques that hold N arms against weight, springs and a wrench, and their gradient.

    load(θ) = g(θ) + K θ − b + h(θ) − Jᵀ F

(paper, §III-F: the necessary torque from the geometric model). K, b and h describe the springs and
passive tendons of the joints (`JointElasticity`). Pinocchio computes the same torque of weight and
wrench, and a test compares both. Its gradient with external forces
(`computeStaticTorqueDerivatives`) cannot be used, because it holds each force constant in the frame
of a joint. The force of the wrench F is constant in the axes of the root link. In addition, the
simulator calls `hold` from code that numba compiles, and such code cannot call Pinocchio.

With forces f_i at points c_i, a joint k at o_k with axis a_k needs only sums over the bodies that
it carries:

    τ_k       = a_k · Σ (c_i − o_k) × f_i
    ∂τ_k/∂θ_j = a_j · Σ f_i × ((c_i − o_k) × a_k)        for j at or before k; symmetric

The last axis of all arrays (…, N) is that of the arms, so that a core computes several arms at
once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.robot.kinematics import Kinematics
from musculoskeletal_ae.robot.passive_tendon_torque import add_passive
from musculoskeletal_ae.robot.passive_tendons import Passive
from musculoskeletal_ae.robot.wrapping import Vector, cross, dot, plus


class LoadTree(NamedTuple):
    """The J joints of pinocchio and their bodies; joint 0 is the root link."""

    parent: Ints  # index of the parent of each joint, (J,)
    master: Ints  # index in θ of the coordinate that moves each joint, (J,)
    terms: Array  # coefficients of q = Σ terms_k θᵏ, (J, K)
    slides: Bools  # whether each joint is prismatic, (J,)
    # Pose of a joint in the parent's frame, each part of shape (J, 4, 4): placement + sin q · first
    # + (1 − cos q) · second for a revolute joint, placement + q · first for a prismatic one.
    placement: Array
    first: Array
    second: Array
    axis: Array  # axis of each joint in its own frame, (J, 3)
    mass: Array  # mass of the body that each of the J joints moves [kg], (J,)
    carried: Array  # total mass that each joint carries [kg], (J,)
    centre: Array  # centre of mass of each body in its joint's frame [m], (J, 3)
    gravity: Array  # acceleration of gravity in the root link's frame [m/s²], (3,)
    carries: Bools  # whether each joint carries the end effector, (J,)
    effector_joint: int  # index of the joint to whose body the end effector belongs
    effector: Array  # position of the end effector in the frame of that joint [m], (3,)
    springs: Array  # stiffness K of the joints' springs [N·m/rad], (D, D)
    preload: Array  # preload b of the joints' springs [N·m], (D,)
    passive: Passive  # passive tendons of the joints

    @classmethod
    def of(cls, kinematics: Kinematics) -> LoadTree:
        """Return the joints and bodies of a robot."""
        kin, model = kinematics, kinematics.model
        effector = model.frames[kin.end_effector_frame]
        joint = int(effector.parentJoint)
        mass = np.array([inertia.mass for inertia in model.inertias])
        return cls(
            parent=kin.tree.parent,
            master=kin.tree.theta_index,
            terms=kin.tree.terms,
            slides=kin.tree.prismatic,
            placement=kin.tree.placements,
            first=kin.tree.first,
            second=kin.tree.second,
            axis=kin.tree.local_axis,
            mass=mass,
            carried=mass @ kin.tree.descends_from,
            centre=np.array([inertia.lever for inertia in model.inertias]),
            gravity=np.array(model.gravity.linear),
            carries=kin.tree.descends_from[joint].copy(),
            effector_joint=joint,
            effector=np.array(effector.placement.translation),
            springs=np.ascontiguousarray(kin.elasticity.stiffness),
            preload=kin.elasticity.preload.copy(),
            passive=kin.elasticity.tendons.arrays,
        )

    def load(self, theta: Array, wrench: Array | None = None) -> tuple[Array, Array]:
        """Return the load [N·m] (N, D) and its gradient [N·m/rad] (N, D, D).

        Args:
            theta: Joint angles θ [rad], (N, D).
            wrench: Wrench on the end effectors in axes of the root link [N, N·m], (N, 6), or None.
        """
        wrench = np.zeros((len(theta), 6)) if wrench is None else wrench
        theta, wrench = np.ascontiguousarray(theta.T), np.ascontiguousarray(wrench.T)
        load, gradient = np.empty_like(theta), np.empty((len(theta), *theta.shape))
        hold(self, theta, wrench, load, gradient)
        return load.T, gradient.transpose(2, 0, 1)


@njit(cache=True)
def vector(a: Array) -> Vector:
    """Return an array (3,) as a tuple, which needs no memory allocation."""
    return a[0], a[1], a[2]


@njit(cache=True)
def of(arm: int, vectors: Array) -> Vector:
    """Return the vector of one arm from `vectors` (3, N), without memory allocation."""
    return vectors[0, arm], vectors[1, arm], vectors[2, arm]


@njit(cache=True)
def polynomial(terms: Array, order: int, x: float) -> float:
    """Return the polynomial Σ terms_k xᵏ (order 0), or its first or second derivative at x."""
    value = 0.0
    for k in range(len(terms) - 1, order - 1, -1):
        factor = 1.0
        for i in range(order):
            factor *= k - i
        value = value * x + factor * terms[k]
    return value


@njit(cache=True)
def place(tree: LoadTree, theta: Array, pose: Array) -> None:
    """Fill `pose` (J, 6, 3, N) with six vectors of each joint in the root link's frame.

    The vectors are the three axes of the joint's frame, its origin, the joint axis, and mass times
    centre of mass of its body.
    """
    arms = theta.shape[1]
    sine, rest, column = np.empty(arms), np.empty(arms), np.empty((3, arms))
    pose[0] = 0.0
    pose[0, 0, 0] = pose[0, 1, 1] = pose[0, 2, 2] = 1.0
    for i in range(1, len(tree.parent)):
        up, own, angles = pose[tree.parent[i]], pose[i], theta[tree.master[i]]
        for n in range(arms):
            angle = polynomial(tree.terms[i], 0, angles[n])
            sine[n], rest[n] = math.sin(angle), 1.0 - math.cos(angle)
            if tree.slides[i]:
                sine[n], rest[n] = angle, 0.0
        fixed, first, second = tree.placement[i], tree.first[i], tree.second[i]
        for c in range(4):
            for r in range(3):
                for n in range(arms):
                    column[r, n] = fixed[r, c] + sine[n] * first[r, c] + rest[n] * second[r, c]
            for r in range(3):
                shift = 1.0 if c == 3 else 0.0
                for n in range(arms):
                    x, y, z = of(n, column)
                    own[c, r, n] = up[0, r, n] * x + up[1, r, n] * y + up[2, r, n] * z
                    own[c, r, n] += shift * up[3, r, n]
        axis, centre, mass = vector(tree.axis[i]), vector(tree.centre[i]), tree.mass[i]
        for r in range(3):
            for n in range(arms):
                frame = own[0, r, n], own[1, r, n], own[2, r, n]
                own[4, r, n] = dot(frame, axis)
                own[5, r, n] = mass * (dot(frame, centre) + own[3, r, n])


@njit(cache=True)
def hold(tree: LoadTree, theta: Array, wrench: Array, load: Array, gradient: Array) -> None:
    """Hold the arms: fill load [N·m] (D, N) and ∂load/∂θ [N·m/rad] (D, D, N) at θ [rad] (D, N).

    The wrench [N, N·m] (6, N) acts at the end effector's origin, in axes of the root link. The
    gradient includes the wrench's force, but not its torque.
    """
    joints, arms = len(tree.parent), theta.shape[1]
    pose, bend = np.empty((joints, 6, 3, arms)), np.empty((3, arms))
    place(tree, theta, pose)
    gears = np.empty((joints, arms))  # ∂q/∂θ of each joint
    for i in range(joints - 1, 0, -1):
        for n in range(arms):
            gears[i, n] = polynomial(tree.terms[i], 1, theta[tree.master[i], n])
        for r in range(3):
            for n in range(arms):
                pose[tree.parent[i], 5, r, n] += pose[i, 5, r, n]
    load[:], gradient[:] = 0.0, 0.0
    for d in range(len(theta)):
        for n in range(arms):
            load[d, n] = -tree.preload[d]
        for e in range(len(theta)):
            spring = tree.springs[d, e]
            if spring != 0.0:
                for n in range(arms):
                    load[d, n] += spring * theta[e, n]
                    gradient[d, e, n] = spring
    if len(tree.passive.law):
        for n in range(arms):
            posture = theta[:, n].copy()
            held, slopes = np.zeros(len(posture)), np.zeros((len(posture), len(posture)))
            add_passive(tree.passive, posture, held, slopes)
            load[:, n] += held
            gradient[:, :, n] += slopes
    down, tip, hand = vector(tree.gravity), vector(tree.effector), pose[tree.effector_joint]
    tips, nothing = hand[3].copy(), np.zeros_like(wrench)
    for c in range(3):
        for r in range(3):
            for n in range(arms):
                tips[r, n] += tip[c] * hand[c, r, n]
    for k in range(1, joints):
        origins, axes, moments = pose[k, 3], pose[k, 4], pose[k, 5]
        master, weighs, slides = tree.master[k], tree.carried[k], tree.slides[k]
        acting, angles, gear = wrench if tree.carries[k] else nothing, theta[master], gears[k]
        is_nonlinear = len(tree.terms[k]) > 2
        pushes, twists = acting[:3], acting[3:]
        for n in range(arms):
            at, axis = of(n, origins), of(n, axes)
            push, twist = of(n, pushes), of(n, twists)
            weight, arm = plus(of(n, moments), at, -weighs), plus(of(n, tips), at, -1.0)
            if slides:
                force = plus(push, down, weighs)
                torque, bent = dot(axis, force), cross(axis, force)
            else:
                turning = plus(plus(cross(weight, down), cross(arm, push)), twist)
                bending = cross(down, cross(weight, axis)), cross(push, cross(arm, axis))
                torque, bent = dot(axis, turning), plus(bending[0], bending[1])
            load[master, n] -= gear[n] * torque
            if is_nonlinear:
                gradient[master, master, n] -= polynomial(tree.terms[k], 2, angles[n]) * torque
            for r in range(3):
                bend[r, n] = bent[r]
        j = k
        while j > 0:
            if not tree.slides[j]:
                other, axes, geared = tree.master[j], pose[j, 4], gears[j]
                for n in range(arms):
                    slope = geared[n] * gear[n] * dot(of(n, axes), of(n, bend))
                    gradient[other, master, n] -= slope
                    if j != k:
                        gradient[master, other, n] -= slope
            j = tree.parent[j]
