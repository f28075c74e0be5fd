# SPDX-License-Identifier: Apache-2.0
"""Robustness.

Paper (§IV-A). The body that was learned is a real one; what is wrong with it is not known.

Here. Both bodies, each explored by the default network and by the preset as printed, as in online
learning: `kin`, which differs from its model in what the learner fits, and `foreign`, whose
mechanics are foreign too. Oracle: least squares on one message with the true routes and elastic
constants. The informed oracle also knows the errors of the tension and length sensors, and the
friction of each tendon; neither knows what a message does not hold: which way a tendon slid, loops,
creep, drift. What is learned comes from the joint sensors, so that their error is shown, too. The
ablation leaves out some effects of the foreign body and keeps the rest of the individual as it is;
"links" adds one, of link lengths, axes and masses, which are taken as exact in print.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from shutil import copyfile
from typing import Any

import numpy as np

from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.emulator.reality import FOREIGN, KIN
from musculoskeletal_ae.emulator.wires import GUIDES, load_cell, spooled
from musculoskeletal_ae.experiments import online_learning, plots
from musculoskeletal_ae.experiments.least_squares import EVERY, nominal, oracle
from musculoskeletal_ae.experiments.recording import (
    HELD_OUT_STREAM,
    Recording,
    estimation_error,
    mean_error,
    record,
)
from musculoskeletal_ae.experiments.study import Experiment, Measured, Plot, Rows, Study
from musculoskeletal_ae.presets.registry import AS_PRINTED, PRESETS

REALITIES = KIN, FOREIGN
#: what the ablation leaves out
ABLATED = {
    'route points': ('attachment',),
    'kinks, slip-over': ('kinks', 'slip_over'),
    'give': ('give',),
    'friction': ('guide_friction', 'stiction', 'joint_friction'),
    'spring laws': ('stiffness', 'laws'),
    'hysteresis': ('hysteresis',),
    'creep, late stretch': ('creep', 'recovery', 'bedding', 'knot'),
    'tension sensors': ('tension_gain', 'tension_zero', 'tension_bend', 'tension_drift'),
    'spools': ('spool_gain', 'spool_layer', 'eccentricity', 'spool_slip', 'length_drift'),
    'joint sensors': ('joint_zero', 'joint_bend', 'backlash'),
    'delays': ('delay', 'jitter', 'dropouts'),
}
QUICK = ('friction',)
ABLATION_INDIVIDUALS = 3
REPEATED = 'nothing: another run'  # what runs differ by, with other postures explored
OTHER_RUN = 1000  # added to the seed of exploration and training


def measure(study: Study, seed: int) -> Measured:
    """Measure an individual of each emulator model; the ablation is of the first few."""
    parts = {reality: _learned(study, seed, reality) for reality in REALITIES}
    numbers: dict[str, Any] = {at: _numbers(part, seed) for at, part in parts.items()}
    if not study.quick:
        numbers['links_rad'] = _otherwise(parts[FOREIGN], seed, {'links': 1.0})
    if seed in study.seeds[:ABLATION_INDIVIDUALS]:
        numbers['ablation_rad'] = {
            name: _otherwise(parts[FOREIGN], seed, dict.fromkeys(effects, 0.0))
            for name, effects in ABLATED.items()
            if name in QUICK or not study.quick
        }
        if not study.quick:
            again = _otherwise(parts[FOREIGN], seed, {}, run=seed + OTHER_RUN)
            numbers['ablation_rad'][REPEATED] = again
    return Measured(numbers, {})


def _learned(study: Study, seed: int, reality: str) -> Study:
    """Return where an individual of a reality was learned, after learning it if need be."""
    if reality == study.reality:
        return study
    part = replace(study, reality=reality, folder=study.folder / reality)
    part.folder.mkdir(exist_ok=True)
    for preset in PRESETS:
        # Other individuals do so meanwhile, and read it: it is whole at any moment.
        own = part.folder / f'{preset}_initial_of_{seed}'
        copyfile(study.network_file(preset, None), own)
        own.replace(part.network_file(preset, None))
    online_learning.measure(part, seed)
    return part


def _numbers(study: Study, seed: int) -> dict[str, Any]:
    held_out = study.stream(seed, 'held_out')
    kept = json.loads(study.numbers_file(seed).read_text(encoding='utf-8'))
    learned = (
        'before_rad',
        'after_rad',
        *(f'{AS_PRINTED}_{key}' for key in ('before_rad', 'after_rad')),
    )
    return {name: kept[name] for name in (*learned, 'oracle_rad', 'samples_to_halve')} | {
        'joint_sensors_rad': mean_error(held_out.theta_sensor, held_out.theta),
        'least_squares_rad': nominal(study.robot).error(held_out),
        'informed_oracle_rad': _informed(study.arm(seed), held_out),
    }


def _informed(arm: Any, recording: Recording) -> float:
    """Return the error of least squares that knows an arm's sensors and friction [rad]."""
    body, part = arm.individual, recording.part(EVERY)
    if (wires := getattr(arm, 'wires', None)) is None:
        pull = np.maximum(part.tension - body.tension_bias, 0.0) / body.tension_gain
        length, friction = part.length - body.length_bias, body.cable_friction
    else:
        # Sensors the other way round, by table.
        every = range(arm.robot.muscle_count)
        t, x = np.linspace(0.0, 2.0 * arm.robot.tension.max.max(), 2000), np.linspace(-1, 1, 20001)
        pull, length = np.empty_like(part.tension), np.empty_like(part.length)
        for m in every:
            cells = [load_cell(wires, m, each, 25.0) for each in t]
            pull[:, m] = np.interp(part.tension[:, m], cells, t)
            length[:, m] = np.interp(part.length[:, m], [spooled(wires, m, each) for each in x], x)
        friction = wires.friction * (GUIDES + arm._memory.bend)
    estimator = replace(oracle(arm.robot, body), friction=friction)
    return estimator.error(part._replace(tension=pull, length=length), np.s_[:])


