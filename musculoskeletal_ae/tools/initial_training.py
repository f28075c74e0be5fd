# SPDX-License-Identifier: Apache-2.0
"""The work of `train`: initial training from a robot description, or learning from recordings."""

import sys
import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np
from tqdm import tqdm

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.bags.joint_sensors import wrong_joint_sensors
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.streams import Pairs, read_streams
from musculoskeletal_ae.bags.topics import NO_MOTORS
from musculoskeletal_ae.estimation.estimator import LONGEST_PERIOD
from musculoskeletal_ae.estimation.finding import Finding, observe
from musculoskeletal_ae.estimation.health import HealthMonitor
from musculoskeletal_ae.exceptions import BagError, MusculoskeletalError
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import Trained, initial_mae
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import OUTPUTS, PairError, pair_errors, random_states, train_on
from musculoskeletal_ae.mae.units import Mask
from musculoskeletal_ae.nodes.parameters import motor_settings
from musculoskeletal_ae.options import save_plot
from musculoskeletal_ae.presets.registry import PRESETS
from musculoskeletal_ae.robot.description import shown
from musculoskeletal_ae.robot.jumps import jump_warning
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.friction import directions
from musculoskeletal_ae.signals.motor_settings import MotorSettings
from musculoskeletal_ae.signals.muscle_stream import MuscleStream, RejectionError

HELD_OUT_STATES = 5000  # number of states of the geometric model over which errors are averaged
#: time between two lines of progress without a terminal [s]
REPORT_INTERVAL = 5.0
ENTERED = {
    Mask.THETA_TENSION: '① (θ, T)',
    Mask.TENSION_LENGTH: '② (T, l)',
    Mask.THETA_LENGTH: '③ (θ, l)',
}
SYMBOLS = {'theta': 'θ', 'tension': 'T', 'length': 'l'}


def train(args: Namespace) -> None:
    """Train according to the options, print the errors and write the checkpoint."""
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
    preset = PRESETS[args.preset]
    steps = preset.initial_steps(robot.groups) // (10 if args.quick else 1)
    if args.from_bag:
        _learn_recordings(robot, args, steps)
        return
    start = time.perf_counter()
    trained = _train_on_model(robot, args, steps)
    checkpoint.save(trained.mae, args.out)  # first, so that no later error loses the training
    print(f'{trained.mae.training}; {time.perf_counter() - start:.1f} s')
    # This random stream differs from that of the training, so all states are held out.
    rng = np.random.default_rng([args.seed, 2])
    limit, most = robot.tension.limit, robot.tension.max
    planned = pair_errors(trained.mae, random_states(robot, HELD_OUT_STATES, rng, limit))
    print(model_error(planned, robot.kinematics.distance_unit))
    print(table(planned, f'{HELD_OUT_STATES} unseen states, T in [0, {shown(limit)}] N'))
    if (most > limit).any():
        overload = pair_errors(trained.mae, random_states(robot, HELD_OUT_STATES, rng, most, limit))
        print(table(overload, f'overload: T in [{shown(limit)}, {shown(most)}] N'))
    print(joint_table(robot, planned))
    print(f'checkpoint: {args.out}')
    save_plot(args.plot, lambda: plot(robot, trained, planned))


def _train_on_model(robot: Robot, args: Namespace, steps: int) -> Trained:
    """Train a network on the geometric model, and show the progress."""
    start = time.perf_counter()
    with tqdm(total=steps, unit='batch', desc=f'train {args.preset}', disable=None) as bar:
        reported, begun = start, 0.0
        if bar.disable:
            print(f'training: drawing states of the geometric model, {steps} mini-batches follow')
            sys.stdout.flush()

        def progress(step: int, loss: float, *_: object) -> None:
            nonlocal reported, begun
            bar.update()
            if step % 100 == 0:
                bar.set_postfix(loss=f'{loss:.4f}', refresh=False)
            now = time.perf_counter()
            begun = begun or now
            if bar.disable and now - reported >= REPORT_INTERVAL and step:
                reported, left = now, (steps - step) / step * (now - begun)
                share = 100.0 * step / steps
                print(f'training: {share:.0f} %, loss {loss:.4f}, about {left:.0f} s left')
                sys.stdout.flush()

        return initial_mae(robot, args.preset, args.seed, progress, steps)


