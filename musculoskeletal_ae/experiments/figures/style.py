# SPDX-License-Identifier: Apache-2.0
"""What all plots share: sizes, colours, and how one is saved."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array

# Told apart by people who see colours differently, and in grey.
BEFORE, AFTER, PAPER, TRUE, MARK = '#D55E00', '#0072B2', '#CC79A7', '#222222', '#777777'
METHODS = {
    'geometric': '#999999',
    'first': '#E69F00',
    'second': '#009E73',
    'proposed': '#0072B2',
    'proposed_paper': '#CC79A7',
}
DPI = 110
#: most samples that a line is drawn with
POINTS = 1500


class Plot(NamedTuple):
    """A saved plot.

    Attributes:
        file: PNG.
        caption: What is seen, in a sentence or two.
    """

    file: Path
    caption: str


def new_figure(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> Any:
    """Return a figure and its axes, an array of shape (rows, columns)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout='constrained')
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def save(figure: Any, folder: Path, name: str, caption: str) -> Plot:
    """Write DIR/name.png."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f'{name}.png'
    figure.savefig(file, dpi=DPI)
    return Plot(file, caption)


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


def thinned(*columns: Array) -> tuple[Array, ...]:
    """Return every so many rows of arrays, so that a line has at most `POINTS`."""
    step = max(1, len(columns[0]) // POINTS)
    return tuple(column[::step] for column in columns)
