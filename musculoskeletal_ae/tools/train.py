# SPDX-License-Identifier: Apache-2.0
"""`train`: initial training from a robot description, or learning from recordings."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from tqdm import tqdm

from musculoskeletal_ae import options
from musculoskeletal_ae.exceptions import MusculoskeletalError, RobotDescriptionError
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.training import (
    OUTPUTS,
    PairError,
    Trained,
    initial_mae,
    pair_errors,
    random_states,
)
from musculoskeletal_ae.mae.units import Mask
from musculoskeletal_ae.presets import PRESETS
from musculoskeletal_ae.robot.directories import shipped_robots
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools.train_from_bag import read, train_from_bags

UNSEEN = 5000
ENTERED = {
    Mask.THETA_TENSION: '① (θ, T)',
    Mask.TENSION_LENGTH: '② (T, l)',
    Mask.THETA_LENGTH: '③ (θ, l)',
}
SYMBOLS = {'theta': 'θ', 'tension': 'T', 'length': 'l'}


def main(argv: list[str] | None = None) -> int:
    """Train one network; exit status 1 if the robot or a file is not usable, 2 for bad options."""
    args = _parse(argv)
    for file in (args.out, args.plot):
        if file is not None and (not file.parent.is_dir() or file.is_dir()):
            print(f'error: {file}: is a directory, or in one that is not there', file=sys.stderr)
            return 1
    try:
        robot = Robot.load(args.robot)
    except RobotDescriptionError as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    if args.from_bag:
        return _from_bags(robot, args)
    steps = _steps(args)
    start = time.perf_counter()
    with tqdm(total=steps, unit='batch', desc=f'train {args.preset}', disable=None) as bar:

        def progress(step: int, loss: float) -> None:
            bar.update()
            if step % 100 == 0:
                bar.set_postfix(loss=f'{loss:.4f}', refresh=False)

        trained = initial_mae(robot, args.preset, args.seed, progress, steps)
    seconds = time.perf_counter() - start
    tension = robot.tension
    # Not the stream of the training, so none of these states has been seen.
    rng = np.random.default_rng([args.seed, 2])
    planned = pair_errors(trained.mae, random_states(robot, UNSEEN, rng, tension.limit))
    overload = pair_errors(
        trained.mae, random_states(robot, UNSEEN, rng, tension.max, tension.limit)
    )
    print(f'{trained.mae.training}; {seconds:.1f} s')
    print(table(planned, f'{UNSEEN} unseen states, T in [0, {tension.limit:g}] N'))
    if tension.max > tension.limit:
        beyond = f'the same, T in [{tension.limit:g}, {tension.max:g}] N (overload)'
        print(table(overload, beyond))
    print(joint_table(robot, planned))
    try:
        checkpoint.save(trained.mae, args.out)
        print(f'checkpoint: {args.out}')
        if args.plot is not None:
            plot(robot, trained, planned, args.plot)
            print(f'plot: {args.plot}')
    except (OSError, ValueError) as error:
        print(f'error: cannot be written: {error}', file=sys.stderr)
        return 1
    return 0


def _steps(args: argparse.Namespace) -> int:
    return PRESETS[args.preset].training.steps // (10 if args.quick else 1)


def _from_bags(robot: Robot, args: argparse.Namespace) -> int:
    try:
        # Before the network is trained, which takes longer than finding a bag unusable.
        recordings = {path: read(path, robot) for path in (*args.from_bag, *args.hold_out)}
        if args.checkpoint is not None:
            mae = checkpoint.load(args.checkpoint, robot)
        else:
            print(f'training the network of {robot.description.directory.name} to start from')
            mae = initial_mae(robot, args.preset, args.seed, steps=_steps(args)).mae
        learner = Learner(robot, mae, args.preset, args.seed)
        train_from_bags(learner, recordings, args.hold_out)
        checkpoint.save(learner.mae, args.out)
    except (MusculoskeletalError, OSError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    print(f'checkpoint: {args.out}')
    return 0


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='train',
        description='Trains the Musculoskeletal AutoEncoder on the geometric model of a robot and '
        'writes a checkpoint. Prints the error of each of the nine (mask, output) pairs on '
        'unseen data. Exit status 1: the robot or a file is not usable, 2: bad options.',
    )
    names = ', '.join(sorted(shipped_robots()))
    parser.add_argument(
        '--robot', required=True, metavar='NAME|DIR', help=f'a directory, or one of: {names}'
    )
    parser.add_argument(
        '--out', required=True, type=Path, metavar='FILE.safetensors', help='the checkpoint'
    )
    parser.add_argument(
        '--preset',
        choices=tuple(PRESETS),
        default='default',
        help='paper: network and training as printed; default: the best measured (default)',
    )
    parser.add_argument('--seed', type=options.seed, default=0, help='of data and weights (0)')
    parser.add_argument('--plot', type=Path, metavar='FILE.png', help='loss and errors')
    parser.add_argument(
        '--from-bag',
        nargs='+',
        type=Path,
        default=[],
        metavar='BAG',
        help='learn the real arm from recordings: bag directories or .mcap files',
    )
    parser.add_argument(
        '--hold-out',
        nargs='+',
        type=Path,
        default=[],
        metavar='BAG',
        help='with --from-bag: recordings that are only judged, before and after',
    )
    parser.add_argument(
        '--checkpoint',
        type=Path,
        metavar='FILE',
        help='with --from-bag: network to start from (default: train one on the geometric model)',
    )
    parser.add_argument(
        '--quick', action='store_true', help='a tenth of the training, to try things out'
    )
    args = parser.parse_args(argv)
    if not args.from_bag and (args.hold_out or args.checkpoint):
        parser.error('--hold-out and --checkpoint go with --from-bag')
    return args


def table(errors: list[PairError], title: str) -> str:
    """Return the nine errors: mean norm of the error vector and mean |error| of an element."""
    lines = ['', title, f'{"entered by":<12}' + ''.join(f'{_head(o):>26}' for o in OUTPUTS)]
    for mask, name in ENTERED.items():
        row = [e for e in errors if e.mask is mask]
        cells = [f'{e.norm:.4f} ({e.elements.mean():.4f})' for e in row]
        lines.append(f'{name:<12}' + ''.join(cell.rjust(26) for cell in cells))
    return '\n'.join(lines)


def _head(output: tuple[str, str, float]) -> str:
    return f'{SYMBOLS[output[0]]} [{output[1]}] norm (each)'


def _estimate(errors: list[PairError]) -> PairError:
    found = [e for e in errors if e.mask is Mask.TENSION_LENGTH and e.output == 'theta']
    return found[0]


def joint_table(robot: Robot, errors: list[PairError]) -> str:
    """Return the mean absolute error of every joint estimated from (T, l)."""
    rows = zip(robot.joints, _estimate(errors).elements)
    width = max(len(name) for name in robot.joints) + 2
    lines = [f'{name:<{width}}{error:.4f} rad' for name, error in rows]
    return '\n'.join(['', '② → θ, mean |error| of each joint', *lines, ''])


def plot(robot: Robot, trained: Trained, errors: list[PairError], file: Path) -> None:
    """Draw the loss, the nine errors and every joint's and muscle's error."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(13.0, 8.5), layout='constrained')
    FigureCanvasAgg(figure)
    figure.suptitle(trained.mae.training)
    curve, text, joints, tensions, lengths = figure.subplot_mosaic(
        [['loss', 'loss', 'loss', 'table', 'table', 'table'],
         ['theta', 'theta', 'tension', 'tension', 'length', 'length']]
    ).values()  # fmt: skip
    losses = np.array(trained.losses)
    curve.semilogy(np.arange(1, len(losses) + 1), losses, lw=0.4, color='C7', label='mini-batch')
    window = max(1, len(losses) // 50)
    smooth = np.convolve(losses, np.full(window, 1.0 / window), mode='valid')
    curve.semilogy(np.arange(window, len(losses) + 1), smooth, label=f'mean of {window}')
    curve.set(xlabel='mini-batch', ylabel='training loss', title='Training')
    curve.legend()
    curve.grid(alpha=0.3)
    text.axis('off')
    limit = robot.tension.limit
    text.set_title(f'Mean norm of the error, {UNSEEN} unseen states, T in [0, {limit:g}] N')
    cells = [[f'{e.norm:.4f} {e.unit}' for e in errors if e.mask is mask] for mask in ENTERED]
    shown = text.table(
        cells,
        rowLabels=list(ENTERED.values()),
        colLabels=[f'→ {SYMBOLS[o[0]]}' for o in OUTPUTS],
        loc='center',
        cellLoc='center',
    )
    shown.scale(0.8, 2.2)
    colours = {mask: f'C{i}' for i, mask in enumerate(Mask)}
    bars = (joints, 'joint'), (tensions, 'muscle'), (lengths, 'muscle')
    for (axes, one), (output, unit, _) in zip(bars, OUTPUTS):
        names = robot.joints if one == 'joint' else robot.muscles
        place = np.arange(len(names))
        for i, error in enumerate(e for e in errors if e.output == output):
            label = f'from {ENTERED[error.mask]}'
            colour = colours[error.mask]
            axes.barh(place + 0.27 * (i - 1), error.elements, 0.27, label=label, color=colour)
        axes.set_yticks(place, names, fontsize=8)
        axes.invert_yaxis()
        axes.set(xlabel=f'mean |error| [{unit}]', title=f'{SYMBOLS[output]} of each {one}')
        axes.grid(axis='x', alpha=0.3)
        axes.xaxis.set_major_locator(MaxNLocator(4))
    handles, labels = lengths.get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside lower center', ncols=3)
    figure.savefig(file, dpi=110)


if __name__ == '__main__':
    sys.exit(main())
