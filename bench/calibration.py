# SPDX-License-Identifier: Apache-2.0
"""Measures how far emulated arms deviate from their model, to check the constants of `Spread`.

    python -m bench calibration [--robot NAME|DIR] [--seeds 0,1,…] [--minutes 5]

The constants of `emulator.kin.individual.Spread` were set once, with seeds 0–9 of musashi_left_arm,
and are never changed to improve a result. They meet two targets on the held-out motion (5 minutes
at 100 Hz; mean of ‖θ_est − θ_true‖ over samples and individuals):

- Before learning, preset `paper` has an error of 0.32–0.42 rad, as in the paper.
- The oracle, least squares on the true body, has an error of 0.04–0.06 rad in motion.

Joint friction is a share of each joint's own load. Its sum over the joints of this arm is 0.586 N·m
(2 % of 5.86 N·m at five joints). Attachment errors of 8.5 mm in each coordinate give length errors
of about 5 mm. The bench prints this table, with errors in rad: least squares on the geometric
model, without a network, and both presets before any learning.

    seed  lengths off [mm]  oracle [rad]  least squares  default  paper
       0               4.4         0.045          0.183    0.293  0.409
       1               4.6         0.048          0.206    0.210  0.323
       2               3.5         0.041          0.230    0.253  0.300
       3               5.3         0.044          0.153    0.170  0.411
       4               5.2         0.043          0.481    0.491  0.658
       5               5.4         0.037          0.226    0.177  0.344
       6               3.9         0.031          0.168    0.139  0.352
       7               4.8         0.051          0.278    0.237  0.335
       8               3.4         0.040          0.225    0.228  0.473
       9               5.0         0.055          0.299    0.263  0.416
    mean               4.5         0.043          0.245    0.246  0.402
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.emulator.kin.individual import Individual
from musculoskeletal_ae.experiments.least_squares import nominal, oracle
from musculoskeletal_ae.experiments.recording import estimation_error, record
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

HELD_OUT_SEED = 9001  # record the held-out motion with this seed, from which no experiment learns
EVERY = 10  # evaluate the length error only at every tenth message, to save time


class Row(NamedTuple):
    """Estimation errors [rad] and length error [mm] of one individual."""

    seed: int
    mismatch_mm: float
    oracle: float
    nominal: float
    default: float
    paper: float


def calibration(
    robot: Robot, default: Mae, paper: Mae, seeds: Iterable[int], minutes: float = 5.0
) -> list[Row]:
    """Return the errors of individuals on the held-out motion, before any learning.

    Args:
        robot: The geometric model.
        default: Initial network of preset `default`, which also commands the motion.
        paper: Initial network of preset `paper`.
        seeds: Seeds of the individuals.
        minutes: Duration of the motion [min].
    """
    rows = []
    for seed in seeds:
        individual = Individual(robot, seed)
        arm = EmulatedArm(robot, seed, individual)
        taken = record(arm, default, HELD_OUT_SEED, 60.0 * minutes)
        theta = taken.theta[::EVERY]
        true = individual.absolute_lengths(theta) - individual.length_at_zero
        off = true - robot.routes.relative_lengths(theta)
        rows.append(
            Row(
                seed,
                1e3 * float(np.sqrt(np.mean((off - off.mean(axis=0)) ** 2))),
                oracle(robot, individual).error(taken),
                nominal(robot).error(taken),
                estimation_error(default, taken),
                estimation_error(paper, taken),
            )
        )
    return rows


def table(rows: Sequence[Row]) -> str:
    """Return the rows and their means as plain text."""
    head = 'seed  length error [mm]; errors [rad]: oracle  least squares  default  paper'
    lines = [head, *(_line(f'{row.seed:4d}', row[1:]) for row in rows)]
    lines.append(_line('mean', np.mean([row[1:] for row in rows], axis=0)))
    return '\n'.join(lines)


def _line(name: str, values: Sequence[float]) -> str:
    off, *errors = values
    return f'{name}  {off:16.1f}' + ''.join(
        f'{error:{width}.3f}' for error, width in zip(errors, (14, 15, 9, 7), strict=True)
    )


def main(argv: list[str]) -> None:
    """Train both presets, record the motion on every individual and print the errors."""
    parser = Parser('calibration', 'Prints the deviation of emulated arms from their model.')
    parser.add_robot()
    parser.add_seeds(tuple(range(10)))
    parser.add_minutes('duration of the held-out motion', 5.0)
    args = parser.parse_args(argv)

    robot = Robot.load(args.robot)
    default, paper = (initial_mae(robot, preset) for preset in ('default', 'paper'))
    seeds = tqdm(args.seeds, unit='individual', disable=None)
    print(table(calibration(robot, default, paper, seeds, args.minutes)))
