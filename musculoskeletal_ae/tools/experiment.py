# SPDX-License-Identifier: Apache-2.0
"""`experiment`: the paper's experiments on emulated arms, with numbers, plots and a report."""

from argparse import ArgumentTypeError
from pathlib import Path

from musculoskeletal_ae.experiments import NAMES, PAPER
from musculoskeletal_ae.options import Parser, exit_status
from musculoskeletal_ae.process_signals import import_heavy

# With --quick, explore for two minutes: enough to calibrate the detector, so that every result has
# a value.
QUICK_MINUTES, QUICK_SEEDS = 2.0, (0,)
MINUTES, SEEDS = 10.0, (0, 1, 2, 3, 4)


def main(argv: list[str] | None = None) -> int:
    """Run experiments; exit status 1 if a part failed or a file is unusable, 2 for bad options."""
    parser = Parser(
        'experiment',
        'Runs an experiment of the paper on emulated arms, faster than real time and without ROS, '
        "and writes DIR/NAME/result.json, plots, and DIR/report.html with the paper's numbers "
        'beside ours. Exit status 1: a part failed or a file is unusable, 2: invalid options.',
    )
    text = (
        f'{", ".join(NAMES)}; several, separated by commas; "all"; '
        'or "paper", for all experiments that repeat the paper'
    )
    parser.add_argument('names', metavar='NAME', type=_names, help=text)
    parser.add_robot()
    parser.add_preset('preset to measure; results of preset "paper" are always shown beside it')
    parser.add_seeds(None, 'seeds of the emulated individuals (default: 0,1,2,3,4; quick: 0)')
    parser.add_reality()
    parser.add_minutes('duration of the exploration (default: 10; quick: 2)', None)
    parser.add_quick('run a short version of each experiment, in about a minute for all of them')
    parser.add_out('DIR', 'results and report', Path('experiments'))
    parser.add_workers()
    text = (
        'folder for networks, recordings and results; a later run with the same options computes '
        'only the results that are missing. Use only folders of your own runs. With --scheduler, '
        'all workers must share the folder'
    )
    parser.add_argument('--keep', type=Path, metavar='DIR', help=text)
    text = (
        'also write the results table between the markers of this page, and copy the results to '
        'the folder of its name'
    )
    parser.add_argument('--readme', type=Path, metavar='FILE', help=text)
    text = "also write the page FILE.md that shows the paper's results beside ours, with pictures"
    parser.add_argument('--page', type=Path, metavar='FILE.md', help=text)
    args = parser.parse_args(argv)
    if args.scheduler and not args.keep:
        parser.error('--scheduler: also name --keep DIR, a folder that all workers share')
    args.seeds = args.seeds or (QUICK_SEEDS if args.quick else SEEDS)
    args.minutes = args.minutes or (QUICK_MINUTES if args.quick else MINUTES)
    return exit_status(
        lambda: import_heavy('musculoskeletal_ae.experiments.measurement').measure(args)
    )


def _names(text: str) -> tuple[str, ...]:
    groups = {'all': NAMES, 'paper': PAPER}
    names = groups.get(text) or tuple(dict.fromkeys(text.split(',')))
    if unknown := [name for name in names if name not in NAMES]:
        legal = ', '.join([*NAMES, *groups])
        raise ArgumentTypeError(f'unknown experiment {unknown[0]!r}; legal: {legal}')
    return names
