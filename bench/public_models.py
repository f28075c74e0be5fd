# SPDX-License-Identifier: Apache-2.0
"""Imports other people's models, lets an individual of each be learned, and says how well.

    python -m bench public_models FILE… [--minutes 10] --out DIR

The files are public models that you have fetched; nothing of them is part of this repository. One
row each: what `check_robot` says, the error of the estimate on the held-out motion before and after
learning, beside the oracle (all mean norms over the joints), and how far `proposed` leaves the arm
from its targets. An arm that holds itself in no posture has no targets: then the cell says why.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments import control, online_learning
from musculoskeletal_ae.experiments.study import Study
from musculoskeletal_ae.importing.convert import check_verdict, import_robot
from musculoskeletal_ae.options import Parser, exit_status
from musculoskeletal_ae.presets import PRESETS
from musculoskeletal_ae.robot.checks import check_robot

INDIVIDUAL = 0
HEAD = ('model', 'joints × muscles', 'check_robot', 'before [rad]', 'after', 'oracle', 'proposed')


def cells(file: Path, out: Path, minutes: float) -> list[str]:
    """Return a model's row."""
    name = f'{file.resolve().parent.name}/{file.name}'
    try:
        robot = import_robot(file, out).robot
    except MusculoskeletalError as error:
        return [name, f'not imported: {error}']
    verdict = check_verdict(check_robot(robot)).removeprefix('check_robot: ')
    row = [name, f'{robot.joint_count} × {robot.muscle_count}', verdict]
    study = Study(robot, 'default', (INDIVIDUAL,), minutes, quick=False, folder=out)

    def learned() -> list[float]:
        for preset in PRESETS:
            online_learning.train_initial(study, preset)
        numbers = online_learning.measure(study, INDIVIDUAL).numbers
        return [numbers[f'{key}_rad'] for key in ('before', 'after', 'oracle')]

    def controlled() -> list[float]:
        return [control.measure(study, INDIVIDUAL).numbers['proposed']['error_rad']]

    return row + _told(learned) + _told(controlled)


def _told(measured: Callable[[], list[float]]) -> list[str]:
    """Return numbers as text, or why there are none."""
    try:
        return [f'{value:.4f}' for value in measured()]
    except MusculoskeletalError as error:
        return [f'{type(error).__name__}: {error}']


def run(files: list[Path], minutes: float, out: Path) -> None:
    """Print the table."""
    print(f'| {" | ".join(HEAD)} |\n{"|---" * len(HEAD)}|')
    for i, file in enumerate(files):
        print(f'| {" | ".join(cells(file, out / f"{i}_{file.stem}", minutes))} |', flush=True)


def main(argv: list[str] | None = None) -> int:
    """Learn models."""
    parser = Parser('public_models', 'Imports and learns public models that you have fetched.')
    parser.add_argument('files', nargs='+', type=Path, metavar='FILE')
    parser.add_minutes('duration of the exploration', 10.0)
    parser.add_out('DIR', 'robot directories, recordings and networks')
    args = parser.parse_args(argv)
    return exit_status(lambda: run(args.files, args.minutes, args.out))


if __name__ == '__main__':
    sys.exit(main())
