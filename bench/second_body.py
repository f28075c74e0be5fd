# SPDX-License-Identifier: Apache-2.0
"""Compares emulator model `foreign` with the paper's Musashi, to check the sizes of its effects.

    python -m bench second_body [--quick] [--seeds 200,…,209] [--off EFFECT,…]

The sizes in `emulator/effects.py` were set once, with the learner of commit 86c8dfc, on individuals
200–209 of musashi_left_arm. No table of the documents uses these individuals. The sizes are never
changed to improve a result. The targets, which leave out the error of the network itself, were:

- Least squares on the nominal geometry has an error of 0.32–0.41 rad on the held-out motion.
- l(θ_S-p) without tension has an error of up to 40 mm over the paper's −120…30°.
- Preset `paper` has an error of 0.15–0.19 rad after ten minutes of learning.
- Its simulator has a tension error of about 90 N.

The third target cannot be reached within plausible ranges of the effects, which are therefore at
their upper ends. The table shows the results. `after` is the error of the last network, which
the estimator need not accept:

    seed  least squares [rad]  l off [mm]  paper [rad]: before  after  simulator [N]
     200                0.396          29                0.620  0.135            100
     201                0.254          32                0.429  0.079            107
     205                0.483          31                0.534  0.105             88
    mean                0.378          31                0.528  0.106             98

For comparison, eight of these individuals with each effect at the middle of its range, and with
kinks in only half of the tendons:
    mean                0.372          33                0.680  0.111             83
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.effects import Effects
from musculoskeletal_ae.emulator.foreign import ForeignArm
from musculoskeletal_ae.emulator.tendons import spooled
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.body_change import SWEEP
from musculoskeletal_ae.experiments.least_squares import nominal
from musculoskeletal_ae.experiments.online_learning import teach
from musculoskeletal_ae.experiments.recording import (
    EXPLORATION_STREAM,
    HELD_OUT_STREAM,
    estimation_error,
    record,
)
from musculoskeletal_ae.experiments.roles import shoulder
from musculoskeletal_ae.experiments.simulation import simulate
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser, names
from musculoskeletal_ae.robot.robot import Robot

SEEDS = tuple(range(200, 210))
HEAD = 'seed  least squares [rad]  l off [mm]  paper [rad]: before  after  simulator [N]'
PAPER = 'Musashi      0.32–0.41        up to 40            0.41  0.15–0.19      92'


class Row(NamedTuple):
    """Results of one individual."""

    least_squares: float  # error of least squares on the nominal geometry [rad]
    off: float  # largest |l − f_geo| while the shoulder sweeps; l is the sensor's reading [mm]
    before: float  # error of preset `paper` before learning [rad]
    after: float  # error of the last network of preset `paper`, accepted or not [rad]
    simulated: float  # tension error of the simulator of preset `paper` after learning [N]


def measured(
    robot: Robot, default: Mae, paper: Mae, seed: int, effects: Effects, share: float
) -> Row:
    """Let the network of preset `paper` learn one individual, and return the results.

    Args:
        robot: The geometric model.
        default: Initial network of preset `default`, which commands the motion.
        paper: Initial network of preset `paper`.
        seed: Seed of the individual.
        effects: Effects of the emulator model.
        share: Factor of all durations.
    """

    def arm() -> ForeignArm:
        return ForeignArm(robot, seed, effects)

    exploring = record(arm(), default, EXPLORATION_STREAM + seed, 600.0 * share)
    held_out = record(arm(), default, HELD_OUT_STREAM, 300.0 * share)
    learner = Learner(robot, paper, 'paper', seed)
    teach(learner, zip(*exploring, strict=True))
    swept = np.zeros((len(SWEEP), robot.joint_count))
    swept[:, shoulder(robot)] = SWEEP
    off = true_lengths(arm(), swept) - robot.routes.relative_lengths(swept)
    learned = paper if learner.last_update is None else learner.last_update.mae
    apart = simulate(robot, learned, 'paper', held_out).tension - held_out.tension
    return Row(
        nominal(robot).error(held_out),
        1e3 * float(np.abs(off).max()),
        estimation_error(paper, held_out),
        estimation_error(learned, held_out),
        float(np.linalg.norm(apart, axis=1).mean()),
    )


def true_lengths(arm: ForeignArm, theta: Array) -> Array:
    """Return the readings of the length sensors without tension [m] (N, M), at θ [rad] (N, D)."""
    body = arm.individual
    lengths = body.absolute_lengths(theta) - body.length_at_zero
    return np.array(
        [[spooled(arm.tendons, m, each) for m, each in enumerate(row)] for row in lengths]
    )


def main(argv: list[str]) -> None:
    """Train both presets, measure every individual and print the table."""
    parser = Parser('second_body', 'Compares emulator model foreign with the Musashi of the paper.')
    parser.add_robot()
    parser.add_seeds(SEEDS)
    parser.add_quick('a tenth of the time')
    parser.add_argument(
        '--off',
        type=names,
        default=[],
        metavar='EFFECT,…',
        help='effects of the emulator model to switch off',
    )
    args = parser.parse_args(argv)

    robot = Robot.load(args.robot)
    try:
        effects = replace(Effects(), **dict.fromkeys(args.off, 0.0))
    except TypeError as error:
        raise MusculoskeletalError(f'--off: {error}') from error
    default, paper = (initial_mae(robot, preset).mae for preset in ('default', 'paper'))
    print(HEAD)
    rows = []
    for seed in tqdm(args.seeds, unit='individual', disable=None):
        rows.append(measured(robot, default, paper, seed, effects, 0.1 if args.quick else 1.0))
        print(line(str(seed), rows[-1]), flush=True)
    print(line('mean', Row(*np.mean(rows, axis=0))), PAPER, sep='\n')


def line(name: str, row: Row) -> str:
    """Return a line of the table."""
    text = f'{name:>4}{row.least_squares:21.3f}{row.off:12.0f}'
    return text + f'{row.before:21.3f}{row.after:7.3f}{row.simulated:15.0f}'
