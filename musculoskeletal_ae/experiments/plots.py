# SPDX-License-Identifier: Apache-2.0
"""Shared plot elements: colours, axes, legends, and pictures of arms in rows and columns."""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np

from musculoskeletal_ae.experiments.recording import Motion
from musculoskeletal_ae.robot.description import shown
from musculoskeletal_ae.robot.drawing import draw_arm
from musculoskeletal_ae.robot.robot import Robot

# Readers with a colour-vision deficiency can distinguish these colours. In a grey print, only TRUE
# stands out. The web page draws the estimated arm in the colour of AFTER.
BEFORE, AFTER, AS_PRINTED, TRUE, MARK = '#D55E00', '#009E73', '#CC79A7', '#222222', '#999999'
#: colours of results before and after learning
WHEN = {'before': BEFORE, 'after': AFTER}
DPI = 110
POINTS = 1500  # draw at most this many points of a line, which keeps the files small

#: positions of legends that never hide data
LEGENDS: dict[str, dict[str, Any]] = {
    'right': {'loc': 'center left', 'bbox_to_anchor': (1.0, 0.5)},
    'above': {'loc': 'lower right', 'bbox_to_anchor': (1.0, 1.0), 'ncols': 4, 'frameon': False},
    'below': {'loc': 'upper center', 'bbox_to_anchor': (0.5, -0.16), 'ncols': 2},
}
MARGIN = 0.03  # leave this free space around an arm [m]
HEADER = 0.9  # leave this height above the pictures for the titles [inch]
VIEW = (12.0, -35.0)  # elevation and azimuth of the camera [deg]: mainly from the front
STYLES: dict[str, dict[str, Any]] = {
    'bones': {'linewidth': 6.0, 'solid_capstyle': 'round', 'zorder': 1},
    'muscles': {'linewidth': 2.0, 'zorder': 2},
}


