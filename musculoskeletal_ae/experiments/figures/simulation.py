# SPDX-License-Identifier: Apache-2.0
"""The simulator beside the arm: pictures, and errors over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from musculoskeletal_ae.experiments.figures.arm import picture_rows
from musculoskeletal_ae.experiments.figures.style import (
    AFTER,
    BEFORE,
    MARK,
    Plot,
    new_figure,
    save,
    smooth,
    thinned,
    tidy,
)
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME
from musculoskeletal_ae.experiments.suite.study import Measured, Study
from musculoskeletal_ae.robot.robot import Robot

PRINTED = {'rad': (0.335, 0.162), 'n': (105.0, 92.2)}
CYCLE = 10.0  # [s] of the exploration's three steps
MOMENTS = 5


def plot(study: Study, robot: Robot, rows: Mapping[int, Measured], folder: Path) -> list[Plot]:  # noqa: ARG001 (one signature for all)
    """Draw all plots."""
    seed, first = next(iter(rows.items()))
    return [_pictures(robot, seed, first, folder), _errors(seed, first, folder)]


def _pictures(robot: Robot, seed: int, row: Measured, folder: Path) -> Plot:
    trace = row.traces
    count = len(trace['theta'])
    # The ends of as many cycles: at rest, with the random tensions of the third step.
    ends = (np.arange(count * SAMPLE_TIME // CYCLE) * CYCLE + 9.9) / SAMPLE_TIME
    chosen = ends[np.linspace(0, len(ends) - 1, min(MOMENTS, len(ends))).round().astype(int)]
    moments = [int(at) for at in chosen]
    rows = [
        (name, [source['theta'][n] for n in moments], [source['tension'][n] for n in moments])
        for name, source in (
            ('arm', trace),
            ('simulator before learning', trace['before']),
            ('simulator after learning', trace['after']),
        )
    ]
    columns = [f'{SAMPLE_TIME * n:.0f} s' for n in moments]
    figure = picture_rows(robot, rows, columns, f'individual {seed}, the same commands')
    return save(
        figure,
        folder,
        'simulation_pictures',
        'The emulated arm (true posture, measured tensions, drawn with the model’s routes) and '
        'the simulator before and after learning, at the same moments of the same commands.',
    )


def _errors(seed: int, row: Measured, folder: Path) -> Plot:
    figure, axes = new_figure(12.0, 5.6, 2, 1, sharex=True)
    for panel, key, unit in ((axes[0, 0], 'rad', 'rad'), (axes[1, 0], 'n', 'N')):
        for when, colour in (('before', BEFORE), ('after', AFTER)):
            values = row.traces[when][key]
            time = np.asarray(SAMPLE_TIME * np.arange(len(values)), dtype=np.float64)
            mean = row.numbers[f'{when}_{key}']
            label = f'{when} learning: mean {mean:.3g} {unit}'
            panel.plot(*thinned(time, smooth(values, 25)), color=colour, lw=0.9, label=label)
        before, after = PRINTED[key]
        panel.plot([], [], ' ', label=f'paper: {before:g} → {after:g} {unit}')
        panel.axhline(after, color=MARK, ls=':', lw=1)
        panel.set_ylim(bottom=0.0)
        panel.legend(fontsize=9, loc='upper right', ncols=3)
    tidy(axes[0, 0], '', '‖θ_sim − θ‖ [rad]', f'individual {seed}')
    tidy(axes[1, 0], 'time [s]', '‖T_sim − T‖ [N]')
    return save(
        figure,
        folder,
        'simulation_errors',
        'Distance of the simulator from the arm under the same commands (0.25 s running mean). '
        'Dotted: the paper’s mean after learning.',
    )
