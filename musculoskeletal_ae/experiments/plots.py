# SPDX-License-Identifier: Apache-2.0
"""What all plots share: colours, axes, and pictures of arms in rows and columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.drawing import draw_arm
from musculoskeletal_ae.robot.robot import Robot

# Told apart by people who see colours differently, and in grey.
BEFORE, AFTER, PAPER, TRUE, MARK = '#D55E00', '#0072B2', '#CC79A7', '#222222', '#777777'
#: before and after learning
WHEN = {'before': BEFORE, 'after': AFTER}
DPI = 110
#: most samples that a line is drawn with
POINTS = 1500

MARGIN = 0.03  # [m] round an arm
HEADER = 0.9  # [inch] for the titles
VIEW = (12.0, -35.0)  # [deg] elevation, azimuth: from the front, a little from the side


class Plot(NamedTuple):
    """A plot.

    Attributes:
        name: Of its file, without suffix.
        figure: Matplotlib's.
        caption: What is seen, in a sentence or two.
    """

    name: str
    figure: Figure
    caption: str


def new_figure(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> Any:
    """Return a figure and its axes, an array of shape (rows, columns)."""
    figure = Figure(figsize=(width, height), layout='constrained')
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def tidy(axes: Any, xlabel: str = '', ylabel: str = '', title: str = '') -> None:
    """Label axes, light grid, no box."""
    axes.set(xlabel=xlabel, ylabel=ylabel, title=title)
    axes.grid(alpha=0.25)
    axes.spines[['top', 'right']].set_visible(False)


def smooth(values: Array, window: int) -> Array:
    """Return a centred running mean of the same length, shorter windows at the ends."""
    window = max(1, min(window, len(values)))
    kernel = np.ones(window)
    total = np.convolve(values, kernel, mode='same')
    count = np.convolve(np.ones(len(values)), kernel, mode='same')
    mean: Array = total / count
    return mean


def line(axes: Any, x: Any, y: Any, window: int = 1, **style: Any) -> None:
    """Draw a line of at most `POINTS` points through y, or its running mean over a window."""
    step = max(1, len(x) // POINTS)
    axes.plot(x[::step], smooth(y, window)[::step], **style)


def picture_rows(
    robot: Robot,
    rows: Sequence[tuple[str, Sequence[Array], Sequence[Array]]],
    columns: Sequence[str],
    title: str,
) -> Figure:
    """Draw each row's arm at several moments: bones grey, muscles green at T_bias, red at T_limit.

    Args:
        robot: The body that is drawn.
        rows: For each its name, θ [rad] of every column and T [N] of every column.
        columns: What each moment is called.
        title: Of the figure.
    """
    height = 2.6 * len(rows) + HEADER
    figure = Figure(figsize=(2.5 * len(columns) + 0.4, height))
    # A layout engine would make room for the empty corners of the boxes that arms stand in.
    figure.subplots_adjust(0.04, 0.02, 1.0, 1.0 - HEADER / height, 0.0, 0.05)
    low, high = _reach(robot, np.concatenate([np.stack(thetas) for _, thetas, _ in rows]))
    for r, (name, thetas, tensions) in enumerate(rows):
        for c, (theta, tension) in enumerate(zip(thetas, tensions, strict=True)):
            place = len(rows), len(columns), r * len(columns) + c + 1
            axes: Any = figure.add_subplot(*place, projection='3d')
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
            axes.set_box_aspect(tuple(high - low), zoom=1.5)
            axes.view_init(elev=VIEW[0], azim=VIEW[1])
            axes.set_axis_off()
            _draw(axes, robot, theta, tension)
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
    styles: dict[str, dict[str, Any]] = {
        'bones': {'linewidth': 6.0, 'solid_capstyle': 'round', 'zorder': 1},
        'muscles': {'linewidth': 2.0, 'zorder': 2},
    }
    for line in draw_arm(robot, theta, tension):
        colour = 0.9 * np.array(line.colour)
        axes.plot(*line.points.T, color=tuple(colour), clip_on=False, **styles[line.kind])


def _reach(robot: Robot, postures: Array) -> tuple[Array, Array]:
    """Return the corners of a box round an arm in all postures [m]."""
    points = robot.routes.points(postures).reshape(-1, 3)
    tips = [robot.kinematics.end_effector_pose(theta).translation for theta in postures]
    every = np.vstack([points, *tips, np.zeros(3)])
    return every.min(axis=0) - MARGIN, every.max(axis=0) + MARGIN
