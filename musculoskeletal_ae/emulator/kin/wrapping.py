# SPDX-License-Identifier: Apache-2.0
"""Muscle routes that wrap around bones, compiled by numba: the true lengths of the emulated arm.

A segment between two route points may wrap around a sphere (a bone's head) that the geometric model
of `robot/routes.py` does not contain. If the robot description already states an object around
which a segment wraps, the emulated object has a slightly different size. `robot/wrapping.py`
computes the path of the tendon on either kind of object.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.robot.wrapping import (
    Vector,
    WrapObjects,
    cross,
    dot,
    plus,
    turned,
    wrapped_segment,
)


class Tree(NamedTuple):
    """Joints in pinocchio's order; joint 0 is the root link."""

    parent: Ints  # index of the joint that carries each joint, (J,)
    rotation: Array  # fixed orientation in the parent's frame, (J, 3, 3)
    translation: Array  # fixed position in the parent's frame [m], (J, 3)
    axis: Array  # axis in the joint's frame, (J, 3)
    prismatic: Bools  # whether each joint is prismatic, (J,)


class WrappedRoutes(NamedTuple):
    """True routes: points, each fixed to a joint of the tree, and segments between points."""

    tree: Tree
    point_joint: Ints  # tree joint that carries each point, (P,)
    point: Array  # position of each point in that joint's frame [m], (P, 3)
    first: Ints  # start point of each segment, (S,)
    second: Ints  # end point of each segment, (S,)
    muscle: Ints  # muscle of each segment, (S,)
    weight: Array  # factor of each segment's length and tension, (S,)
    objects: WrapObjects  # object that each segment wraps around; radius 0 if there is none


class Placed(NamedTuple):
    """Joints, route points and tendons in the root link's frame, as `place` computes them."""

    rotation: Array  # orientation of each joint, (J, 3, 3)
    translation: Array  # position of each joint [m], (J, 3)
    axis: Array  # axis of each joint, (J, 3)
    world: Array  # route points [m], (P, 3)
    absolute: Array  # lengths of the routes [m], (M,)
    leave: Array  # unit vector along the tendon at the start of each segment, (S, 3)
    arrive: Array  # unit vector along the tendon at the end of each segment, (S, 3)

    @classmethod
    def empty(cls, routes: WrappedRoutes, muscles: int) -> Placed:
        """Return arrays for an arm of M muscles, to be filled by `place`."""
        joints, points, segments = map(len, (routes.tree.parent, routes.point, routes.first))
        poses, ends = ((joints, 3, 3), (joints, 3), (joints, 3)), (segments, 3)
        placed = cls(*(np.zeros(shape) for shape in (*poses, (points, 3), muscles, ends, ends)))
        placed.rotation[0] = np.eye(3)
        return placed


@njit(cache=True)
def _multiply(a: Array, b: Array, product: Array) -> None:
    """Write the product of two (3, 3) matrices into `product`."""
    for r in range(3):
        for c in range(3):
            product[r, c] = 0.0
            for k in range(3):
                product[r, c] += a[r, k] * b[k, c]


@njit(cache=True)
def point_of(placed: Placed, joint: int, point: Array) -> Vector:
    """Transform a point [m] (3,) from a joint's frame to the root link's frame."""
    r, t = placed.rotation[joint], placed.translation[joint]
    return (
        t[0] + r[0, 0] * point[0] + r[0, 1] * point[1] + r[0, 2] * point[2],
        t[1] + r[1, 0] * point[0] + r[1, 1] * point[1] + r[1, 2] * point[2],
        t[2] + r[2, 0] * point[0] + r[2, 1] * point[1] + r[2, 2] * point[2],
    )


@njit(cache=True)
def fill(row: Array, values: Vector | Array) -> None:
    """Fill a row with values; numba needs seconds to compile `row[:] = values` instead."""
    for i in range(len(row)):
        row[i] = values[i]


