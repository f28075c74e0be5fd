# SPDX-License-Identifier: Apache-2.0
"""What an arm looks like: bones and muscles as lines, and a picture of them without a display.

A muscle is green at T_bias and turns red towards T_limit (paper, §IV-D).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.options import save_figure
from musculoskeletal_ae.robot.robot import Robot

# Shorter bones are two joints in one place.
SHORTEST_BONE = 1e-3  # [m]
BONE_WIDTH, MUSCLE_WIDTH = 0.02, 0.006  # [m]
BONE_COLOUR = (0.8, 0.8, 0.75)
BALL = 1.7  # of a line's width


class Line(NamedTuple):
    """A polyline in the root link's frame."""

    kind: Literal['bones', 'muscles']
    points: Array  # [m], (N, 3)
    width: float  # [m]
    colour: tuple[float, ...]  # red, green, blue in [0, 1]
    name: str = ''  # of the muscle; further branches of its tendon have none


def tension_share(robot: Robot, tension: Array) -> Array:
    """Return how far T [N] (M,) is on the way from T_bias to T_limit, within [0, 1]; NaN: 0."""
    limits = robot.tension
    known = np.nan_to_num(tension)
    return np.clip((known - limits.bias) / (limits.limit - limits.bias), 0.0, 1.0)


def draw_arm(robot: Robot, theta: Array, tension: Array, points: Array | None = None) -> list[Line]:
    """Return the bones of an arm, then its muscles in their order, at θ [rad] (D,) and T [N] (M,).

    A muscle is one line, or one for each branch of its tendon.

    Route points [m] (P, 3) are those of the geometric model by default.
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
    """Return a line from where it enters a cube to where it leaves it."""
    if line.kind != 'bones':
        return line
    start, end = line.points[[0, -1]]
    points = start + np.linspace(0.0, 1.0, 101)[:, None] * (end - start)
    inside = np.flatnonzero((np.abs(points - middle) <= reach).all(axis=1))
    return line._replace(points=points[inside[[0, -1]] if len(inside) else inside])


def save_picture(lines: Sequence[Line], path: Path, title: str = '', whole: bool = True) -> None:
    """Draw lines from the front and from the side, in true proportions, and save a picture.

    Or what of them is where the muscles are.

    Raises:
        MusculoskeletalError: If it cannot be written.
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
            # Balls where bones meet, and where a muscle's route is held.
            axes.plot(*line.points.T, color=line.colour, lw=width, ms=BALL * width, **balls)
        axes.set(title=name, xlabel='x [m]', ylabel='y [m]', zlabel='z [m]')
        axes.set(**{f'{x}lim': (m - reach, m + reach) for x, m in zip('xyz', middle)})
        axes.set_box_aspect((1.0, 1.0, 1.0), zoom=1.05)
        axes.locator_params(nbins=5)
        axes.view_init(elev=10.0, azim=azimuth)
    figure.suptitle(title or 'muscles: green at bias tension, red at the limit')
    save_figure(figure, path)
