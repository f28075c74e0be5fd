# SPDX-License-Identifier: Apache-2.0
"""Poses of all joints of a robot's tree, compiled by numba: for loops that numba compiles too."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.robot.kinematics import Kinematics


class Tree(NamedTuple):
    """Joints in pinocchio's order, joint 0 being the root link."""

    parent: Ints  # (J,)
    rotation: Array  # fixed placement in the parent, (J, 3, 3)
    translation: Array  # [m], (J, 3)
    axis: Array  # in the joint's frame, (J, 3)
    prismatic: Bools  # (J,)

    @classmethod
    def of(cls, kin: Kinematics) -> Tree:
        """Return the tree of a robot."""
        placement = kin.placement_rotation, kin.placement_translation
        return cls(kin.parent.astype(np.int64), *placement, kin.local_axis, kin.prismatic)


@njit(cache=True)
def tree_poses(tree: Tree, q: Array, rotation: Array, translation: Array, axis: Array) -> None:
    """Fill rotation (J, 3, 3), translation (J, 3), axis (J, 3) of all joints for q (J−1,)."""
    rotation[0] = np.eye(3)
    translation[0] = 0.0
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
            for k in range(3):
                translation[i, r] += rotation[up, r, k] * tree.translation[i, k]
            x, y, z = 0.0, 0.0, 0.0  # a row of the placement
            for k in range(3):
                x += rotation[up, r, k] * tree.rotation[i, k, 0]
                y += rotation[up, r, k] * tree.rotation[i, k, 1]
                z += rotation[up, r, k] * tree.rotation[i, k, 2]
            axis[i, r] = x * ux + y * uy + z * uz
            for c in range(3):
                rotation[i, r, c] = x * turn[0, c] + y * turn[1, c] + z * turn[2, c]
        if tree.prismatic[i]:
            for r in range(3):
                translation[i, r] += axis[i, r] * q[i - 1]
