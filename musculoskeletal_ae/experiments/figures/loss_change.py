# SPDX-License-Identifier: Apache-2.0
"""Traces and pictures of the simulator while its loss changes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from musculoskeletal_ae.experiments.figures.arm import picture_rows
from musculoskeletal_ae.experiments.figures.style import TRUE, Plot, new_figure, save, tidy
from musculoskeletal_ae.experiments.suite.loss_change import PHASES, STEP
from musculoskeletal_ae.experiments.suite.roles import plotted
from musculoskeletal_ae.experiments.suite.study import Measured, Study
from musculoskeletal_ae.robot.robot import Robot

UNFORCED = 3  # phases that the emulated arm shares


def plot(study: Study, robot: Robot, rows: Mapping[int, Measured], folder: Path) -> list[Plot]:  # noqa: ARG001 (one signature for all)
    """Draw all plots."""
    seed, first = next(iter(rows.items()))
    return [_traces(robot, seed, first, folder), _pictures(robot, seed, first, folder)]


def _phases(first: Measured) -> list[str]:
    numbers = first.numbers
    flexed = f'{numbers["flexed_joint"]}\n{np.degrees(numbers["flexed_rad"]):.0f}°'
    forced = f'{numbers["forced_joint"]}\nforced to {np.degrees(numbers["forced_rad"]):.0f}°'
    return [flexed, PHASES[1].name, PHASES[2].name, forced, PHASES[4].name]


def _traces(robot: Robot, seed: int, row: Measured, folder: Path) -> Plot:
    figure, axes = new_figure(12.0, 7.4, 2, 1, sharex=True)
    time = STEP * np.arange(len(row.traces['after']['theta']))
    edges = np.cumsum([0.0, *(phase.duration for phase in PHASES)])
    shared = time < edges[UNFORCED] - 1e-9
    names = {'theta': robot.joints, 'tension': robot.muscles}
    for panel, key in ((axes[0, 0], 'theta'), (axes[1, 0], 'tension')):
        for i, name in enumerate(names[key]):
            colour = f'C{i}'
            factor, unit = plotted(robot, i) if key == 'theta' else (1.0, 'N')
            simulated = factor * row.traces['after'][key][:, i]
            arm = np.where(shared, factor * row.traces['arm'][key][:, i], np.nan)
            panel.plot(
                time,
                simulated,
                color=colour,
                lw=1.6,
                label=name if unit in ('deg', 'N') else f'{name} [{unit}]',
            )
            panel.plot(time, arm, color=colour, lw=1.0, ls='--')
        panel.plot([], [], color=TRUE, lw=1.6, label='simulator after learning')
        panel.plot([], [], color=TRUE, lw=1.0, ls='--', label='emulated arm')
        for edge in edges[1:-1]:
            panel.axvline(edge, color='#BBBBBB', lw=1)
        panel.legend(fontsize=8, loc='center left', bbox_to_anchor=(1.0, 0.5))
        panel.set_xlim(0.0, edges[-1])
    tidy(axes[0, 0], '', 'joint angle [deg]')
    tidy(axes[1, 0], 'time [s]', 'muscle tension [N]')
    for start, end, name in zip(edges[:-1], edges[1:], _phases(row), strict=True):
        axes[0, 0].text(
            0.5 * (start + end),
            1.02,
            name,
            ha='center',
            va='bottom',
            fontsize=9,
            transform=axes[0, 0].get_xaxis_transform(),
        )
    figure.suptitle(f'individual {seed}')
    return save(
        figure,
        folder,
        'loss_change',
        'The simulator after learning while the hand is pushed and a joint is forced, beside the '
        'emulated arm under the same pushes (dashed; its joints cannot be forced).',
    )


def _pictures(robot: Robot, seed: int, row: Measured, folder: Path) -> Plot:
    ends = np.cumsum([round(phase.duration / STEP) for phase in PHASES]) - 1
    moments = [int(n) for n in ends[:4]]
    rows = [
        (name, [row.traces[who]['theta'][n] for n in moments],
         [row.traces[who]['tension'][n] for n in moments])
        for who, name in (('before', 'before learning'), ('after', 'after learning'))
    ]  # fmt: skip
    columns = [name.replace('\n', ' ') for name in _phases(row)[:4]]
    figure = picture_rows(robot, rows, columns, f'simulator of individual {seed}')
    return save(
        figure,
        folder,
        'loss_change_pictures',
        'The simulator at the end of each phase, before and after learning.',
    )
