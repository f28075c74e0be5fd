# SPDX-License-Identifier: Apache-2.0
"""What `experiment` does."""

from __future__ import annotations

import tempfile
import time
from argparse import Namespace
from pathlib import Path

from tqdm import tqdm

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments import results
from musculoskeletal_ae.experiments.report import write_report
from musculoskeletal_ae.experiments.runner import run
from musculoskeletal_ae.experiments.study import Study
from musculoskeletal_ae.robot.robot import Robot

BAR = '{l_bar}{bar}| {elapsed} < {remaining}'


def measure(args: Namespace) -> None:
    """Measure as the options say and write results, plots and report."""
    start = time.perf_counter()
    names, robot = args.names, Robot.load(args.robot)
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix='experiment_') as folder:
        study = Study(
            robot, args.preset, args.seeds, args.minutes, args.quick, Path(folder), args.reality
        )
        with tqdm(total=1.0, disable=None, bar_format=BAR) as bar:

            def report(share: float, running: str) -> None:
                bar.n = share
                bar.set_description_str(running)

            parts = run(study, names, args.jobs, report)
        files = [*results.write(study, parts, args.out), write_report(args.out)]
    if args.readme:
        files += results.update_readme(args.readme, args.out)
    print(*files, f'{time.perf_counter() - start:.0f} s', sep='\n')
    measured = results.read(args.out)
    if lost := results.failures({name: measured[name] for name in names}):
        raise MusculoskeletalError(f'the rest is written, but this failed: {"; ".join(lost)}')
