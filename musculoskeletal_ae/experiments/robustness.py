# SPDX-License-Identifier: Apache-2.0
"""Robustness.

Paper (§IV-A). The learned body is a physical robot, whose deviations from the geometric model are
unknown.

Here. The default network and that of preset `paper` explore individuals of both emulator models, as
in online learning. The body of `kin` differs from its geometric model only in ways that the learner
can fit; `foreign` also has mechanics that the learner does not model. The results include the error
of the joint sensors, because the networks learn from them. The ablation removes one group of
effects of `foreign` at a time, and leaves the rest of the individual unchanged.

- oracle: least squares on one message with the true routes and elastic constants
- informed oracle: an oracle that also knows the true errors of the tension and length sensors, and
  the true friction of each tendon. Neither oracle knows what one message does not show: the sliding
  direction of a tendon, hysteresis, creep and drift.
- links: error with an additional effect, wrong link lengths, axes and masses. The paper assumes
  that these are exact.
"""

from collections.abc import Mapping
from dataclasses import replace
from shutil import copyfile
from typing import Any

import numpy as np

from musculoskeletal_ae.emulator.foreign.tendons import load_cell, spooled
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.emulator.reality import FOREIGN, KIN
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
from musculoskeletal_ae.presets.preset import PAPER_PRESET
from musculoskeletal_ae.presets.registry import PRESETS

REALITIES = KIN, FOREIGN
#: groups of effects; the ablation removes each group in turn
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
#: keys of ABLATED whose effects a shortened run removes; a full run does this for every key in turn
QUICK = ('friction',)
ABLATION_INDIVIDUALS = 2  # measure the ablation for this many individuals
#: label of a run with all effects and another exploration, which shows the difference between runs
REPEATED = 'nothing: another run'
OTHER_RUN = 1000  # add this to the seed of exploration and training of the repeated run


def measure(study: Study, seed: int) -> Measured:
    """Measure the errors of one individual of each emulator model.

    The ablation of `foreign` is measured for the first ABLATION_INDIVIDUALS seeds only.
    """
    parts = {reality: _study_of_model(study, seed, reality) for reality in REALITIES}
    numbers: dict[str, Any] = {at: _numbers(part, seed) for at, part in parts.items()}
    if not study.quick:
        numbers['links_rad'] = _error_with_effects(parts[FOREIGN], seed, {'links': 1.0})
    if seed in study.seeds[:ABLATION_INDIVIDUALS]:
        numbers['ablation_rad'] = {
            name: _error_with_effects(parts[FOREIGN], seed, dict.fromkeys(effects, 0.0))
            for name, effects in ABLATED.items()
            if name in QUICK or not study.quick
        }
        if not study.quick:
            repeated = _error_with_effects(parts[FOREIGN], seed, {}, run=seed + OTHER_RUN)
            numbers['ablation_rad'][REPEATED] = repeated
    return Measured(numbers, {})


def _study_of_model(study: Study, seed: int, reality: str) -> Study:
    """Return a study whose individuals have the emulator model `reality`."""
    if reality == study.reality:
        return study
    minutes = study.seconds(60.0 * study.minutes) / 60.0
    part = replace(study, reality=reality, folder=study.folder / reality, minutes=minutes)
    part.folder.mkdir(exist_ok=True)
    for preset in PRESETS:
        # Processes of other individuals write and read this file at the same time, so it has to be
        # replaced atomically.
        temporary = part.folder / f'{preset}_initial_of_{seed}'
        copyfile(study.network_file(preset, None), temporary)
        temporary.replace(part.network_file(preset, None))
    return part


def _numbers(study: Study, seed: int) -> dict[str, Any]:
    online = study.remember(
        f'online_learning_{seed}', lambda: online_learning.measure(study, seed)
    ).numbers
    held_out = study.stream(seed, 'held_out')
    keys = (
        'before_rad',
        'after_rad',
        *(f'{PAPER_PRESET}_{key}' for key in ('before_rad', 'after_rad')),
        'oracle_rad',
        'samples_to_halve',
    )
    return {key: online[key] for key in keys} | {
        'joint_sensors_rad': mean_error(held_out.theta_sensor, held_out.theta),
        'least_squares_rad': nominal(study.robot).error(held_out),
        'informed_oracle_rad': _informed_oracle_error(study.arm(seed), held_out),
    }


def _informed_oracle_error(arm: Any, recording: Recording) -> float:
    """Return the error [rad] of the oracle that also knows the true sensor errors and friction."""
    body, part = arm.individual, recording.part(EVERY)
    if (tendons := getattr(arm, 'tendons', None)) is None:
        tension = np.maximum(part.tension - body.tension_bias, 0.0) / body.tension_gain
        length = part.length - body.length_bias
    else:
        # Find true tensions and lengths from the sensors' readings by tables.
        tensions = np.linspace(0.0, 2.0 * arm.robot.tension.max.max(), 2000)
        lengths = np.linspace(-1, 1, 20001)
        tension, length = np.empty_like(part.tension), np.empty_like(part.length)
        for m in range(arm.robot.muscle_count):
            tension_readings = [load_cell(tendons, m, each, 25.0) for each in tensions]
            length_readings = [spooled(tendons, m, each) for each in lengths]
            tension[:, m] = np.interp(part.tension[:, m], tension_readings, tensions)
            length[:, m] = np.interp(part.length[:, m], length_readings, lengths)
    estimator = replace(oracle(arm.robot, body), friction=arm.tendon_friction)
    return estimator.error(part._replace(tension=tension, length=length), np.s_[:])


