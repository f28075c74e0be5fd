# SPDX-License-Identifier: Apache-2.0
"""Robustness.

Paper. The body that was learned is a real one; what is wrong with it is not known.

Here. Both bodies, each explored by the default network and by preset paper as in online learning:
`kin`, which differs from its model in what the learner fits, and `foreign`, whose mechanics are
foreign too. "Frozen" is the learner before it was changed for the foreign body, taught by the same
messages. Oracle: least squares on one message with the true routes and elastic constants. The
informed oracle also knows the errors of the tension and length sensors, and how much each wire
rubs; neither knows what a message does not tell: which way a wire slid, loops, creep, drift. What
is learned comes from the joint sensors, whose own error is there, too. The
ablation leaves out some effects of the foreign body, the rest of the individual staying as it is;
"links" adds one, of link lengths, axes and masses, which the paper takes as exact.
"""

import io
import json
import os
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.emulator.reality import FOREIGN, KIN
from musculoskeletal_ae.emulator.wires import GUIDES, load_cell, spooled
from musculoskeletal_ae.exceptions import printable
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
FROZEN = '86c8dfc'  # the commit
#: reads the recordings below folders; prints what its learner is left with after each
FROZEN_RUN = """
import sys
import numpy as np
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.robot.robot import Robot
directory, seed, *folders = sys.argv[1:]
robot = Robot.load(directory)
initial = initial_mae(robot, 'default').mae
for folder in folders:
    learner = Learner(robot, initial, 'default', int(seed))
    kept = np.load(f'{folder}/exploring_{seed}.npz')
    for n, (theta, length, tension) in enumerate(zip(*(kept[f'arr_{i}'] for i in (1, 2, 3)))):
        learner.step(0.01 * n, theta, tension, length)
    truth, _, length, tension, _ = np.load(f'{folder}/held_out_{seed}.npz').values()
    off = learner.mae.estimate(tension, length).theta - truth
    print('frozen', np.linalg.norm(off, axis=1).mean())
"""
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
    frozen, why = _frozen(study, seed, [part.folder for part in parts.values()])
    for reality, error in zip(REALITIES, frozen, strict=True):
        numbers[reality]['frozen_after_rad'] = error
    if not study.quick:
        numbers['links_rad'] = _otherwise(parts[FOREIGN], seed, links=1.0)
    numbers |= {'frozen': why} if why else {}
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


def _frozen(study: Study, seed: int, folders: list[Path]) -> tuple[list[float | None], str]:
    """Return what the frozen learner is left with, or why that is not known."""
    nothing: list[float | None] = [None] * len(folders)
    if study.quick:
        return nothing, 'the frozen learner is left out of a quick run'
    here = Path(__file__).parent
    try:
        git = ['git', '-C']
        root = _output([*git, here, 'rev-parse', '--show-toplevel']).decode().strip()
        archive = _output([*git, root, 'archive', '--format=zip', FROZEN, 'musculoskeletal_ae'])
    except (OSError, subprocess.CalledProcessError) as error:
        return nothing, f'no frozen learner: commit {FROZEN} is not at hand ({error})'
    with TemporaryDirectory() as folder, zipfile.ZipFile(io.BytesIO(archive)) as files:
        files.extractall(folder)
        arguments = study.robot.description.directory.resolve(), str(seed), *folders
        try:
            said = _output([sys.executable, '-c', FROZEN_RUN, *arguments], cwd=folder)
        except subprocess.CalledProcessError as error:  # as of a robot that it cannot read yet
            last = error.stderr.decode(errors='replace').strip().rpartition('\n')[2]
            why = printable(last) or f'status {error.returncode}'
            return nothing, f'no frozen learner: that of commit {FROZEN} ended with {why}'
    return [float(line.split()[1]) for line in said.splitlines() if line.startswith(b'frozen')], ''


def _output(command: list[Any], cwd: str | None = None) -> bytes:
    environment = {**os.environ, 'PYTHONPATH': cwd} if cwd else None
    options: dict[str, Any] = {'capture_output': True, 'cwd': cwd, 'env': environment}
    return bytes(subprocess.run(command, check=True, **options).stdout)  # noqa: S603


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
    'frozen_after_rad': 'frozen learner',
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
