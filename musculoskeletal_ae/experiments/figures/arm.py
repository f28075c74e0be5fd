# SPDX-License-Identifier: Apache-2.0
"""Pictures of arms in rows and columns: bones grey, muscles green at T_bias, red at T_limit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.drawing import draw_arm
from musculoskeletal_ae.robot.robot import Robot

MARGIN = 0.03  # [m]
HEADER = 0.9  # [inch] for the titles
VIEW = (12.0, -35.0)  # [deg] elevation, azimuth: from the front, a little from the side


def picture_rows(
    robot: Robot,
    rows: Sequence[tuple[str, Sequence[Array], Sequence[Array]]],
    columns: Sequence[str],
    title: str,
) -> Any:
    """Draw each row's arm at several moments.

    Args:
        robot: The body that is drawn.
        rows: For each its name, θ [rad] of every column and T [N] of every column.
        columns: What each moment is called.
        title: Of the figure.
    """
    from matplotlib.figure import Figure

    height = 2.6 * len(rows) + HEADER
    figure = Figure(figsize=(2.5 * len(columns) + 0.4, height))
    # A layout engine would make room for the empty corners of the boxes that arms stand in.
    figure.subplots_adjust(0.04, 0.02, 1.0, 1.0 - HEADER / height, 0.0, 0.05)
    every = np.concatenate([np.stack(thetas) for _, thetas, _ in rows])
    low, high = _reach(robot, every)
    for r, (name, thetas, tensions) in enumerate(rows):
        for c, (theta, tension) in enumerate(zip(thetas, tensions, strict=True)):
            axes: Any = figure.add_subplot(
                len(rows), len(columns), r * len(columns) + c + 1, projection='3d'
            )
            _draw(axes, robot, theta, tension)
            _frame(axes, low, high)
            if r == 0:
                axes.set_title(columns[c], fontsize=10, pad=2)
            if c == 0:
                axes.text2D(0.0, 0.5, name, transform=axes.transAxes, rotation=90, va='center')
            note = f'‖T‖ {np.linalg.norm(tension):.0f} N'
            axes.text2D(0.5, 0.02, note, transform=axes.transAxes, ha='center', fontsize=9)
    figure.suptitle(
        f'{title}\nmuscles: green at {robot.tension.bias:g} N, '
        f'red at {robot.tension.limit:g} N and above',
        fontsize=11,
    )
    return figure


def _draw(axes: Any, robot: Robot, theta: Array, tension: Array) -> None:
    drawing = draw_arm(robot, theta, tension)
    for bone in drawing.bones:
        axes.plot(
            *bone.T, color='#B8B8AE', linewidth=6.0, solid_capstyle='round', zorder=1, clip_on=False
        )
    for line, colour in zip(drawing.muscles, drawing.colours, strict=True):
        axes.plot(*line.T, color=tuple(0.85 * colour), linewidth=2.0, zorder=2, clip_on=False)


def _reach(robot: Robot, postures: Array) -> tuple[Array, Array]:
    points = robot.routes.points(postures).reshape(-1, 3)
    tips = [robot.kinematics.end_effector_pose(theta).translation for theta in postures]
    every = np.vstack([points, *tips, np.zeros(3)])
    middle = 0.5 * (every.max(axis=0) + every.min(axis=0))
    half = 0.5 * (every.max(axis=0) - every.min(axis=0)) + MARGIN
    return middle - half, middle + half


def _frame(axes: Any, low: Array, high: Array) -> None:
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(tuple(high - low), zoom=1.5)
    axes.view_init(elev=VIEW[0], azim=VIEW[1])
    axes.set_axis_off()
