# SPDX-License-Identifier: Apache-2.0
"""What learning changes in the body.

l(θ) at T = 0 over −120…30° of the shoulder, and l(T) over 0…T_max at θ = 0, through ① of the
network before and after learning, beside the true body. All other joints are at θ = 0; where that
lies outside a joint’s limits (the elbow’s, by 5°) it is kept all the same. "Shape" is the error of
a curve beside the true one after their mean difference is taken off.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.roles import shoulder
from musculoskeletal_ae.experiments.study import Experiment, Individuals, Measured, Progress, Study
from musculoskeletal_ae.robot.robot import Robot

SWEEP = np.radians(np.linspace(-120.0, 30.0, 151))  # [rad]
POINTS = 101  # of tension
COLUMNS = 5  # of plots


def measure(study: Study, seed: int, progress: Progress) -> Measured:
    """Return the numbers and traces of one individual."""
    robot = study.body()
    individual = Individual(robot, seed)
    joint = shoulder(robot)
    networks = {'before': study.initial(robot), 'after': study.learned(robot, seed)}
    tension = np.linspace(0.0, robot.tension.max, POINTS)
    swept = np.zeros((len(SWEEP), robot.joint_count))
    swept[:, joint] = SWEEP
    stretched = np.repeat(tension[:, None], robot.muscle_count, axis=1)
    sweeps = {
        'angle': (swept, np.zeros((len(SWEEP), robot.muscle_count))),
        'tension': (np.zeros((POINTS, robot.joint_count)), stretched),
    }
    traces: dict[str, Any] = {
        'angle': SWEEP,
        'tension': tension,
        'angle_trained': (robot.lower[joint] <= SWEEP) & (robot.upper[joint] >= SWEEP),
        'tension_trained': _explored(study.rests(seed).tension, robot, tension),
    }
    numbers: dict[str, Any] = {'joint': robot.joints[joint]}
    for name, points in sweeps.items():
        trained, true = traces[f'{name}_trained'], individual.muscle_lengths(*points)
        curves = {when: mae.lengths(*points) for when, mae in networks.items()}
        traces[f'by_{name}'] = {**curves, 'true': true}
        change = 1e3 * np.abs(curves['after'] - curves['before'])[trained].max(axis=0)
        numbers[f'{name}_change_mm'] = dict(zip(robot.muscles, change.tolist(), strict=True))
        for when, length in curves.items():
            # Beside the zero that each curve has its own: only their shapes are compared.
            off = (length - true)[trained]
            shape = 1e3 * (off - off.mean(axis=0)).std(axis=0)
            numbers[f'{name}_{when}_shape_mm'] = float(shape.mean())
    progress(1.0)
    return Measured(numbers, traces)


def _explored(seen: Array, robot: Robot, tension: Array) -> Bools:
    """Return which tensions the learner's samples (N, M) reached in any muscle."""
    low, high = (seen.min(), seen.max()) if seen.size else (0.0, robot.tension.limit)
    explored: Bools = (tension >= low) & (tension <= high)
    return explored


def plot(individuals: Individuals) -> list[plots.Plot]:
    """Draw l over the shoulder's angle and over tension, one panel for each muscle."""
    (seed, first), robot = individuals.first, individuals.robot
    trace, joint = first.traces, first.numbers['joint']
    degrees, label = np.degrees(trace['angle']), f'θ of {joint} [deg]'
    angle = _grid(robot, degrees, trace['by_angle'], trace['angle_trained'], label)
    angle.suptitle(f'individual {seed}: muscle length at T = 0, all other joints at 0')
    tension = _grid(robot, trace['tension'], trace['by_tension'], trace['tension_trained'], 'T [N]')
    tension.suptitle(f'individual {seed}: muscle length at θ = 0')
    return [
        plots.Plot(
            'length_against_angle',
            angle,
            f'Muscle length against {joint} at no tension. Dotted: outside the joint’s limits, '
            'where nothing was trained.',
        ),
        plots.Plot(
            'length_against_tension',
            tension,
            'Muscle length against tension at θ = 0. Dotted: tensions that no sample of the '
            'exploration held.',
        ),
    ]


def _grid(robot: Robot, x: Array, lines: Mapping[str, Array], trained: Bools, xlabel: str) -> Any:
    columns = min(COLUMNS, robot.muscle_count)
    rows = -(-robot.muscle_count // columns)
    figure, axes = plots.new_figure(
        2.6 * columns + 0.6, 2.4 * rows + 0.9, rows, columns, sharex=True
    )
    labels = {'before': 'before learning', 'after': 'after learning', 'true': 'true body'}
    for m, panel in enumerate(axes.flat):
        if m >= robot.muscle_count:
            panel.set_axis_off()
            continue
        for name, label in labels.items():
            y, width = 1e3 * lines[name][:, m], 1.0 if name == 'true' else 1.8
            style = {'color': plots.WHEN.get(name, plots.TRUE), 'lw': width}
            panel.plot(x, y, ls=':', **style)
            panel.plot(x, np.where(trained, y, np.nan), label=label if m == 0 else None, **style)
        plots.tidy(panel, '', '', f'{m + 1} {robot.muscles[m]}')
        panel.title.set_fontsize(9)
        if m % columns == 0:
            panel.set_ylabel('l [mm]')
        if m + columns >= robot.muscle_count:
            panel.set_xlabel(xlabel)
            panel.tick_params(labelbottom=True)
    figure.legend(loc='outside lower center', ncols=3, fontsize=9)
    return figure


EXPERIMENT = Experiment(
    description=__doc__,
    paper=(
        'l against S-p from −120° to 30° at T = 0, and against T from 0 to 500 N at θ = 0: changes '
        'up to 40 mm, largest in #2, #3 and #7; tension curves from linear to strongly curved.'
    ),
    weight=0.2,
    measure=measure,
    plot=plot,
)