def _error_with_effects(
    study: Study, seed: int, effects: Mapping[str, float], run: int | None = None
) -> float:
    """Change effects of an individual of `foreign`, and return its error [rad] after learning.

    Args:
        study: The study of the emulator model `foreign`.
        seed: Seed of the individual.
        effects: Sizes of the changed effects by name; 0 removes an effect.
        run: Seed of exploration and training, by default the seed of the individual.
    """
    from musculoskeletal_ae.emulator.foreign.arm import ForeignArm
    from musculoskeletal_ae.emulator.foreign.effects import Effects

    def arm() -> Arm:
        return ForeignArm(study.robot, seed, replace(Effects(), **effects))

    held_out = record(arm(), study.network(None, 'default'), HELD_OUT_STREAM, study.held_out_time)
    explorer = seed if run is None else run
    learner, loop = online_learning.new_learner_and_loop(study, arm(), explorer, study.preset)
    duration = study.seconds(60.0 * study.minutes)
    stream = online_learning.explore(loop, learner, duration)
    online_learning.teach(learner, stream)
    return estimation_error(learner.mae, held_out)


#: label and colour of each error that the charts compare, by its key
ESTIMATES = {
    'before_rad': ('before learning', plots.BEFORE),
    'least_squares_rad': ('least squares, geometric model', plots.MARK),
    f'{PAPER_PRESET}_after_rad': (f'preset {PAPER_PRESET}, learned', plots.AS_PRINTED),
    'after_rad': ('preset default, learned', plots.AFTER),
    'joint_sensors_rad': ('joint sensors used for learning', plots.MARK),
}


def _estimates(rows: Rows, reality: str) -> Plot:
    """Draw the errors of all estimators on the emulator model `reality`, by individual."""
    figure, (panel,) = plots.new_figure(8.0, 3.2)
    values = {
        label: [row.numbers[reality][key] for row in rows.values()]
        for key, (label, _) in ESTIMATES.items()
    }
    colours = [colour for _, colour in ESTIMATES.values()]
    title = f'Joint-angle error on emulator model {reality}'
    plots.ranked_bars(panel, values, colours, 'mean error on held-out motion [rad]', title)
    return figure, (
        f'Mean joint-angle error on held-out motion, emulator model {reality}. Each dot is one of '
        f'the individuals {", ".join(map(str, rows))}.'
    )


def kin(_: Study | None, rows: Rows) -> Plot:
    """Draw the errors of all estimators on the emulator model `kin`."""
    return _estimates(rows, KIN)


def foreign(_: Study | None, rows: Rows) -> Plot:
    """Draw the errors of all estimators on the emulator model `foreign`."""
    return _estimates(rows, FOREIGN)


def ablation(_: Study | None, rows: Rows) -> Plot:
    """Draw how the error changes if one group of effects of `foreign` is removed."""
    known = {seed: row.numbers for seed, row in rows.items() if row.numbers.get('ablation_rad')}
    ablated = {seed: numbers['ablation_rad'] for seed, numbers in known.items()}
    changes = {
        name: [1e3 * (ablated[seed][name] - known[seed][FOREIGN]['after_rad']) for seed in ablated]
        for name in next(iter(ablated.values()), {})
    }
    repeated = changes.pop(REPEATED, None)
    changes = dict(sorted(changes.items(), key=lambda item: float(np.mean(item[1]))))
    figure, (panel,) = plots.new_figure(8.0, 4.6)
    colours = [plots.AFTER] * len(changes)
    title = 'Change of the learned error if one group of effects is removed'
    xlabel = 'mean error without the effects minus that with them [mrad]'
    plots.ranked_bars(panel, changes, colours, xlabel, title, digits=1)
    panel.axvline(0.0, color=plots.TRUE, lw=1.0)
    whole = float(np.mean([numbers[FOREIGN]['after_rad'] for numbers in known.values()]))
    spread = ''
    if repeated:
        largest = float(np.max(np.abs(repeated)))
        panel.axvspan(-largest, largest, color=plots.MARK, alpha=0.15, lw=0.0)
        spread = f' Grey: the largest change when a run is repeated, {largest:.1f} mrad.'
    return figure, (
        'Change of the error after learning if one group of effects is removed from emulator model '
        f'foreign. The error with all effects is {1e3 * whole:.0f} mrad (individuals '
        f'{", ".join(map(str, known))}).{spread}'
    )


EXPERIMENT = Experiment(__doc__, measure, (kin, foreign, ablation), 70.0)
