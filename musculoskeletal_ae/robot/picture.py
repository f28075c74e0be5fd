# SPDX-License-Identifier: Apache-2.0
"""A picture of an arm, from its lines, without a display."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array

BALL = 1.7  # of a line's width


class Line(NamedTuple):
    """A polyline.

    Attributes:
        points: In the root link's frame [m], shape (N, 3).
        width: Line width [m].
        colour: Red, green, blue in [0, 1].
    """

    points: Array
    width: float
    colour: tuple[float, float, float]


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
