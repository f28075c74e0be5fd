# SPDX-License-Identifier: Apache-2.0
"""Imports public robot models, compares muscle lengths with the source, and learns the robots.

    python -m bench importing FILE… [--out DIR] [--learn [--minutes 10]]

The files are public models that you have downloaded; none is part of this repository. The bench
prints one row for each file:

- the numbers of joints, muscles, and wrapping muscles,
- the largest and the median length error over 1000 postures (nan: the source has no lengths),
- the largest moment arm error over 200 postures, and the number of muscles with a wrong sign there,
- the verdict of `check_robot` over 100 postures.

With --learn, the experiments `online_learning` and `control` learn an individual of each robot. The
row then continues with the estimation error on the held-out motion before and after learning, that
of the oracle (mean norms over the joints), and the target error of `proposed`. If the arm cannot
hold any posture, it has no targets, and the cell gives the reason.
"""

import tempfile
from pathlib import Path

import numpy as np

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments import control, online_learning
from musculoskeletal_ae.experiments.study import Study
from musculoskeletal_ae.importing.convert import check_verdict, import_robot
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.presets.registry import PRESETS
from musculoskeletal_ae.robot.checks import check_robot
from musculoskeletal_ae.robot.robot import Robot

INDIVIDUAL = 0
IMPORTED = (
    'model', 'joints', 'muscles', 'wrap', 'max error [mm]', 'median [mm]', 'moment arm [mm]',
    'wrong signs', 'check_robot',
)  # fmt: skip
LEARNED = ('before [rad]', 'after', 'oracle', '`proposed`')


def row(file: Path, out: Path, minutes: float | None) -> list[str]:
    """Import one file, learn the robot if `minutes` is given, and return the cells of its row."""
    name = f'{file.parent.name}/{file.name}'
    try:
        robot, notes, comparison = import_robot(file, out)
    except MusculoskeletalError as error:
        return [name, str(error)[-160:]]
    parts = comparison if comparison and comparison.lengths else ({'': np.nan},) * 3
    lengths, arms, flips = (np.array(list(part.values())) for part in parts)
    errors = f'{1e3 * lengths.max():.3f}', f'{1e3 * np.median(lengths):.3f}'
    errors += f'{1e3 * arms.max():.3f}', f'{(flips > 0.0).sum()}'
    check = check_verdict(check_robot(robot, 100)).removeprefix('check_robot: ')
    wraps = len(set(robot.routes.muscle[robot.routes.wrapping].tolist()))
    counts = (robot.joint_count, robot.muscle_count, wraps)
    cells = [name, *map(str, counts), *errors, f'{check} ({len(set(notes))} notes)']
    return cells if minutes is None else cells + learned(robot, minutes, out)


def learned(robot: Robot, minutes: float, out: Path) -> list[str]:
    """Learn an individual, and return the cells of its results."""
    study = Study(robot, 'default', (INDIVIDUAL,), minutes, quick=False, folder=out)
    for preset in PRESETS:
        online_learning.train_initial(study, preset)
    cells = []
    for keys, experiment in (
        (('before_rad', 'after_rad', 'oracle_rad'), online_learning.measure),
        (('proposed',), control.measure),
    ):
        try:
            numbers = experiment(study, INDIVIDUAL).numbers
        except MusculoskeletalError as error:
            return [*cells, str(error)]
        cells += [f'{numbers[k]["error_rad"] if k == "proposed" else numbers[k]:.4f}' for k in keys]
    return cells


def main(argv: list[str]) -> None:
    """Print the table."""
    parser = Parser('importing', 'Imports public models that you have downloaded.')
    parser.add_argument('files', nargs='+', type=Path, metavar='FILE')
    parser.add_argument('--out', type=Path, metavar='DIR', help='keep the robot directories here')
    parser.add_argument('--learn', action='store_true', help='learn an individual of each')
    parser.add_minutes('duration of the exploration', 10.0)
    args = parser.parse_args(argv)

    head = IMPORTED + LEARNED * args.learn
    print(f'| {" | ".join(head)} |\n{"|---" * len(head)}|')
    with tempfile.TemporaryDirectory() as folder:
        for i, file in enumerate(args.files):
            out = (args.out or Path(folder)) / f'{i}_{file.resolve().parent.name}_{file.stem}'
            cells = row(file, out, args.minutes if args.learn else None)
            cells += [''] * (len(head) - len(cells))
            print(f'| {" | ".join(cells)} |', flush=True)
