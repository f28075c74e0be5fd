# SPDX-License-Identifier: Apache-2.0
"""Error of the estimate while learning, against time and against samples."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.experiments.figures.style import (
    AFTER,
    MARK,
    PAPER,
    Plot,
    new_figure,
    save,
    smooth,
    tidy,
)
from musculoskeletal_ae.experiments.suite.study import Measured, Study
from musculoskeletal_ae.robot.robot import Robot

PRINTED_MINUTES = 10.0
PRINTED = (0.324, 0.154)  # [rad] the paper's fit at the start and after ten minutes
COLOURS = {'paper': PAPER, 'default': AFTER}


def _fitted(time: Array, error: Array) -> Array:
    """Return a + b e^{−t/c} fitted to the error."""
    from scipy.optimize import curve_fit

    def model(t: Array, a: float, b: float, c: float) -> Array:
        values: Array = a + b * np.exp(-t / c)
        return values

    span = float(time[-1])
    guess = float(error[-len(error) // 5 :].mean()), float(error[:10].mean()), span / 5.0
    bounds = [0.0, 0.0, 1.0], [10.0, 10.0, 10.0 * span]
    return model(time, *curve_fit(model, time, error, guess, bounds=bounds)[0])


def plot(study: Study, robot: Robot, rows: Mapping[int, Measured], folder: Path) -> list[Plot]:  # noqa: ARG001 (one signature for all)
    """Draw the running error with its exponential fit, and the held-out error over samples."""
    figure, axes = new_figure(12.0, 4.6, 1, 2, width_ratios=(3, 2))
    time_axes, sample_axes = axes[0]
    for preset, colour in COLOURS.items():
        running = np.array([row.traces[preset]['running'] for row in rows.values()])
        seconds = np.asarray(np.arange(running.shape[1]) + 0.5, dtype=np.float64)
        mean = running.mean(axis=0)
        for each in running if len(running) > 1 else ():
            time_axes.plot(seconds / 60, smooth(each, 10), color=colour, lw=0.5, alpha=0.25)
        time_axes.plot(
            seconds / 60, smooth(mean, 10), color=colour, lw=1.2, label=f'preset {preset}'
        )
        start, end = (
            np.mean([row.traces[preset][f'fit_{at}_rad'] for row in rows.values()])
            for at in ('start', 'end')
        )
        label = f'exponential fit: {start:.3f} → {end:.3f} rad'
        fitted = _fitted(seconds, mean)
        time_axes.plot(seconds / 60, fitted, color=colour, lw=2.5, ls='--', label=label)
        for number, row in enumerate(rows.values()):
            trace = row.traces[preset]
            sample_axes.plot(
                trace['curve_samples'],
                trace['curve_errors'],
                color=colour,
                lw=1.2,
                alpha=0.7,
                label=f'preset {preset}' if number == 0 else None,
            )
    ends = f'paper, on Musashi, 10 min: {PRINTED[0]} → {PRINTED[1]} rad'
    at = [0.0, PRINTED_MINUTES] if study.minutes >= PRINTED_MINUTES else [np.nan, np.nan]
    time_axes.plot(at, PRINTED, 'o', color=MARK, clip_on=False, label=ends)
    oracle = float(np.mean([row.numbers['oracle_rad'] for row in rows.values()]))
    sample_axes.axhline(oracle, color=MARK, ls=':', label=f'oracle {oracle:.3f} rad')
    tidy(time_axes, 'time of exploration [min]', '‖θ_est − θ_sensor‖ [rad]', 'while exploring')
    tidy(sample_axes, 'samples at rest', 'mean error [rad]', 'held-out motion, each individual')
    for each_axes in axes[0]:
        each_axes.set_ylim(bottom=0.0)
        each_axes.legend(fontsize=9)
    seeds = ', '.join(map(str, rows))
    return [
        save(
            figure,
            folder,
            'online_learning',
            'Left: error of the estimate during online learning (10 s running means; bold: mean '
            f'over individuals {seeds}, pale: each), with the exponential fit of the paper. Right: '
            'error on the motion never used for learning, after every update.',
        )
    ]
