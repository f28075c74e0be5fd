# SPDX-License-Identifier: Apache-2.0
"""`train` without recordings: trains on the geometric model and reports the errors."""

import sys
import time
from argparse import Namespace
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np

from musculoskeletal_ae.design.prospects import prospects
from musculoskeletal_ae.design.route_jumps import jump_warning
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.figures import save_plot
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import (
    OUTPUTS,
    PairError,
    pair_errors,
    random_states,
    rest_states,
    train_on,
)
from musculoskeletal_ae.mae.units import Mask
from musculoskeletal_ae.presets.registry import PRESETS
from musculoskeletal_ae.progress_bar import ProgressBar
from musculoskeletal_ae.robot.description import shown
from musculoskeletal_ae.robot.joint_units import RACK
from musculoskeletal_ae.robot.robot import Robot

HELD_OUT_STATES = 5000  # average errors over this many states of the geometric model
ENTERED = {
    Mask.THETA_TENSION: '① (θ, T)',
    Mask.TENSION_LENGTH: '② (T, l)',
    Mask.THETA_LENGTH: '③ (θ, l)',
}
SYMBOLS = {'theta': 'θ', 'tension': 'T', 'length': 'l'}


def prepare(args: Namespace) -> Robot:
    """Prepare the training: check the output files, choose the device, and return the robot.

    Raises:
        MusculoskeletalError: If a file cannot be written or the robot is unusable.
    """
    for file in filter(None, (args.out, args.plot)):
        if not file.parent.is_dir() or file.is_dir():
            raise MusculoskeletalError(f'{file}: expected a file in an existing directory')
        try:  # check this before the training, which takes minutes
            NamedTemporaryFile(dir=file.parent, prefix=f'.{file.name}.').close()
        except OSError as error:
            problem = f'{file}: cannot be written ({error.strerror}); choose another file'
            raise MusculoskeletalError(problem) from error
    train_on(args.device)
    robot = Robot.load(args.robot)
    if warning := jump_warning(robot):
        print(f'warning: {warning}. Nodes may reject this network', file=sys.stderr)
    return robot


def train(args: Namespace) -> None:
    """Train on the geometric model, write the checkpoint and print the errors."""
    robot = prepare(args)
    for line in prospects(robot).lines():
        print(line, file=sys.stderr, flush=True)
    start = time.perf_counter()
    mae, losses = train_on_model(robot, args)
    checkpoint.save(mae, args.out)  # first, so that no later error loses the training
    print(f'{mae.training}; {time.perf_counter() - start:.1f} s')
    # This random stream differs from that of the training, so all states are held out.
    rng = np.random.default_rng([args.seed, 2])
    limit, most = robot.tension.limit, robot.tension.max
    states = rest_states(robot, HELD_OUT_STATES, rng)
    planned = pair_errors(mae, states)
    off = mae.estimate(states.tension, states.length).theta - states.theta
    print(
        f'error on the geometric model: {robot.units.error_text(off, ".3f")} (mean over unseen '
        'states, from T and l)',
        file=sys.stderr,
        flush=True,
    )
    has_slides = bool(robot.units.slides.any())
    rack = f'; {1e3 * RACK:g} mm of a prismatic joint count as 1 rad' * has_slides
    print(table(planned, f'{HELD_OUT_STATES} unseen states, T from 0 to {shown(limit)} N{rack}'))
    if (most > limit).any():
        overload = pair_errors(mae, random_states(robot, HELD_OUT_STATES, rng, most, limit))
        print(table(overload, f'overload: T from {shown(limit)} to {shown(most)} N'))
    print(joint_table(robot, planned))
    print(f'checkpoint: {args.out}')
    save_plot(args.plot, lambda: plot(robot, mae, losses, planned))


def train_on_model(robot: Robot, args: Namespace) -> tuple[Mae, list[float]]:
    """Train a network on the geometric model, and show the progress.

    Returns:
        The network, and the loss of every mini-batch.
    """
    steps = PRESETS[args.preset].initial_steps(robot) // (10 if args.quick else 1)
    losses = [0.0]
    with ProgressBar('training', steps, lambda: f'loss {losses[-1]:.4f}', is_even=True) as bar:
        bar.announce(f': drawing states of the geometric model, {steps} mini-batches follow')

        def progress(_step: int, loss: float, *_: object) -> None:
            losses.append(loss)
            bar.add()

        return initial_mae(robot, args.preset, args.seed, progress, steps), losses[1:]


