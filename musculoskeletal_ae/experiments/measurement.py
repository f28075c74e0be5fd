# SPDX-License-Identifier: Apache-2.0
"""Run the command `experiment`: measure, and write results, plots, report and pages."""

import json
import tempfile
import time
from argparse import Namespace
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.paper_page import update_page
from musculoskeletal_ae.experiments.results import (
    failures,
    read,
    text_around_table,
    update_readme,
    write,
    write_report,
)
from musculoskeletal_ae.experiments.runner import Outcome, run, stages
from musculoskeletal_ae.experiments.study import Study
from musculoskeletal_ae.experiments.workers import workers
from musculoskeletal_ae.progress_bar import ProgressBar
from musculoskeletal_ae.robot.robot import Robot


def measure(args: Namespace) -> None:
    """Run the experiments that the options name; write results, plots, report and pages.

    Raises:
        MusculoskeletalError: After writing, if some of the experiments failed.
        KeyboardInterrupt: If the run was interrupted; nothing is written to the output folder.
    """
    start = time.perf_counter()
    names, robot = args.names, Robot.load(args.robot)
    if args.readme:  # check the file before hours of work
        text_around_table(args.readme)
    args.out.mkdir(parents=True, exist_ok=True)
    with _work_folder(args) as folder:
        study = Study(
            robot, args.preset, args.seeds, args.minutes, args.quick, folder, args.reality
        )
        seconds = defaultdict[str, float](float)
        total = sum(part.weight for parts in stages(study, names) for part in parts)
        bar = ProgressBar('experiments', total)
        with workers(args.jobs, args.scheduler) as processes, bar:

            def report(outcome: Outcome) -> None:
                seconds[outcome.part.name] += outcome.seconds
                bar.add(outcome.part.weight)

            try:
                results = run(study, names, processes, report)
            except KeyboardInterrupt as stop:
                kept = 'use --keep DIR next time to keep the parts that were measured'
                if args.keep:
                    kept = f'--keep {args.keep} has the parts that were measured'
                raise KeyboardInterrupt(f'nothing was written to {args.out}; {kept}') from stop
        files = [*write(study, results, args.out), write_report(args.out)]
    if args.readme:
        files += update_readme(args.readme, args.out)
    if args.page:
        files += update_page(args.page, args.out)
    print(*files, f'finished after {time.perf_counter() - start:.0f} s', sep='\n')
    hours = [f'{name} {spent / 3600.0:.3f}' for name, spent in seconds.items() if spent]
    print(f'core-hours of this run: {", ".join(hours) or "none"}')
    measured = read(args.out)
    if failed := failures({name: measured[name] for name in names}):
        problem = f'some experiments failed: {"; ".join(failed)}'
        raise MusculoskeletalError(f'{problem}; the results of all other experiments are written')


@contextmanager
def _work_folder(args: Namespace) -> Iterator[Path]:
    """Yield the folder for networks and recordings: the folder of `--keep`, or a temporary folder.

    Raises:
        MusculoskeletalError: If the kept folder belongs to a run with other options, or contains
            files but no options of a run.
    """
    if args.keep is None:
        with tempfile.TemporaryDirectory(prefix='experiment_') as folder:
            yield Path(folder)
        return
    folder = args.keep.resolve()  # workers may have another working directory
    folder.mkdir(parents=True, exist_ok=True)
    options = {
        key: str(getattr(args, key)) for key in ('robot', 'preset', 'minutes', 'quick', 'reality')
    }
    file = args.keep / 'options.json'
    if file.is_file():
        before = json.loads(file.read_text(encoding='utf-8'))
        if before != options:
            changed = ', '.join(f'{key} {before.get(key)}' for key in options)
            problem = f'--keep {args.keep} contains parts of a run with other options ({changed})'
            remedy = 'use these options again, or name an empty folder'
            raise MusculoskeletalError(f'{problem}; {remedy}')
    elif any(args.keep.iterdir()):
        raise MusculoskeletalError(f'--keep {args.keep}: expected an empty or new folder')
    file.write_text(json.dumps(options), encoding='utf-8')
    yield folder