def _learn_recordings(robot: Robot, args: Namespace, steps: int) -> None:
    """Learn from recordings in order; print the errors on these and on held-out recordings."""
    # All bags are read first, because training takes minutes and a bag may be unusable.
    motors = motor_settings(args.params_file)
    recordings = {
        path: read(path, robot, args.from_namespace, motors)
        for path in (*args.from_bag, *args.hold_out)
    }
    warnings = [
        f'{path}: {text}'
        for path, pairs in recordings.items()
        for text in wrong_joint_sensors(robot, pairs)
    ]
    _warn(warnings)  # also before the training, because the user may want to stop here
    if args.checkpoint:
        mae = checkpoint.load(args.checkpoint, robot)
    else:
        name = robot.description.directory.name
        print(f'training the initial network of {name}; --checkpoint FILE skips this')
        mae = _train_on_model(robot, args, steps).mae
    learner = Learner(robot, mae, args.preset, args.seed)
    before = {path: error(mae, pairs) for path, pairs in recordings.items()}
    for path, pairs in recordings.items():
        if path not in args.hold_out:
            total = round(pairs.time[-1] - pairs.time[0], 1)
            with tqdm(total=total, unit=' s', desc=path.name, disable=None) as bar:
                if stop := learn(learner, pairs, bar.update):
                    warnings.append(f'{path}: {stop}')
    checkpoint.save(learner.mae, args.out)  # first, so that no later error loses the training
    print(f'{len(learner.samples)} samples, {learner.updates} updates')
    for path, pairs in recordings.items():
        kind = 'held out' if path in args.hold_out else 'learned from'
        after = error(learner.mae, pairs)
        change = f'{before[path]:.4f} → {after:.4f} {robot.kinematics.distance_unit}'
        note = 'before → after learning; reference: the recorded joint sensors'
        print(f'{path} ({kind}): joint-angle error {change} ({note})')
        if path not in args.hold_out:
            continue
        if warning := anomaly_in(robot, pairs, learner.mae, args.preset):
            warnings.append(f'{path} (held out): {warning}')
    print(f'checkpoint: {args.out}')
    sys.stdout.flush()
    _warn(warnings)


def _warn(warnings: list[str]) -> None:
    for warning in warnings:
        print(f'warning: {warning}', file=sys.stderr)


def anomaly_in(robot: Robot, recording: Pairs, mae: Mae, preset: str) -> str:
    """Return a warning about the first anomaly in a recording and the error before it, or ''.

    The health monitor detects the anomaly with the learned network, as on a running arm.
    """
    stream, health = MuscleStream(robot), HealthMonitor(robot, preset)
    isolated: tuple[int, ...] | None = None
    steps = np.diff(recording.time, prepend=recording.time[:1])
    for row, (at, dt) in enumerate(zip(recording.time, steps)):
        recorded = _isolated(recording.isolated[row], mae.isolated)
        if recorded != isolated:
            isolated, reduced = recorded, mae.without(recorded)
            stream.use_body(stream.body.with_isolated(recorded))
            stream.use_transmission(reduced.transmission)
            health.reset()
            health.use(reduced)
        states = np.array([recording.length[row], recording.tension[row], recording.tension[row]])
        states[2] = np.nan
        finding = _finding(health, reduced, stream, states, at, min(dt, LONGEST_PERIOD))
        if finding is None:
            continue
        muscle = robot.muscles[finding.muscle]
        text = f'an anomaly ({muscle}: {finding.kind.value}) begins {at:.1f} s after the start'
        if row:
            before = error(mae, recording.first(row))
            text += f'; until then the error is {before:.4f} {robot.kinematics.distance_unit}'
        return f'{text}. Hold out a healthy recording'
    return ''


def read(
    path: Path, robot: Robot, namespace: str | None = None, motors: MotorSettings = NO_MOTORS
) -> Pairs:
    """Return the paired messages of a bag, and print warnings about unused messages.

    Args:
        path: The bag.
        robot: The recorded robot.
        namespace: The namespace of the arm; required only if the bag has several.
        motors: How the motors of a ros2_control robot are connected.

    Raises:
        BagError: If the bag is unusable or has no pair of simultaneous messages.
    """
    bag = Bag.open(path)
    for reason in bag.unfinished:
        print(f'warning: {path}: unfinished: {reason}', file=sys.stderr)
    streams = read_streams(bag, robot, namespace, motors)
    for reason, count in streams.rejected.items():
        print(f'warning: {path}: {count} messages rejected, {reason}', file=sys.stderr)
    for note in streams.notes:
        print(f'warning: {path}: {note}', file=sys.stderr)
    for part, count in streams.ignored.items():
        print(f'warning: {path}: {count} messages were used only in part: {part}', file=sys.stderr)
    pairs = streams.pairs()
    if not len(pairs.time):
        problem = 'has no simultaneous joint_states and muscle_states'
        raise BagError(path, problem, 'record both topics of this robot')
    return pairs


