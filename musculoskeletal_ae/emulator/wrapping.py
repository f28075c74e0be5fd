# SPDX-License-Identifier: Apache-2.0
"""Muscle routes that wrap round bones, compiled by numba: the true lengths of the emulated arm.

A segment between two route points may pass a sphere (a bone's head) that the geometric model of
`robot/routes.py` does not know; where the description itself wraps it, it wraps here too, round an
object of its own size. How a wire lies on either, `robot/wrapping.py` says.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.robot.wrapping import WrapObjects, wrapped_segment


class Tree(NamedTuple):
    """Joints in pinocchio's order, joint 0 being the root link."""

    parent: Ints  # (J,)
    rotation: Array  # fixed placement in the parent, (J, 3, 3)
    translation: Array  # [m], (J, 3)
    axis: Array  # in the joint's frame, (J, 3)
    prismatic: Bools  # (J,)


class WrappedRoutes(NamedTuple):
    """True routes: points on joints of the tree, segments between them."""

    point_joint: Ints  # tree joint that carries each point, (P,)
    point: Array  # in that joint's frame [m], (P, 3)
    first: Ints  # points where each segment starts
    second: Ints  # and ends, (S,)
    muscle: Ints  # it belongs to, (S,)
    objects: WrapObjects  # what each segment wraps round, radius 0 for nothing


@njit(cache=True)
def tree_poses(tree: Tree, q: Array, rotation: Array, translation: Array, axis: Array) -> None:
    """Fill rotation (J, 3, 3), translation (J, 3), axis (J, 3) of all joints for q (J−1,)."""
    rotation[0], translation[0], placed = np.eye(3), 0.0, np.zeros(3)
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
        for r in range(3):
            translation[i, r] = translation[up, r]
            axis[i, r] = 0.0
            for k in range(3):
                translation[i, r] += rotation[up, r, k] * tree.translation[i, k]
                placed[k] = 0.0
                for j in range(3):
                    placed[k] += rotation[up, r, j] * tree.rotation[i, j, k]
                axis[i, r] += placed[k] * tree.axis[i, k]
            for c in range(3):
                rotation[i, r, c] = 0.0
                for k in range(3):
                    rotation[i, r, c] += placed[k] * turn[k, c]
        if tree.prismatic[i]:
            for r in range(3):
                translation[i, r] += axis[i, r] * q[i - 1]


@njit(cache=True)
def place_points(routes: WrappedRoutes, rotation: Array, translation: Array, world: Array) -> None:
    """Fill world (P, 3) with the route points in the root link's frame."""
    for p in range(routes.point.shape[0]):
        j = routes.point_joint[p]
        for r in range(3):
            world[p, r] = translation[j, r]
            for k in range(3):
                world[p, r] += rotation[j, r, k] * routes.point[p, k]


@njit(cache=True)
def wrapped_lengths(
    tree: Tree, routes: WrappedRoutes, muscles: int, q: Array
) -> tuple[Array, Array]:
    """Return absolute lengths [m] (N, M) and their Jacobian [m/rad] (N, M, J−1) for q (N, J−1)."""
    count, joints = q.shape[0], tree.parent.shape[0]
    rotation, translation = np.zeros((joints, 3, 3)), np.zeros((joints, 3))
    axis = np.zeros((joints, 3))
    world = np.zeros((routes.point.shape[0], 3))
    leave, arrive = np.zeros(3), np.zeros(3)
    lengths = np.zeros((count, muscles))
    jacobian = np.zeros((count, muscles, joints - 1))
    for n in range(count):
        tree_poses(tree, q[n], rotation, translation, axis)
        place_points(routes, rotation, translation, world)
        for s in range(routes.first.shape[0]):
            m = routes.muscle[s]
            lengths[n, m] += route_segment(routes, s, rotation, translation, world, leave, arrive)
            add_pull(tree, routes, s, translation, axis, world, leave, arrive, -1.0, jacobian[n, m])
    return lengths, jacobian


@njit(cache=True)
def route_segment(
    routes: WrappedRoutes, s: int, rotation: Array, translation: Array, world: Array,
    leave: Array, arrive: Array,
) -> float:  # fmt: skip
    """Return the length of segment s, placed by `place_points`, and fill the unit pulls."""
    start, end = world[routes.first[s]], world[routes.second[s]]
    return wrapped_segment(routes.objects, s, rotation, translation, start, end, leave, arrive)


@njit(cache=True)
def add_pull(
    tree: Tree, routes: WrappedRoutes, s: int, translation: Array, axis: Array, world: Array,
    leave: Array, arrive: Array, pull: float, torque: Array,
) -> None:  # fmt: skip
    """Add what a tension `pull` in segment s does to the joints to torque (J−1,)."""
    i, k = routes.first[s], routes.second[s]
    add_torque(tree, translation, axis, routes.point_joint[i], world[i], leave, pull, torque)
    add_torque(tree, translation, axis, routes.point_joint[k], world[k], arrive, pull, torque)
    if routes.objects.radius[s] > 0.0:
        # The wire presses on the object in the lines of its straight parts.
        joint = routes.objects.joint[s]
        add_torque(tree, translation, axis, joint, world[i], leave, -pull, torque)
        add_torque(tree, translation, axis, joint, world[k], arrive, -pull, torque)


@njit(cache=True)
def add_torque(
    tree: Tree, translation: Array, axis: Array, joint: int, point: Array, force: Array,
    scale: float, torque: Array,
) -> None:  # fmt: skip
    """Add scale · Jᵀ force of a force at a point of a joint's body to torque (J−1,)."""
    while joint > 0:
        ax, ay, az = axis[joint]
        if tree.prismatic[joint]:
            torque[joint - 1] += scale * (ax * force[0] + ay * force[1] + az * force[2])
        else:
            x = point[0] - translation[joint, 0]
            y = point[1] - translation[joint, 1]
            z = point[2] - translation[joint, 2]
            torque[joint - 1] += scale * (
                ax * (y * force[2] - z * force[1])
                + ay * (z * force[0] - x * force[2])
                + az * (x * force[1] - y * force[0])
            )
        joint = tree.parent[joint]