@njit(cache=True)
def place(routes: WrappedRoutes, q: Array, placed: Placed) -> None:
    """Compute all entries of `placed` at joint positions q (J−1,)."""
    tree, fixed = routes.tree, np.zeros((3, 3))
    for i in range(1, tree.parent.shape[0]):
        up = tree.parent[i]
        ux, uy, uz = tree.axis[i]
        sine, cosine = math.sin(q[i - 1]), math.cos(q[i - 1])
        if tree.prismatic[i]:
            sine, cosine = 0.0, 1.0
        rest = 1.0 - cosine
        turn = np.array(
            (
                (cosine + ux * ux * rest, ux * uy * rest - uz * sine, ux * uz * rest + uy * sine),
                (uy * ux * rest + uz * sine, cosine + uy * uy * rest, uy * uz * rest - ux * sine),
                (uz * ux * rest - uy * sine, uz * uy * rest + ux * sine, cosine + uz * uz * rest),
            )
        )
        _multiply(placed.rotation[up], tree.rotation[i], fixed)
        _multiply(fixed, turn, placed.rotation[i])
        fill(placed.axis[i], turned(fixed, tree.axis[i]))
        fill(placed.translation[i], point_of(placed, up, tree.translation[i]))
        if tree.prismatic[i]:
            fill(placed.translation[i], plus(placed.translation[i], placed.axis[i], q[i - 1]))
    for p in range(routes.point.shape[0]):
        fill(placed.world[p], point_of(placed, routes.point_joint[p], routes.point[p]))
    placed.absolute[:] = 0.0
    for s in range(routes.first.shape[0]):
        length = wrapped_segment(
            routes.objects, s, placed.rotation, placed.translation,
            placed.world[routes.first[s]], placed.world[routes.second[s]],
            placed.leave[s], placed.arrive[s],
        )  # fmt: skip
        placed.absolute[routes.muscle[s]] += routes.weight[s] * length


@njit(cache=True)
def wrapped_lengths(routes: WrappedRoutes, q: Array, placed: Placed) -> tuple[Array, Array]:
    """Return the route lengths of all muscles, and their derivatives, in N postures.

    Args:
        routes: Routes with the objects around which they wrap.
        q: Positions of all joints of the tree [rad] or [m], (N, J−1).
        placed: Buffer for intermediate results.

    Returns:
        Lengths [m], (N, M), and their derivatives with respect to q [m/rad], (N, M, J−1).
    """
    lengths = np.zeros((q.shape[0], placed.absolute.shape[0]))
    jacobian = np.zeros((*lengths.shape, q.shape[1]))
    for n in range(q.shape[0]):
        place(routes, q[n], placed)
        fill(lengths[n], placed.absolute)
        for s in range(routes.first.shape[0]):
            add_tension_torque(routes, s, placed, -1.0, jacobian[n, routes.muscle[s]])
    return lengths, jacobian


@njit(cache=True)
def add_tension_torque(
    routes: WrappedRoutes, s: int, placed: Placed, tension: float, torque: Array
) -> None:
    """Add the torques of segment s to `torque` (J−1,), for the tension [N] of its muscle."""
    tree, objects, tension = routes.tree, routes.objects, routes.weight[s] * tension
    ends = (routes.first[s], placed.leave[s]), (routes.second[s], placed.arrive[s])
    for p, away in ends:
        add_torque(tree, placed, routes.point_joint[p], placed.world[p], away, tension, torque)
    if objects.radius[s] > 0.0:
        # The tendon loads the object along the lines of its two straight parts.
        for p, away in ends:
            add_torque(tree, placed, objects.joint[s], placed.world[p], away, -tension, torque)


@njit(cache=True)
def add_torque(
    tree: Tree, placed: Placed, joint: int, point: Vector, force: Array, scale: float,
    torque: Array,
) -> None:  # fmt: skip
    """Add the torques that a force exerts on all joints between a body and the root link.

    Args:
        tree: The joints of the arm.
        placed: Poses of the joints, as computed by `place`.
        joint: Index of the joint that carries the body.
        point: Point at which the force acts, in the root link's frame [m].
        force: The force in the axes of the root link, before it is multiplied by `scale`.
        scale: Factor by which the force is multiplied.
        torque: Generalised torques of the tree's joints, (J−1,), to which the torques are added.
    """
    while joint > 0:
        axis = placed.axis[joint]
        if tree.prismatic[joint]:
            torque[joint - 1] += scale * dot(axis, force)
        else:
            arm = plus(point, placed.translation[joint], -1.0)
            torque[joint - 1] += scale * dot(axis, cross(arm, force))
        joint = tree.parent[joint]
