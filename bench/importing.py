# SPDX-License-Identifier: Apache-2.0
"""Imports other people's robots and says how far their lengths are from the source's own.

python -m bench importing FILE… [--out DIR]

The files are public models that you have fetched; nothing of them is part of this repository. For
each it prints one row: joints, muscles, how many of them wrap, the largest and the median length
error over 1000 postures (nan: it has no lengths of its own), and what `check_robot` says of 100.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.importing.convert import check_verdict, import_robot
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.checks import check_robot


def row(file: Path, out: Path) -> list[str]:
    """Import one file and return the cells of its row."""
    name = f'{file.parent.name}/{file.name}'
    try:
        robot, notes, errors = import_robot(file, out)
    except MusculoskeletalError as error:
        return [name, str(error)[-160:], *[''] * 5]
    values = 1e3 * np.array(list(errors.values())) if errors else np.array([np.nan])
    lengths = f'{values.max():.3f}', f'{np.median(values):.3f}'
    check = check_verdict(check_robot(robot, 100)).removeprefix('check_robot: ')
    wraps = len(set(robot.routes.muscle[robot.routes.wrapping].tolist()))
    counts = (robot.joint_count, robot.muscle_count, wraps)
    return [name, *map(str, counts), *lengths, f'{check} ({len(set(notes))} notes)']


def main(argv: list[str]) -> None:
    """Print the table."""
    parser = Parser('importing', 'Imports public models that you have fetched.')
    parser.add_argument('files', nargs='+', type=Path, metavar='FILE')
    parser.add_argument('--out', type=Path, metavar='DIR', help='keep the robot directories here')
    args = parser.parse_args(argv)
    print('| model | joints | muscles | wrap | max error [mm] | median [mm] | check_robot |')
    print('|---|---|---|---|---|---|---|')
    with tempfile.TemporaryDirectory() as folder:
        for i, file in enumerate(args.files):
            out = (args.out or Path(folder)) / f'{i}_{file.resolve().parent.name}_{file.stem}'
            print('| ' + ' | '.join(row(file, out)) + ' |', flush=True)
