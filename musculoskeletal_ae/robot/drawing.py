# SPDX-License-Identifier: Apache-2.0
"""What an arm looks like as lines: bones, muscles, and the colour of a tension.

As in the paper's figures, a muscle is green at T_bias and turns red towards T_limit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot

# Shorter bones are two joints in one place.
SHORTEST_BONE = 1e-3  # [m]


class Drawing(NamedTuple):
    """Lines of an arm in the root link's frame.

    Attributes:
        bones: Each a line of two points [m], shape (2, 3).
        muscles: One polyline per muscle [m], each of shape (points, 3).
        colours: Red, green, blue of each muscle in [0, 1], shape (M, 3).
    """

    bones: list[Array]
    muscles: list[Array]
    colours: Array


def draw_arm(robot: Robot, theta: Array, tension: Array, points: Array | None = None) -> Drawing:
    """Return the lines of an arm.

    Args:
        robot: The nominal body.
        theta: Posture [rad], shape (D,).
        tension: Muscle tensions [N], shape (M,).
        points: Route points [m], shape (P, 3); those of the geometric model by default.
    """
    kin, routes = robot.kinematics, robot.routes
    if points is None:
        points = routes.points(theta[None])[0]
    origins = kin.joint_poses(theta[None]).translation[0]
    tip = kin.end_effector_pose(theta).translation
    last = int(kin.model.frames[kin.end_effector_frame].parentJoint)
    ends = [*zip(origins[kin.parent[1:]], origins[1:]), (origins[last], tip)]
    bones = [np.stack(pair) for pair in ends if np.linalg.norm(pair[1] - pair[0]) > SHORTEST_BONE]
    muscles = []
    for m in range(robot.muscle_count):
        own = np.flatnonzero(routes.muscle == m)
        muscles.append(points[np.append(routes.first[own], routes.second[own[-1]])])
    low, high = robot.tension.bias, robot.tension.limit
    share = np.clip((tension - low) / (high - low), 0.0, 1.0)
    return Drawing(bones, muscles, np.stack([share, 1.0 - share, np.zeros_like(share)], axis=1))