def _otherwise(
    study: Study, seed: int, effects: Mapping[str, float], run: int | None = None
) -> float:
    """Return the error after learning where an individual has other effects [rad].

    `run` is the seed of exploration and training; default: that of the individual.
    """
    from musculoskeletal_ae.emulator.effects import Effects
    from musculoskeletal_ae.emulator.foreign import ForeignArm

    def arm() -> Arm:
        return ForeignArm(study.robot, seed, replace(Effects(), **effects))

    held_out = record(arm(), study.network(None, 'default'), HELD_OUT_STREAM, study.held_out_time)
    explorer = seed if run is None else run
    learner, loop = online_learning.beginner(study, arm(), explorer, study.preset)
    stream = online_learning.explore(loop, learner, 60.0 * study.minutes)
    online_learning.teach(learner, stream)
    return estimation_error(learner.mae, held_out)


#: key, label and colour of what the charts compare
ESTIMATES = {
    'before_rad': ('before learning', plots.BEFORE),
    'least_squares_rad': ('least squares, geometric model', plots.MARK),
    f'{AS_PRINTED}_after_rad': (f'preset {AS_PRINTED}, learned', plots.AS_PRINTED),
    'after_rad': ('preset default, learned', plots.AFTER),
    'joint_sensors_rad': ('joint sensors that it learns from', plots.MARK),
}


def _estimates(rows: Rows, reality: str) -> Plot:
    """Draw the errors of all estimators on one emulator model."""
    figure, (panel,) = plots.new_figure(8.0, 3.2)
    values = {
        label: [row.numbers[reality][key] for row in rows.values()]
        for key, (label, _) in ESTIMATES.items()
    }
    colours = [colour for _, colour in ESTIMATES.values()]
    title = f'Joint-angle error on emulator model {reality}'
    plots.ranked_bars(panel, values, colours, 'mean error on held-out motion [rad]', title)
    return figure, (
        f'Emulator model {reality}: mean joint-angle error on held-out motion; a dot is one of the '
        f'individuals {", ".join(map(str, rows))}.'
    )


def kin(_: Study | None, rows: Rows) -> Plot:
    """Draw the errors of all estimators on the emulator model `kin`."""
    return _estimates(rows, KIN)


def foreign(_: Study | None, rows: Rows) -> Plot:
    """Draw the errors of all estimators on the emulator model `foreign`."""
    return _estimates(rows, FOREIGN)


def ablation(_: Study | None, rows: Rows) -> Plot:
    """Draw how the error changes if some effects of emulator model `foreign` are left out."""
    known = {seed: row.numbers for seed, row in rows.items() if row.numbers.get('ablation_rad')}
    every = {seed: numbers['ablation_rad'] for seed, numbers in known.items()}
    changes = {
        name: [1e3 * (every[seed][name] - known[seed][FOREIGN]['after_rad']) for seed in every]
        for name in next(iter(every.values()), {})
    }
    repeated = changes.pop(REPEATED, None)
    changes = dict(sorted(changes.items(), key=lambda item: float(np.mean(item[1]))))
    figure, (panel,) = plots.new_figure(8.0, 4.6)
    colours = [plots.AFTER] * len(changes)
    title = 'Change of the learned error if one group of effects is left out'
    xlabel = 'change of the mean error on held-out motion [mrad]; negative: the effect matters'
    plots.ranked_bars(panel, changes, colours, xlabel, title, digits=1)
    panel.axvline(0.0, color=plots.TRUE, lw=1.0)
    whole = float(np.mean([numbers[FOREIGN]['after_rad'] for numbers in known.values()]))
    spread = ''
    if repeated:
        largest = float(np.max(np.abs(repeated)))
        panel.axvspan(-largest, largest, color=plots.MARK, alpha=0.15, lw=0.0)
        spread = f' Grey: the largest change of a repeated run, {largest:.1f} mrad.'
    return figure, (
        'Emulator model foreign with one group of effects left out: change of the error after '
        f'learning. With all effects it is {1e3 * whole:.0f} mrad (individuals '
        f'{", ".join(map(str, known))}).{spread}'
    )


EXPERIMENT = Experiment(__doc__, measure, (kin, foreign, ablation), 70.0)
