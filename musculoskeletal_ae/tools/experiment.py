# SPDX-License-Identifier: Apache-2.0
"""`experiment`: the paper's experiments on emulated arms, with numbers, plots and a report."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

from tqdm import tqdm

from musculoskeletal_ae import options
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments import results
from musculoskeletal_ae.experiments.report import write_report
from musculoskeletal_ae.experiments.runner import EXPERIMENTS, run, total_weight
from musculoskeletal_ae.experiments.study import Study
from musculoskeletal_ae.experiments.table import update_readme
from musculoskeletal_ae.presets import PRESETS
from musculoskeletal_ae.robot.description import shipped_robots
from musculoskeletal_ae.robot.robot import Robot

# In two minutes the learner sees enough to calibrate its detector, so that every key has a value.
QUICK_MINUTES, QUICK_SEEDS = 2.0, (0,)
MINUTES, SEEDS = 10.0, (0, 1, 2, 3, 4)
BAR = '{l_bar}{bar}| {elapsed} < {remaining}'


def main(argv: list[str] | None = None) -> int:
    """Measure; exit status 1 if a robot or folder is not usable, 2 for bad options."""
    args = _parse(argv)
    names = tuple(EXPERIMENTS) if args.name == 'all' else (args.name,)
    start = time.perf_counter()
    # Ended by whoever started it, it clears up as on Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        Robot.load(args.robot)
        args.out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix='experiment_') as folder:
            study = Study(
                args.robot, args.preset, args.seeds, args.minutes, args.quick, Path(folder)
            )
            total = round(total_weight(study, names), 1)
            with tqdm(total=total, disable=None, bar_format=BAR) as bar:

                def report(done: float, running: str) -> None:
                    bar.n = round(min(done, bar.total), 1)
                    bar.set_description_str(running)

                measured = run(study, names, args.jobs, report)
            files = [*results.write(study, measured, args.out), write_report(args.out)]
        if args.readme:
            files += update_readme(args.out, args.readme)
    except (MusculoskeletalError, OSError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    for file in files:
        print(file)
    print(f'{time.perf_counter() - start:.0f} s')
    return 0


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='experiment',
        description='Runs an experiment of the paper on emulated arms, faster than real time and '
        'without ROS, and writes DIR/NAME/result.json, plots, and DIR/report.html with the '
        "paper's numbers beside. Exit status 1: the robot or a file is not usable, "
        '2: bad options.',
    )
    names = (*EXPERIMENTS, 'all')
    robots = ', '.join(sorted(shipped_robots()))
    parser.add_argument('name', metavar='NAME', choices=names, help=', '.join(names))
    parser.add_argument(
        '--robot',
        default='musashi_left_arm',
        metavar='NAME|DIR',
        help=f'a directory, or one of: {robots} (musashi_left_arm)',
    )
    parser.add_argument(
        '--preset',
        choices=tuple(PRESETS),
        default='default',
        help='whose networks are measured; preset paper is always shown beside (default)',
    )
    parser.add_argument(
        '--seeds', type=options.seeds, help='individual arms, e.g. 0,1,2 (0,1,2,3,4; quick: 0)'
    )
    parser.add_argument('--minutes', type=options.minutes, help='of exploration (10; quick: 2)')
    parser.add_argument('--quick', action='store_true', help='a taste of everything, in minutes')
    parser.add_argument(
        '--out', type=Path, default=Path('experiments'), metavar='DIR', help='(experiments)'
    )
    parser.add_argument(
        '--jobs', type=options.whole(1, 256), default=None, help='processes (one per core)'
    )
    parser.add_argument(
        '--readme',
        type=Path,
        metavar='FILE',
        help='also write the results table between the markers of this README',
    )
    args = parser.parse_args(argv)
    args.seeds = args.seeds or (QUICK_SEEDS if args.quick else SEEDS)
    args.minutes = args.minutes or (QUICK_MINUTES if args.quick else MINUTES)
    args.jobs = args.jobs or len(os.sched_getaffinity(0))
    return args


if __name__ == '__main__':
    sys.exit(main())
