# SPDX-License-Identifier: Apache-2.0
"""Error and tension of the methods of control at each θ_eval."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from musculoskeletal_ae.experiments.control import PROTOCOL
from musculoskeletal_ae.experiments.figures.style import METHODS, TRUE, Plot, new_figure, save, tidy
from musculoskeletal_ae.experiments.suite.study import Measured, Study
from musculoskeletal_ae.robot.robot import Robot


def plot(study: Study, robot: Robot, rows: Mapping[int, Measured], folder: Path) -> list[Plot]:  # noqa: ARG001 (one signature for all)
    """Draw the bars of the first individual, and those of all together."""
    return [_bars(rows, folder, next(iter(rows))), _bars(rows, folder, None)]


def _bars(rows: Mapping[int, Measured], folder: Path, seed: int | None) -> Plot:
    chosen = list(rows.values()) if seed is None else [rows[seed]]
    errors = np.array([row.traces['errors'] for row in chosen])  # (seeds, methods, θ_eval, starts)
    tensions = np.array([row.traces['tensions'] for row in chosen])
    bounds = np.array([row.traces['bounds'] for row in chosen])
    if seed is None:
        # Each individual has its own θ_eval: here a column is an individual.
        labels = [f'individual {s}' for s in rows]
        errors, tensions = (v.reshape(*v.shape[:2], -1) for v in (errors, tensions))
        errors, tensions = errors.swapaxes(0, 1), tensions.swapaxes(0, 1)
        bound = bounds.mean(axis=1)
    else:
        labels = [f'θ_eval {p + 1}' for p in range(errors.shape[2])]
        errors, tensions, bound = errors[0], tensions[0], bounds[0]
    figure, axes = new_figure(11.0, 6.4, 2, 1, sharex=True)
    place, width = np.arange(len(labels)), 0.8 / len(PROTOCOL)
    for m, name in enumerate(PROTOCOL):
        at = place + (m - 0.5 * (len(PROTOCOL) - 1)) * width
        for panel, values in ((axes[0, 0], errors[m]), (axes[1, 0], tensions[m])):
            mean = values.mean(axis=1)
            panel.bar(
                at,
                mean,
                0.92 * width,
                color=METHODS[name],
                yerr=values.std(axis=1),
                error_kw={'lw': 1, 'capsize': 2},
                label=f'{name}: {mean.mean():.3f} rad'
                if panel is axes[0, 0]
                else f'{name}: {mean.mean():.0f} N',
            )
    panel = axes[1, 0]
    for p, least in enumerate(bound):
        label = f'QP bound at θ_eval: {bound.mean():.0f} N' if p == 0 else None
        panel.plot([p - 0.45, p + 0.45], [least, least], color=TRUE, lw=1.5, ls='--', label=label)
    tidy(
        axes[0, 0],
        '',
        '‖θ_eval − θ‖ [rad]',
        'all individuals' if seed is None else f'individual {seed}',
    )
    tidy(panel, '', '‖T‖ [N]')
    panel.set_xticks(place, labels)
    for each in axes[:, 0]:
        each.legend(fontsize=9, loc='center left', bbox_to_anchor=(1.0, 0.5))
    what = 'every individual (all its θ_eval together)' if seed is None else 'every target posture'
    return save(
        figure,
        folder,
        'control_all' if seed is None else 'control',
        f'Distance from the target and muscle tension at rest for {what}; whiskers: standard '
        'deviation over starts' + (' and targets' if seed is None else '') + '. Dashed: the least '
        '‖T‖ with which the true body can hold the target. `first` and `second` rest elsewhere '
        'and so may need less.',
    )
