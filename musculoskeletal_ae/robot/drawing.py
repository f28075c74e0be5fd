# SPDX-License-Identifier: Apache-2.0
"""Draw the bones and muscles of an arm as lines, and save pictures of them without a display.

A muscle is green at T_bias and turns red towards T_limit (paper, §IV-D).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.figures import save_figure
from musculoskeletal_ae.robot.robot import Robot

SHORTEST_BONE = 1e-3  # draw no bone that is shorter than this [m]: its joints coincide
BONE_WIDTH, MUSCLE_WIDTH = 0.02, 0.006  # widths of the lines that represent bones and muscles [m]
BONE_COLOUR = (0.8, 0.8, 0.75)  # colour of bones: red, green, blue
#: diameter of the balls that mark joints and via points, divided by the width of the line
BALL_SIZE = 1.7


class Line(NamedTuple):
    """A polyline in the root link's frame."""

    kind: Literal['bones', 'muscles']
    points: Array  # corners of the polyline [m], (N, 3)
    width: float  # width of the line [m]
    colour: tuple[float, ...]  # red, green, blue in [0, 1]
    name: str = ''  # name of the muscle; '' except for the first branch of its tendon


def tension_share(robot: Robot, tension: Array) -> Array:
    """Return where each tension [N] lies between T_bias (0) and T_limit (1), (M,).

    Values beyond this range are clipped. An unknown tension (NaN) gives 0.
    """
    limits = robot.tension
    known = np.nan_to_num(tension)
    return np.clip((known - limits.bias) / (limits.limit - limits.bias), 0.0, 1.0)


def draw_arm(robot: Robot, theta: Array, tension: Array, points: Array | None = None) -> list[Line]:
    """Return the lines of an arm: its bones, then its muscles in order.

    Args:
        robot: The geometric model.
        theta: Joint angles [rad], (D,).
        tension: Tensions [N], (M,), which determine the colours.
        points: Route points in the root link's frame [m], (P, 3); by default those of the geometric
            model.

    Returns:
        One line for each bone longer than 1 mm, and for each branch of a tendon.
    """
    kin = robot.kinematics
    origins = kin.tree.joint_poses(theta[None]).translation[0]
    bones = [np.stack([origins[kin.tree.parent[i]], origins[i]]) for i in range(1, len(origins))]
    for link in robot.description.end_effectors:
        tip = kin.link_pose(theta, link).translation
        bones.append(np.stack([origins[kin.placement(link)[0]], tip]))
    lines = [
        Line('bones', bone, BONE_WIDTH, BONE_COLOUR)
        for bone in bones
        if np.linalg.norm(bone[1] - bone[0]) > SHORTEST_BONE
    ]
    shares = tension_share(robot, tension).tolist()
    owners, before = robot.routes.drawn_muscle.tolist(), -1
    for m, route in zip(owners, robot.routes.drawn(theta, points), strict=True):
        name, colour = robot.muscles[m] if m != before else '', (shares[m], 1.0 - shares[m], 0.0)
        lines.append(Line('muscles', route, MUSCLE_WIDTH, colour, name))
        before = m
    return lines


def _within(line: Line, middle: Array, reach: float) -> Line:
    """Return the part of a bone that lies inside the cube `middle` ± `reach` [m].

    The result has no points if the bone lies outside. The line of a muscle is returned unchanged.
    """
    if line.kind != 'bones':
        return line
    start, end = line.points[[0, -1]]
    points = start + np.linspace(0.0, 1.0, 101)[:, None] * (end - start)
    inside = np.flatnonzero((np.abs(points - middle) <= reach).all(axis=1))
    return line._replace(points=points[inside[[0, -1]] if len(inside) else inside])


def save_picture(lines: Sequence[Line], path: Path, title: str = '', whole: bool = True) -> None:
    """Save a picture of lines in true proportions, seen from the front and from the side.

    Args:
        lines: The lines, as `draw_arm` returns them.
        path: The file of the picture.
        title: Title of the picture; if empty, one that explains the colours.
        whole: Whether to show all lines; if false, the picture shows the region of the muscles.

    Raises:
        MusculoskeletalError: If the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 5.0), layout='constrained')
    every = np.concatenate([line.points for line in lines if whole or line.kind == 'muscles'])
    middle = 0.5 * (every.max(axis=0) + every.min(axis=0))
    reach = 0.5 * np.ptp(every, axis=0).max() + 0.03
    lines = [part for line in lines if len((part := _within(line, middle, reach)).points)]
    balls = {'solid_capstyle': 'round', 'marker': 'o', 'mec': '0.35', 'mew': 0.5}
    for i, (azimuth, name) in enumerate([(-10.0, 'from the front'), (-80.0, 'from the right')]):
        axes: Any = figure.add_subplot(1, 2, i + 1, projection='3d', proj_type='ortho')
        for line in lines:
            width = 400.0 * line.width
            # Balls mark joints and via points.
            axes.plot(*line.points.T, color=line.colour, lw=width, ms=BALL_SIZE * width, **balls)
        axes.set(title=name, xlabel='x [m]', ylabel='y [m]', zlabel='z [m]')
        axes.set(**{f'{x}lim': (m - reach, m + reach) for x, m in zip('xyz', middle)})
        axes.set_box_aspect((1.0, 1.0, 1.0), zoom=1.05)
        axes.locator_params(nbins=5)
        axes.view_init(elev=10.0, azim=azimuth)
    figure.suptitle(title or 'muscles: green at bias tension, red at the limit')
    save_figure(figure, path)
