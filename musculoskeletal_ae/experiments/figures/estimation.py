# SPDX-License-Identifier: Apache-2.0
"""Estimate and anomaly through grasp and cut; every muscle's cut; the older estimators."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from musculoskeletal_ae.experiments.figures.style import (
    AFTER,
    BEFORE,
    MARK,
    TRUE,
    Plot,
    new_figure,
    save,
    smooth,
    thinned,
    tidy,
)
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME
from musculoskeletal_ae.experiments.suite.roles import plotted
from musculoskeletal_ae.experiments.suite.scenario import CUT_TIME, PAYLOAD
from musculoskeletal_ae.experiments.suite.study import Measured, Study
from musculoskeletal_ae.robot.robot import Robot

WHEN = {'before': BEFORE, 'after': AFTER}
SHOWN = 60.0  # [s] before the grasp
TAIL = 3.0  # [s] after the mending


def plot(study: Study, robot: Robot, rows: Mapping[int, Measured], folder: Path) -> list[Plot]:
    """Draw all plots."""
    seed, first = next(iter(rows.items()))
    return [
        _course(robot, seed, first, folder),
        _tracking(robot, seed, first, folder),
        _cuts(robot, rows, folder),
        _rivals(study, rows, folder),
    ]


def _span(trace: Mapping[str, Any]) -> tuple[slice, Any]:
    start = max(0.0, trace['grasp'] - SHOWN)
    end = float(trace['cut'][trace['first_cut']]) + CUT_TIME + TAIL
    rows = slice(round(start / SAMPLE_TIME), round(end / SAMPLE_TIME))
    count = len(trace['theta'][rows])
    return rows, start + SAMPLE_TIME * np.arange(count)


def _events(axes: Any, trace: Mapping[str, Any]) -> None:
    cut = float(trace['cut'][trace['first_cut']])
    axes.axvline(trace['grasp'], color=MARK, ls='--', lw=1)
    axes.axvspan(cut, cut + CUT_TIME, color='#F0E442', alpha=0.5, lw=0)


def _course(robot: Robot, seed: int, row: Measured, folder: Path) -> Plot:
    trace = row.traces
    rows, time = _span(trace)
    figure, axes = new_figure(12.0, 8.0, 3, 1, sharex=True)
    error_axes, a_axes, d_axes = axes[:, 0]
    for when, colour in WHEN.items():
        seen = trace[when]
        error = np.linalg.norm(seen['theta'] - trace['theta'], axis=1)[rows]
        mean = row.numbers[f'{when}_rad'], row.numbers[f'{when}_payload_rad']
        label = f'{when} learning ({mean[0]:.3f} rad, with weight {mean[1]:.3f} rad)'
        error_axes.plot(*thinned(time, smooth(error, 50)), color=colour, lw=1, label=label)
        for panel, key in ((a_axes, 'anomaly'), (d_axes, 'distance')):
            values = thinned(time, seen[key][rows])
            panel.semilogy(*values, color=colour, lw=1, label=f'{when} learning')
    d_axes.axhline(trace['threshold'], color=TRUE, ls=':', label="detector's threshold")
    error_axes.set_yscale('log')
    name = robot.muscles[trace['first_cut']]
    cut = float(trace['cut'][trace['first_cut']])
    above = error_axes.get_xaxis_transform()
    error_axes.text(trace['grasp'], 1.02, f'grasps {PAYLOAD:g} kg', transform=above, ha='center')
    error_axes.text(cut, 1.02, f'{name} cut', transform=above, ha='center')
    tidy(error_axes, '', '‖θ_est − θ‖ [rad], 0.5 s mean')
    tidy(a_axes, '', 'A [scaled units]')
    tidy(d_axes, 'time [s]', 'd [healthy std. dev.]')
    for panel in axes[:, 0]:
        _events(panel, trace)
        panel.legend(loc='upper left', fontsize=9)
    figure.suptitle(f'individual {seed}')
    return save(
        figure,
        folder,
        'grasp_and_cut',
        f'Estimation error, the paper’s anomaly A, and the distance d that the detector judges, '
        f'on the same recording before and after learning: the arm grasps {PAYLOAD:g} kg (dashed), '
        f'then {name} is cut (yellow) and mended.',
    )


def _tracking(robot: Robot, seed: int, row: Measured, folder: Path) -> Plot:
    trace = row.traces
    rows, time = _span(trace)
    count = robot.joint_count
    figure, axes = new_figure(12.0, 1.6 * count + 0.8, count, 1, sharex=True)
    for joint, panel in enumerate(axes[:, 0]):
        factor, unit = plotted(robot, joint)
        for when, colour in WHEN.items():
            angle = factor * trace[when]['theta'][rows, joint]
            panel.plot(*thinned(time, angle), color=colour, lw=0.8, label=f'{when} learning')
        true = factor * trace['theta'][rows, joint]
        panel.plot(*thinned(time, true), color=TRUE, lw=1.2, label='true')
        span = np.ptp(true) + 1.0
        panel.set_ylim(true.min() - 0.4 * span, true.max() + 0.4 * span)
        _events(panel, trace)
        tidy(panel, '', f'{robot.joints[joint]}\n[{unit}]')
    axes[0, 0].legend(loc='lower left', ncols=3, fontsize=9)
    axes[0, 0].set_title(f'individual {seed}')
    axes[-1, 0].set_xlabel('time [s]')
    return save(
        figure,
        folder,
        'tracking',
        'Joint angles of the same minutes: true, and estimated before and after learning. Dashed: '
        'grasp; yellow: muscle cut.',
    )


def _cuts(robot: Robot, rows: Mapping[int, Measured], folder: Path) -> Plot:
    figure, axes = new_figure(12.0, 0.42 * robot.muscle_count + 1.9, 1, 3, sharey=True)
    place = np.arange(robot.muscle_count)
    numbers = [row.numbers for row in rows.values()]
    for letter, panel, title in (('a', axes[0, 0], 'A of the paper'), ('d', axes[0, 1], 'd')):
        for when, prefix, shift in (('before', '_before', -0.18), ('after', '', 0.18)):
            colour = WHEN[when]
            level = np.array([n[f'{letter}{prefix}_ruptured'] for n in numbers])
            calm = max(n[f'{letter}{prefix}_healthy_max'] for n in numbers)
            for each in level:
                panel.plot(each, place + shift, 'o', color=colour, alpha=0.6, ms=5)
            panel.plot([], [], 'o', color=colour, label=f'cut, {when} learning')
            panel.axvline(calm, color=colour, ls='--', lw=1, label=f'largest healthy, {when}')
        _whole_decades(panel)
        tidy(panel, f'{title} [{"scaled units" if letter == "a" else "healthy std. dev."}]')
        panel.legend(fontsize=8, loc='upper center', bbox_to_anchor=(0.5, -0.16), ncols=2)
    panel = axes[0, 2]
    for each in numbers:
        for m, cut in enumerate(each['cuts'].values()):
            marker = 'o' if cut['named'] else 'x'
            colour = AFTER if cut['carried'] else MARK
            panel.plot(cut['detection_s'], m, marker, color=colour, ms=6, mfc='none')
    panel.axvline(0.5, color=TRUE, ls=':', label='aim: 0.5 s')
    panel.axvline(CUT_TIME, color=BEFORE, ls=':', label='not found')
    panel.plot([], [], 'o', color=AFTER, mfc='none', label='named')
    panel.plot([], [], 'x', color=AFTER, label='other muscle named')
    panel.plot([], [], 'o', color=MARK, mfc='none', label='slack when cut')
    panel.set(xscale='log', xlim=(0.008, 1.3 * CUT_TIME))
    tidy(panel, 'time to detection [s]')
    panel.legend(fontsize=8, loc='upper center', bbox_to_anchor=(0.5, -0.16), ncols=2)
    axes[0, 0].set_yticks(place, robot.muscles)
    axes[0, 0].invert_yaxis()
    figure.suptitle('every muscle cut in turn, one point per individual')
    return save(
        figure,
        folder,
        'cuts',
        'Median of A and of d while each muscle is cut, beside the largest value in healthy '
        'motion (points right of the dashed line of their colour can be told from it), and how '
        'long the calibrated detector took.',
    )


def _whole_decades(panel: Any) -> None:
    """Use a logarithmic axis that begins and ends with a labelled tick."""
    low, high = panel.dataLim.intervalx
    panel.set_xscale('log')
    panel.set_xlim(10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high)))


def _rivals(study: Study, rows: Mapping[int, Measured], folder: Path) -> Plot:
    numbers = [row.numbers for row in rows.values()]
    names = [f'autoencoder, preset {study.preset}', *numbers[0]['baselines']]
    pairs = {when: [[n[f'{when}_held_out_rad'] for n in numbers]] for when in WHEN}
    for name in names[1:]:
        for when in WHEN:
            pairs[when].append([n['baselines'][name][f'{when}_rad'] for n in numbers])
    figure, axes = new_figure(9.0, 0.62 * len(names) + 1.3)
    panel = axes[0, 0]
    place = np.arange(len(names))
    for when, shift in (('before', -0.2), ('after', 0.2)):
        values = np.array(pairs[when])
        mean = values.mean(axis=1)
        panel.barh(place + shift, mean, 0.38, color=WHEN[when], label=f'{when} learning')
        for at, number, furthest in zip(place + shift, mean, values.max(axis=1), strict=True):
            panel.annotate(
                f'{number:.3f}',
                (furthest, at),
                xytext=(6, 0),
                va='center',
                fontsize=9,
                textcoords='offset points',
            )
        for each in values.T:
            panel.plot(each, place + shift, '.', color=TRUE, ms=4)
    panel.set_yticks(place, names)
    panel.invert_yaxis()
    panel.margins(x=0.12)
    tidy(panel, 'mean error [rad], held-out motion', '', 'estimators on the same data')
    panel.legend(fontsize=9)
    return save(
        figure,
        folder,
        'baselines',
        'Joint angle error of the autoencoder and of older estimators on the held-out motion. '
        'Learning: from the same samples at rest; "whole stream": from all messages at 10 Hz. '
        'Dots: individuals. The geometric model has nothing to learn.',
    )
