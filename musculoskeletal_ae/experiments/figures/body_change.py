# SPDX-License-Identifier: Apache-2.0
"""Muscle length against a joint angle and against tension, before and after learning."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.experiments.figures.style import (
    AFTER,
    BEFORE,
    TRUE,
    Plot,
    new_figure,
    save,
    tidy,
)
from musculoskeletal_ae.experiments.suite.study import Measured, Study
from musculoskeletal_ae.robot.robot import Robot

COLUMNS = 5
LINES = (('before', BEFORE, 'before learning'), ('after', AFTER, 'after learning'))


def plot(study: Study, robot: Robot, rows: Mapping[int, Measured], folder: Path) -> list[Plot]:  # noqa: ARG001 (one signature for all)
    """Draw all plots."""
    seed, first = next(iter(rows.items()))
    trace, joint = first.traces, first.traces['joint']
    degrees = np.degrees(trace['angle'])
    angle = _grid(robot, degrees, trace['by_angle'], trace['angle_trained'], f'θ of {joint} [deg]')
    angle.suptitle(f'individual {seed}: muscle length at T = 0, all other joints at 0')
    tension = _grid(robot, trace['tension'], trace['by_tension'], trace['tension_trained'], 'T [N]')
    tension.suptitle(f'individual {seed}: muscle length at θ = 0')
    return [
        save(
            angle,
            folder,
            'length_against_angle',
            f'Muscle length against {joint} at no tension. Dotted: outside the joint’s limits, '
            'where nothing was trained.',
        ),
        save(
            tension,
            folder,
            'length_against_tension',
            'Muscle length against tension at θ = 0. Dotted: tensions that no sample of the '
            'exploration held.',
        ),
    ]


def _grid(
    robot: Robot, x: Array, lines: Mapping[str, Array], trained: NDArray[np.bool_], xlabel: str
) -> Any:
    columns = min(COLUMNS, robot.muscle_count)
    rows = -(-robot.muscle_count // columns)
    figure, axes = new_figure(2.6 * columns + 0.6, 2.4 * rows + 0.9, rows, columns, sharex=True)
    for m, panel in enumerate(axes.flat):
        if m >= robot.muscle_count:
            panel.set_axis_off()
            continue
        for name, colour, label in (*LINES, ('true', TRUE, 'true body')):
            y, width = 1e3 * lines[name][:, m], 1.0 if name == 'true' else 1.8
            inside = np.where(trained, y, np.nan)
            panel.plot(x, y, color=colour, lw=width, ls=':')
            panel.plot(x, inside, color=colour, lw=width, label=label if m == 0 else None)
        tidy(panel, '', '', f'{m + 1} {robot.muscles[m]}')
        panel.title.set_fontsize(9)
        if m % columns == 0:
            panel.set_ylabel('l [mm]')
        if m + columns >= robot.muscle_count:
            panel.set_xlabel(xlabel)
            panel.tick_params(labelbottom=True)
    figure.legend(loc='outside lower center', ncols=3, fontsize=9)
    return figure