def learn(
    learner: Learner, recording: Pairs, progress: Callable[[float], None] | None = None
) -> str:
    """Pass a recording to a learner, message by message, as on a running arm.

    As in the estimator, the health monitor decides when learning has to stop. `progress` is called
    with the recorded seconds since its last call.

    Returns:
        A warning if learning stopped before the end of the recording, or ''.
    """
    stream = MuscleStream(learner.robot, learner.body)
    health = HealthMonitor(learner.robot, learner.trainer.preset.name)
    newest, stop = None, ''
    learner.reset()
    learner.anomaly(False)
    steps = np.diff(recording.time, prepend=recording.time[:1])
    for dt, at, theta, length, tension, recorded in zip(steps, *recording, strict=True):
        isolated = _isolated(recorded, learner.isolated)
        if isolated != learner.isolated:
            learner.isolate(isolated)
            stream.use_body(learner.body)
            health.reset()
            newest = None
        if learner.mae is not newest:
            newest = learner.mae
            mae = newest.without(isolated)
            stream.use_transmission(mae.transmission)
            health.use(mae)
        states = np.array([length, tension, np.full(len(length), np.nan)])
        learner.joints(at, theta)
        finding = _finding(health, mae, stream, states, at, min(dt, LONGEST_PERIOD))
        if finding is not None:
            learner.anomaly(True)
            stop = stop or (
                f'learning stopped {at:.1f} s after the start: an anomaly begins there '
                f'({learner.robot.muscles[finding.muscle]}: {finding.kind.value})'
            )
        learner.muscles(states, at)
        learner.poll(at)
        if progress is not None:
            progress(dt)
    return stop


def _finding(
    health: HealthMonitor,
    mae: Mae,
    stream: MuscleStream,
    states: Array,
    time: float,
    dt: float,
) -> Finding | None:
    """Return the fault that a message reveals, or None; implausible messages reveal none."""
    try:
        sample = stream.take_states(states, time)
    except RejectionError:
        return None
    observation = observe(mae, sample.length, sample.motor_tension, sample.bone_tension, dt)
    return health.step(observation)


def error(mae: Mae, recording: Pairs) -> float:
    """Return the mean of ‖θ_est − θ‖₂ [rad] over all messages, for joints with sensors."""
    tension = mae.transmission.end(recording.tension, directions(recording.length))
    estimate = np.empty_like(recording.theta)
    for isolated in np.unique(recording.isolated, axis=0):
        rows = (recording.isolated == isolated).all(axis=1)
        without = mae.without(_isolated(isolated, mae.isolated))
        estimate[rows] = without.estimate(tension[rows], recording.length[rows]).theta
    return float(np.linalg.norm(np.nan_to_num(estimate - recording.theta), axis=1).mean())


def _isolated(row: Ints, default: tuple[int, ...]) -> tuple[int, ...]:
    """Return the muscles isolated in a row of `Pairs.isolated`, or `default` if not recorded."""
    return default if (row < 0).any() else tuple(map(int, np.flatnonzero(row)))


def table(errors: list[PairError], title: str) -> str:
    """Return a table of the nine errors: mean norm of the vector, mean |error| of an element."""
    heads = [f'{SYMBOLS[output]} [{unit}] norm (each)' for output, unit, _ in OUTPUTS]
    lines = ['', title, f'{"entered by":<12}' + ''.join(head.rjust(26) for head in heads)]
    for mask, name in ENTERED.items():
        cells = [f'{e.norm:.4f} ({e.elements.mean():.4f})' for e in errors if e.mask is mask]
        lines.append(f'{name:<12}' + ''.join(cell.rjust(26) for cell in cells))
    return '\n'.join(lines)


def model_error(errors: list[PairError], unit: str) -> str:
    """Return the mean error of the estimated joint angles as one line, which bringup.sh shows."""
    (error,) = (e.norm for e in errors if (e.mask, e.output) == (Mask.TENSION_LENGTH, 'theta'))
    return f'error on the geometric model: {error:.3f} {unit} (mean of unseen states, from T and l)'


def joint_table(robot: Robot, errors: list[PairError]) -> str:
    """Return a table of the mean absolute error of each joint angle when ② estimates θ."""
    estimates = {e.output: e.elements for e in errors if e.mask is Mask.TENSION_LENGTH}
    width = max(len(name) for name in robot.joints) + 2
    rows = zip(robot.joints, estimates['theta'], robot.units)
    lines = [f'{name:<{width}}{error:.4f} {unit.theta}' for name, error, unit in rows]
    return '\n'.join(['', 'mean error of each joint angle, estimated from T and l (②)', *lines, ''])


def plot(robot: Robot, trained: Trained, errors: list[PairError]) -> Any:
    """Return a figure of the loss, the nine errors, and the error of every joint and muscle."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(13.0, 8.5), layout='constrained')
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
    states = f'{HELD_OUT_STATES} unseen states, T in [0, {shown(limit)}] N'
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
        if output == 'theta':  # 'rad', 'm' or both
            unit = ' or '.join(sorted({each.theta for each in robot.units}, reverse=True))
        place = np.arange(len(names))
        for i, error in enumerate(e for e in errors if e.output == output):
            label = f'from {ENTERED[error.mask]}'
            axes.barh(place + 0.27 * (i - 1), error.elements, 0.27, label=label, color=f'C{i}')
        axes.set_yticks(place, names, fontsize=8)
        axes.invert_yaxis()
        axes.set(xlabel=f'mean |error| [{unit}]', title=f'{SYMBOLS[output]} of each {one}')
        axes.grid(axis='x', alpha=0.3)
        axes.xaxis.set_major_locator(MaxNLocator(4))
    handles, labels = lengths.get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside lower center', ncols=3)
    return figure
