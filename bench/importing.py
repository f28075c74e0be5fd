# SPDX-License-Identifier: Apache-2.0
"""Imports other people's robots, says how far lengths are from the source's own, and learns them.

    python -m bench importing FILE… [--out DIR] [--learn [--minutes 10]]

The files are public models that you have fetched; nothing of them is part of this repository. For
each it prints one row: joints, muscles, how many of them wrap, the largest and the median length
error over 1000 postures (nan: it has no lengths of its own), the largest error of a moment arm over
200, how many muscles have one of wrong sign there, and what `check_robot` says of 100.
With --learn an individual of each is learned by the experiments `online_learning` and `control`,
and the row goes on with the error of the estimate on the held-out motion before and after, beside
the oracle's (mean norms over the joints), and how far `proposed` leaves the arm from its targets.
An arm that holds itself in no posture has no targets: then the cell says why.
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
    """Import one file, learn it if for minutes, and return the cells of its row."""
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
    """Return the cells of what is learned of an individual."""
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
    parser = Parser('importing', 'Imports public models that you have fetched.')
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
