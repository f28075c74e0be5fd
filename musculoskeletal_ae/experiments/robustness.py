# SPDX-License-Identifier: Apache-2.0
"""Robustness.

Paper. The body that was learned is a real one; what is wrong with it is not known.

Here. Both bodies, each explored by the default network and by preset paper as in online learning:
`kin`, which differs from its model in what the learner fits, and `foreign`, whose mechanics are
foreign too. Oracle: least squares on one message with the true routes and elastic constants. The
informed oracle also knows the errors of the tension and length sensors, and the friction of each
tendon; neither knows what a message does not hold: which way a tendon slid, loops, creep, drift.
What is learned comes from the joint sensors, so that their error is shown, too. The ablation leaves
out some effects of the foreign body and keeps the rest of the individual as it is; "links" adds
one, of link lengths, axes and masses, which the paper takes as exact.
"""

import json
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
from musculoskeletal_ae.experiments.study import Experiment, Measured, Plot, Rows, Study, first
from musculoskeletal_ae.presets import PRESETS

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


def measure(study: Study, seed: int) -> Measured:
    """Measure an individual of each body; the ablation is of the first one."""
    parts = {reality: _learned(study, seed, reality) for reality in REALITIES}
    numbers: dict[str, Any] = {at: _numbers(part, seed) for at, part in parts.items()}
    if not study.quick:
        numbers['links_rad'] = _otherwise(parts[FOREIGN], seed, links=1.0)
    if seed == study.seeds[0]:
        numbers['ablation_rad'] = {
            name: _otherwise(parts[FOREIGN], seed, **dict.fromkeys(effects, 0.0))
            for name, effects in ABLATED.items()
            if name in QUICK or not study.quick
        }
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
    learned = 'before_rad', 'after_rad', 'paper_before_rad', 'paper_after_rad'
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


def _otherwise(study: Study, seed: int, **effects: float) -> float:
    """Return what learning is left with where an individual has other effects [rad]."""
    from musculoskeletal_ae.emulator.effects import Effects
    from musculoskeletal_ae.emulator.foreign import ForeignArm

    def arm() -> Arm:
        return ForeignArm(study.robot, seed, replace(Effects(), **effects))

    held_out = record(arm(), study.network(None, 'default'), HELD_OUT_STREAM, study.held_out_time)
    learner, loop = online_learning.beginner(study, arm(), seed, study.preset)
    stream = online_learning.explore(loop, learner, 60.0 * study.minutes)
    online_learning.teach(learner, stream)
    return estimation_error(learner.mae, held_out)


ESTIMATES = {
    'least_squares_rad': 'least squares, geometric model',
    'before_rad': 'before learning',
    'paper_after_rad': 'preset paper',
    'after_rad': 'learned',
    'oracle_rad': 'oracle',
    'informed_oracle_rad': 'informed oracle',
    'joint_sensors_rad': 'joint sensors',
}


def robustness(_: Study, rows: Rows) -> Plot:
    """Draw the errors of all estimators on both bodies."""
    figure, (panel,) = plots.new_figure(9.0, 5.6)
    groups = {}
    for reality, colour in zip(REALITIES, plots.WHEN.values(), strict=True):
        said = [[row.numbers[reality][key] for key in ESTIMATES] for row in rows.values()]
        groups[f'reality: {reality}'] = colour, np.array(said, dtype=float)  # None: NaN
    plots.bars(panel, [*ESTIMATES.values()], groups, 'mean error [rad], held-out motion', '')
    return figure, (
        'Errors on the motion never used for learning, means over individuals; dots: each.'
    )


def ablation(_: Study, rows: Rows) -> Plot:
    """Draw what learning is left with where the foreign body lacks some effects."""
    seed, (numbers, _traces) = first(rows)
    figure, (panel,) = plots.new_figure(9.0, 4.6)
    without = numbers.get('ablation_rad', {})
    names = sorted(without, key=without.__getitem__, reverse=True)
    groups = {'without': (plots.AFTER, [[without[name] for name in names]])}
    whole = numbers[FOREIGN]['after_rad']
    panel.axvline(whole, color=plots.MARK, ls=':')
    title = f'without (dotted: with all effects, {whole:.3f} rad)'
    plots.bars(panel, names, groups, 'mean error after learning [rad]', title)
    return figure, (
        f'The foreign body with some effects left out, individual {seed}: the shorter the bar, the '
        'more those effects matter.'
    )


EXPERIMENT = Experiment(__doc__, measure, (robustness, ablation), 40.0)
