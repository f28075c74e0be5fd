# SPDX-License-Identifier: Apache-2.0
"""Readings beside the arm: status, curves, and a bar for each muscle."""

import math
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.messages.arrival import SILENCE
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.view import body

LEFT_PANEL = 350  # width of the left panel [pixels]
ARMS = {'measured': (176, 180, 186), 'estimated': (0, 158, 115), 'simulated': (148, 103, 189)}
ENVIRONMENT = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True)
#: the macros of the template, which write the HTML of the panel
HTML: Any = ENVIRONMENT.get_template('page.html.jinja').module
DURATION = 60.0  # let the curves show this much time before now [s]
GREEN, BLUE = {'stroke': '#009e73', 'width': 2}, {'stroke': '#0072b2', 'width': 2}
DASHED = {'stroke': '#c80082', 'width': 2, 'dash': [6, 4]}
HEIGHT = 84  # height of a plot of the curves [pixels]
TIME_AXIS = {'incrs': [0.25 * DURATION], 'space': 30, 'size': 26}
#: `incrs` lists the possible distances between ticks. uPlot takes the smallest one that covers at
#: least `space` pixels, which is half of any `scale_top`. The same axes serve all scales, because
#: viser's charts would lose the time axis if the axes changed.
VALUE_AXIS = {
    'incrs': [step * 10.0**power for power in range(-6, 7) for step in (0.5, 1.0, 2.5)],
    'space': 18,
    'size': 56,
}
AXES = TIME_AXIS, VALUE_AXIS


class Trace(NamedTuple):
    """One plot: title, line styles, and the indices of the values that it shows."""

    title: str
    lines: tuple[Any, ...]
    values: tuple[int, ...]


def curves(unit: str) -> tuple[Trace, ...]:
    """Return the curves that the page draws; `unit` is the unit of the estimation error."""
    return (
        Trace(f'error of the estimate [{unit}]', (GREEN,), (0,)),
        Trace('A: mismatch between T and l', (BLUE,), (1,)),
        # There is no dashed line until the detector is calibrated.
        Trace('d: A relative to its healthy spread (dashed: limit)', (BLUE, DASHED), (2, 3)),
    )


class History:
    """The last minute of the values for the curves; NaN where unknown."""

    def __init__(self) -> None:
        self._rows: deque[list[float]] = deque()

    def add(self, now: float, values: Sequence[float]) -> None:
        """Add the values at a time [s]."""
        self._rows.append([now, *values])
        while self._rows[0][0] < now - DURATION:
            self._rows.popleft()

    def curve(self, values: Sequence[int]) -> tuple[Array, ...]:
        """Return the curves since the last gap: times relative to now [s], then the values.

        `values` are the indices of the values to return. Rows in which the first of them is unknown
        are left out. Other unknown values are replaced by the first value of their row, so that the
        first line hides them.
        """
        table = np.array(self._rows)
        if not len(table):
            return (np.zeros(0),) * (1 + len(values))
        time, columns = table[:, 0], table[:, 1:].T[list(values)]
        known = ~np.isnan(columns[0])
        now, time, columns = time[-1], time[known], columns[:, known]
        gaps = np.flatnonzero(np.diff(time) > SILENCE)
        start = gaps[-1] + 1 if len(gaps) else 0
        time, columns = time[start:], columns[:, start:]
        columns = np.where(np.isnan(columns), columns[0], columns)
        return (time - now, *columns)


def scale_top(largest: float) -> float:
    """Return the smallest of the numbers …, 0.5, 1, 2, 5, 10, … that is at least `largest`.

    The result is 1 if `largest` is not positive or not finite.
    """
    if not 0.0 < largest < math.inf:
        return 1.0
    power = 10.0 ** math.floor(math.log10(largest))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= largest)


class ReadingsPanel:
    """The readings of one visitor, in a separate panel unless the window is narrow."""

    def __init__(self, gui: Any, robot: Robot, is_narrow: bool) -> None:
        self._plots: list[tuple[Trace, Any]] = []
        self._tops: list[float] = []
        if is_narrow:
            self._status = gui.add_html('', order=-2.0)
            with gui.add_folder('Muscles', order=100.0):
                self._bars = gui.add_html('')
                self._add_legend(gui)
            with gui.add_folder('Curves', order=101.0, expand_by_default=False):
                self._add_plots(gui, robot)
            return
        panel = gui.add_panel()
        with panel.add_tab(robot.description.directory.name):
            self._status = gui.add_html('')
            self._add_plots(gui, robot)
            self._bars = gui.add_html('')
            self._add_legend(gui)
        panel.dock_left()
        panel.set_width(LEFT_PANEL)

    @staticmethod
    def _add_legend(gui: Any) -> None:
        gui.add_html(str(HTML.legend(ARMS, [tuple(end.tolist()) for end in body.ENDS])))

    def _add_plots(self, gui: Any, robot: Robot) -> None:
        look: dict[str, Any] = {'legend': {'show': False}, 'cursor': {'show': False}}
        for curve in curves(robot.units.distance_unit):
            empty = (np.zeros(0),) * (1 + len(curve.lines))
            plot = gui.add_uplot(
                empty, ({}, *curve.lines), title=curve.title, height=HEIGHT,
                scales=_scales(1.0), axes=AXES, padding=(8, 8, 0, 0), **look,
            )  # fmt: skip
            self._plots.append((curve, plot))
            self._tops.append(1.0)

    def show(self, status: str, bars: str, history: History) -> None:
        """Show the status and the muscles' bars, both HTML, and the curves of the history."""
        self._status.content, self._bars.content = status, bars
        for number, (curve, plot) in enumerate(self._plots):
            data = history.curve(curve.values)
            top = scale_top(1.05 * max(float(line.max(initial=0.0)) for line in data[1:]))
            if top != self._tops[number]:
                self._tops[number] = top
                plot.scales = _scales(top)
            plot.data = data


def _scales(top: float) -> dict[str, Any]:
    x = {'time': False, 'auto': False, 'range': (-DURATION, 0.0)}
    return {'x': x, 'y': {'auto': False, 'range': (0.0, top)}}