def table(errors: list[PairError], title: str) -> str:
    """Return a table of the errors of joint angles θ, tensions T and lengths l.

    The table has a row for each pair of quantities from which the network computes all three. Each
    cell has the mean norm of the error vector and, in parentheses, the mean absolute error of an
    element.
    """
    heads = [f'{SYMBOLS[output]} [{unit}] norm (each)' for output, unit, _ in OUTPUTS]
    lines = ['', title, f'{"entered by":<12}' + ''.join(head.rjust(26) for head in heads)]
    for mask, name in ENTERED.items():
        cells = [f'{e.norm:.4f} ({e.elements.mean():.4f})' for e in errors if e.mask is mask]
        lines.append(f'{name:<12}' + ''.join(cell.rjust(26) for cell in cells))
    return '\n'.join(lines)


def joint_table(robot: Robot, errors: list[PairError]) -> str:
    """Return a table of the mean absolute error of each joint angle, estimated from T and l."""
    estimates = {e.output: e.elements for e in errors if e.mask is Mask.TENSION_LENGTH}
    width = max(len(name) for name in robot.joints) + 2
    rows = zip(robot.joints, estimates['theta'], robot.units)
    lines = [f'{name:<{width}}{unit.position_text(error, ".4f")}' for name, error, unit in rows]
    return '\n'.join(['', 'mean error of each joint angle, estimated from T and l (②)', *lines, ''])


def plot(robot: Robot, mae: Mae, losses: list[float], errors: list[PairError]) -> Any:
    """Return a figure of the loss, the errors in `table`, and the errors by joint and muscle."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(13.0, 8.5), layout='constrained')
    figure.suptitle(mae.training)
    curve, text, joints, tensions, lengths = figure.subplot_mosaic(
        [['loss', 'loss', 'loss', 'table', 'table', 'table'],
         ['theta', 'theta', 'tension', 'tension', 'length', 'length']]
    ).values()  # fmt: skip
    curve.semilogy(np.arange(1, len(losses) + 1), losses, lw=0.4, color='C7', label='mini-batch')
    window = max(1, len(losses) // 50)
    smooth = np.convolve(losses, np.full(window, 1.0 / window), mode='valid')
    curve.semilogy(np.arange(window, len(losses) + 1), smooth, label=f'mean of {window}')
    curve.set(xlabel='mini-batch', ylabel='training loss', title='Training')
    curve.legend()
    curve.grid(alpha=0.3)
    text.axis('off')
    limit = robot.tension.limit
    states = f'{HELD_OUT_STATES} unseen states, T from 0 to {shown(limit)} N'
    text.set_title(f'Mean norm of the error, {states}')
    cells = [[f'{e.norm:.4f} {e.unit}' for e in errors if e.mask is mask] for mask in ENTERED]
    grid = text.table(
        cells,
        rowLabels=list(ENTERED.values()),
        colLabels=[f'→ {SYMBOLS[o[0]]}' for o in OUTPUTS],
        loc='center',
        cellLoc='center',
    )
    grid.scale(0.8, 2.2)
    for axes, (output, unit, _) in zip((joints, tensions, lengths), OUTPUTS):
        one, names = ('joint', robot.joints) if output == 'theta' else ('muscle', robot.muscles)
        if output == 'theta':
            unit = robot.units.position_unit
        place = np.arange(len(names))
        for i, error in enumerate(e for e in errors if e.output == output):
            label = f'from {ENTERED[error.mask]}'
            values = error.elements
            if output == 'theta':
                values = robot.units.to_position(values)
            axes.barh(place + 0.27 * (i - 1), values, 0.27, label=label, color=f'C{i}')
        axes.set_yticks(place, names, fontsize=8)
        axes.invert_yaxis()
        axes.set(xlabel=f'mean |error| [{unit}]', title=f'{SYMBOLS[output]} of each {one}')
        axes.grid(axis='x', alpha=0.3)
        axes.xaxis.set_major_locator(MaxNLocator(4))
    handles, labels = lengths.get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside lower center', ncols=3)
    return figure