def new_figure(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> Any:
    """Return a figure of `width` × `height` [inch], and an array of its axes, row by row."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout='constrained')
    return figure, figure.subplots(rows, columns, squeeze=False, **options).ravel()


def tidy(axes: Any, xlabel: str = '', ylabel: str = '', title: str = '', legend: str = '') -> None:
    """Label axes, add a light grid, and hide the upper and right border.

    `legend` names a position of `LEGENDS`; without it, there is no legend.
    """
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.set_title(title, loc='left' if legend == 'above' else 'center')
    axes.grid(alpha=0.25)
    axes.set_axisbelow(True)
    axes.spines[['top', 'right']].set_visible(False)
    if legend:
        axes.legend(fontsize=9, **LEGENDS[legend])


def line(axes: Any, x: Any, y: Any, window: int = 1, **style: Any) -> None:
    """Draw the centred mean of y over `window` samples as a line of at most `POINTS` points."""
    step, kernel = max(1, len(x) // POINTS), np.ones(max(1, min(window, len(y))))
    # At the ends of the line, the window has fewer samples than in the middle.
    count = np.convolve(np.ones(len(y)), kernel, mode='same')
    axes.plot(x[::step], (np.convolve(y, kernel, mode='same') / count)[::step], **style)


def mean_of_known(values: Any, digits: int = 3) -> tuple[float, str]:
    """Return the mean over the individuals that have a value, and its label.

    The label states how many individuals have a value, if not all of them do. NaN stands for no
    value. If there is none at all, the mean is 0 and the label is `none`.
    """
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known)]
    if not len(known):
        return 0.0, 'none'
    mean = float(known.mean())
    count = '' if len(known) == len(values) else f' ({len(known)} of {len(values)})'
    return mean, f'{mean:.{digits}f}{count}'


def bars(
    panel: Any, names: Sequence[str], groups: Mapping[str, tuple[str, Any]], xlabel: str, title: str
) -> None:
    """Draw means over N individuals as bars with their values, and a dot for each individual.

    `groups` maps labels to a colour and values (N, K) of the K names. NaN stands for no value
    (`mean_of_known`). `panel` are the axes to draw in, with a title and a label of the x axis.
    """
    place, height = np.arange(len(names)), 0.8 / len(groups)
    for g, (label, (colour, values)) in enumerate(groups.items()):
        at = place + (g - 0.5 * (len(groups) - 1)) * height
        columns = np.transpose(values)
        means = [mean_of_known(column) for column in columns]
        panel.barh(at, [mean for mean, _ in means], 0.95 * height, color=colour, label=label)
        panel.plot(columns, at, '.', color=TRUE, ms=4)
        for y, (_, text), column in zip(at, means, columns):
            style = {'textcoords': 'offset points', 'va': 'center', 'fontsize': 9}
            panel.annotate(text, (column[np.isfinite(column)].max(initial=0.0), y), (6, 0), **style)
    panel.set_yticks(place, names)
    panel.invert_yaxis()
    panel.margins(x=0.12)
    tidy(panel, xlabel, '', title, legend='below' if len(groups) > 1 else '')


def ranked_bars(
    panel: Any,
    values: Mapping[str, Sequence[float | None]],
    colours: Sequence[str],
    xlabel: str,
    title: str,
    digits: int = 3,
) -> None:
    """Draw one bar per name: the mean over individuals, with a dot for each individual.

    A column beside the axes shows the means as numbers, with `digits` after the point. `values`
    maps names to the individuals' values; None stands for no value (`mean_of_known`). `colours`
    has one colour for each name. `panel` are the axes to draw in.
    """
    place = np.arange(len(values))
    numbers = {name: np.array(each, dtype=float) for name, each in values.items()}
    means = [mean_of_known(each, digits) for each in numbers.values()]
    panel.barh(place, [mean for mean, _ in means], 0.7, color=list(colours))
    for at, each, (_, text) in zip(place, numbers.values(), means):
        panel.plot(each, [at] * len(each), 'o', color=TRUE, ms=4, mfc='white', mew=1.0)
        # The column lies beside the axes, where it hides no dot.
        style = {'textcoords': panel.get_yaxis_transform(), 'va': 'center', 'fontsize': 9}
        panel.annotate(text, (0.0, at), (1.02, at), annotation_clip=False, **style)
    heading = {'va': 'bottom', 'fontsize': 9, 'fontweight': 'bold'}
    panel.text(1.02, 1.0, 'mean', transform=panel.transAxes, **heading)
    panel.set_yticks(place, [*values])
    panel.invert_yaxis()
    panel.margins(x=0.05)
    tidy(panel, xlabel, '', title)


def pictures(
    robot: Robot, motions: Mapping[str, Motion], moments: Mapping[str, int], title: str
) -> Any:
    """Draw arms in a grid: a row for each motion, and a column for each step in `moments`.

    Bones are grey; muscles are green at T_bias and red at T_limit.
    """
    from matplotlib.figure import Figure

    rows, columns = len(motions), len(moments)
    height = 2.6 * rows + HEADER
    figure = Figure(figsize=(2.5 * columns + 0.4, height))
    # A layout engine would reserve space for the empty corners of the 3D boxes.
    figure.subplots_adjust(0.04, 0.02, 1.0, 1.0 - HEADER / height, 0.0, 0.05)
    steps = list(moments.values())
    postures = np.concatenate([motion.theta[steps] for motion in motions.values()])
    tips = [robot.kinematics.end_effector_pose(theta).translation for theta in postures]
    points = np.vstack([robot.routes.points(postures).reshape(-1, 3), *tips, np.zeros(3)])
    low, high = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
    cells = product(motions.items(), moments.items())
    for place, ((name, motion), (moment, step)) in enumerate(cells):
        axes: Any = figure.add_subplot(rows, columns, place + 1, projection='3d')
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set_box_aspect(tuple(high - low), zoom=1.5)
        axes.view_init(elev=VIEW[0], azim=VIEW[1])
        axes.set_axis_off()
        for part in draw_arm(robot, motion.theta[step], motion.tension[step]):
            colour = 0.9 * np.array(part.colour)
            axes.plot(*part.points.T, color=colour, clip_on=False, **STYLES[part.kind])
        if place < columns:
            axes.set_title(moment, fontsize=10, pad=2)
        if place % columns == 0:
            axes.text2D(0.0, 0.5, name, transform=axes.transAxes, rotation=90, va='center')
        note = f'‖T‖ {np.linalg.norm(motion.tension[step]):.0f} N'
        axes.text2D(0.5, 0.02, note, transform=axes.transAxes, ha='center', fontsize=9)
    low_n, high_n = shown(robot.tension.bias), shown(robot.tension.limit)
    figure.suptitle(
        f'{title}\nmuscles: green at {low_n} N, red at {high_n} N and above', fontsize=11
    )
    return figure
