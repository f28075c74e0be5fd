# SPDX-License-Identifier: Apache-2.0
"""How far the emulated arms are from their model: the calibration of `Spread`.

The constants of `emulator.individual.Spread` were set once, over seeds 0–9 of musashi_left_arm, so
that on the held-out motion (5 minutes at 100 Hz, mean of ‖θ_est − θ_true‖ over all samples)

- preset `paper` before learning has an error of 0.32–0.42 rad, the paper's own starting point,
- the oracle, least squares on the true body, is left with 0.04–0.06 rad in motion,

and are not touched to improve a result. Attachments that are 8.5 mm off in each coordinate give
lengths about 5 mm off.
`ros2 run musculoskeletal_ae calibrate_emulator` makes this table (least squares on
the geometric model, without a network, and both presets before any learning, in rad):

    seed  lengths off [mm]  oracle [rad]  least squares  default  paper
       0               4.3         0.045          0.183    0.262  0.408
       1               4.6         0.048          0.205    0.202  0.323
       2               3.5         0.041          0.230    0.231  0.300
       3               5.3         0.044          0.152    0.152  0.411
       4               5.2         0.042          0.481    0.474  0.658
       5               5.4         0.037          0.226    0.182  0.343
       6               3.9         0.031          0.167    0.140  0.352
       7               4.8         0.051          0.278    0.250  0.336
       8               3.4         0.040          0.226    0.181  0.472
       9               5.0         0.055          0.298    0.255  0.416
    mean               4.5         0.043          0.245    0.233  0.402
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.experiments.least_squares import mean_error, nominal, oracle
from musculoskeletal_ae.experiments.recording import motion, record
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

# Never used for learning.
HELD_OUT_SEED = 9001
# Every tenth sample is enough for least squares, which is slow.
EVERY = 10


class Row(NamedTuple):
    """Errors of one individual [rad], and how far its lengths are off [mm]."""

    seed: int
    mismatch_mm: float
    oracle: float
    nominal: float
    default: float
    paper: float


def calibration(
    robot: Robot,
    default: Mae,
    paper: Mae,
    seeds: Sequence[int],
    minutes: float = 5.0,
    progress: Callable[[float], None] | None = None,
) -> list[Row]:
    """Measure individuals before any learning, on the held-out motion.

    Args:
        robot: The geometric model.
        default: Initial network of preset `default`, which also makes the motion.
        paper: Initial network of preset `paper`.
        seeds: Individuals.
        minutes: Length of the motion.
        progress: Called with robot seconds passed.
    """
    goals = motion(robot, default, HELD_OUT_SEED, 60.0 * minutes)
    rows = []
    for seed in seeds:
        individual = Individual(robot, seed)
        taken = record(EmulatedArm(robot, seed, individual), goals, progress)
        theta, tension = taken.theta[::EVERY], taken.tension[::EVERY]
        length = taken.length[::EVERY]
        true = individual.absolute_lengths(theta) - individual.length_at_zero
        off = true - robot.routes.relative_lengths(theta)
        rows.append(
            Row(
                seed,
                1e3 * float(np.sqrt(np.mean((off - off.mean(axis=0)) ** 2))),
                mean_error(oracle(robot, individual).estimate(tension, length), theta),
                mean_error(nominal(robot).estimate(tension, length), theta),
                mean_error(default.estimate(taken.tension, taken.length).theta, taken.theta),
                mean_error(paper.estimate(taken.tension, taken.length).theta, taken.theta),
            )
        )
    return rows


def table(rows: Sequence[Row]) -> str:
    """Return the rows and their means as plain text."""
    head = 'seed  lengths off [mm]  oracle [rad]  least squares  default  paper'
    lines = [head, *(_line(f'{row.seed:4d}', row[1:]) for row in rows)]
    lines.append(_line('mean', np.mean([row[1:] for row in rows], axis=0)))
    return '\n'.join(lines)


def _line(name: str, values: Sequence[float]) -> str:
    off, *errors = values
    return f'{name}  {off:16.1f}' + ''.join(
        f'{error:{width}.3f}' for error, width in zip(errors, (14, 15, 9, 7), strict=True)
    )
