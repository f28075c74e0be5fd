# SPDX-License-Identifier: Apache-2.0
"""What an arm looks like: bones and muscles as lines, and a picture of them without a display.

As in the paper's figures, a muscle is green at T_bias and turns red towards T_limit.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot

# Shorter bones are two joints in one place.
SHORTEST_BONE = 1e-3  # [m]
BONE_WIDTH, MUSCLE_WIDTH = 0.02, 0.006  # [m]
BONE_COLOUR = (0.8, 0.8, 0.75)
BALL = 1.7  # of a line's width


class Line(NamedTuple):
    """A polyline in the root link's frame.

    Attributes:
        kind: What it stands for.
        points: Shape (N, 3) [m].
        width: Line width [m].
        colour: Red, green, blue in [0, 1].
    """

    kind: Literal['bones', 'muscles']
    points: Array
    width: float
    colour: tuple[float, ...]


def draw_arm(robot: Robot, theta: Array, tension: Array, points: Array | None = None) -> list[Line]:
    """Return the bones of an arm, then its muscles in their order.

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
    bones = [np.stack([origins[kin.parent[i]], origins[i]]) for i in range(1, len(origins))]
    last = int(kin.model.frames[kin.end_effector_frame].parentJoint)
    bones.append(np.stack([origins[last], tip]))
    lines = [
        Line('bones', bone, BONE_WIDTH, BONE_COLOUR)
        for bone in bones
        if np.linalg.norm(bone[1] - bone[0]) > SHORTEST_BONE
    ]
    for m, colour in enumerate(tension_colour(robot, tension).tolist()):
        own = np.flatnonzero(routes.muscle == m)
        route = points[np.append(routes.first[own], routes.second[own[-1]])]
        lines.append(Line('muscles', route, MUSCLE_WIDTH, tuple(colour)))
    return lines


def tension_colour(robot: Robot, tension: Array) -> Array:
    """Return (red, green, blue) in [0, 1] of tensions [N] (M,): green at bias, red at limit."""
    low, high = robot.tension.bias, robot.tension.limit
    share = np.clip((tension - low) / (high - low), 0.0, 1.0)
    return np.stack([share, 1.0 - share, np.zeros_like(share)], axis=1)


def save_picture(lines: Sequence[Line], path: str | Path, title: str = '') -> None:
    """Draw lines from the front and from the side, in true proportions, and save a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 5.0), layout='constrained')
    every = np.concatenate([line.points for line in lines])
    middle = 0.5 * (every.max(axis=0) + every.min(axis=0))
    reach = 0.5 * float((every.max(axis=0) - every.min(axis=0)).max()) + 0.03
    for i, (azimuth, name) in enumerate([(-10.0, 'from the front'), (-80.0, 'from the right')]):
        axes: Any = figure.add_subplot(1, 2, i + 1, projection='3d')
        axes.set_proj_type('ortho')
        for line in lines:
            width = 400.0 * line.width
            # Balls where bones meet, and where a muscle's route is held.
            axes.plot(
                *line.points.T,
                color=line.colour,
                linewidth=width,
                solid_capstyle='round',
                marker='o',
                markersize=BALL * width,
                markeredgecolor='0.35',
                markeredgewidth=0.5,
            )
        axes.set_xlim(middle[0] - reach, middle[0] + reach)
        axes.set_ylim(middle[1] - reach, middle[1] + reach)
        axes.set_zlim(middle[2] - reach, middle[2] + reach)
        axes.set_box_aspect((1.0, 1.0, 1.0), zoom=1.05)
        axes.locator_params(nbins=5)
        axes.set_xlabel('x [m]')
        axes.set_ylabel('y [m]')
        axes.set_zlabel('z [m]')
        axes.view_init(elev=10.0, azim=azimuth)
        axes.set_title(name)
    figure.suptitle(title or 'muscles: green at bias tension, red at the limit')
    figure.savefig(path, dpi=110)
