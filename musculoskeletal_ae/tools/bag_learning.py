# SPDX-License-Identifier: Apache-2.0
"""`train --from-bag`: learns from recordings, as on a running arm, and reports the errors."""

import sys
from argparse import Namespace
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.bags.joint_sensors import wrong_joint_sensors
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.storage import LONGEST_PAUSE
from musculoskeletal_ae.bags.streams import Pairs, read_streams
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.estimation.network_validation.validator import CheckpointValidator
from musculoskeletal_ae.exceptions import (
    BagError,
    CheckpointError,
    GateError,
    MusculoskeletalError,
)
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.rest import REST_TIME
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import DEFAULT_SEED
from musculoskeletal_ae.process_signals import STOP, Reaction
from musculoskeletal_ae.progress_bar import ProgressBar
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import Anomaly
from musculoskeletal_ae.signals.friction import directions
from musculoskeletal_ae.signals.muscle_readings import muscle_reading
from musculoskeletal_ae.signals.muscle_stream import RejectionError
from musculoskeletal_ae.tools.model_training import prepare, train_on_model
from musculoskeletal_ae.tools.network_cache import network_file

LEAST_OFFSET = 0.002  # smallest joint-sensor offset that is shown [rad]
#: A held-out recording repeats what was learned if more than REPEATED_SHARE of its postures are
#: closer than REPEATED [rad] to a learned one. Between two explorations of a neck of two joints
#: with the same seed, this was 70 % of the postures, and 2 % with different seeds.
REPEATED, REPEATED_SHARE = 0.03, 0.25


def train(args: Namespace) -> None:
    """Learn from recordings in order; print the errors on them and on held-out recordings."""
    robot = prepare(args)
    # All bags are read first, because training takes minutes and a bag may be unusable.
    recordings = {
        path: read(path, robot, args.from_namespace) for path in (*args.from_bag, *args.hold_out)
    }
    warnings = [
        f'{path}: {text}'
        for path, pairs in recordings.items()
        for text in wrong_joint_sensors(robot, pairs)
    ]
    _warn(warnings)  # also before the training, because the user may want to stop here
    mae = _initial_network(robot, args)
    CheckpointValidator(robot).check(mae)
    learner = Learner(robot, mae, args.preset, args.seed)
    # A recording that does not tell which muscles were isolated is of the arm of this network.
    learner.use_body(learner.body.with_isolated(mae.isolated))
    before = {path: error(mae, pairs) for path, pairs in recordings.items()}
    try:
        for path, pairs in recordings.items():
            if path in args.hold_out:
                continue
            if stop := _learn_and_show(learner, path, pairs):
                warnings.append(f'{path}: {stop}')
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt(_keep(learner, args)) from interrupt
    if not learner.updates:
        _warn(warnings)
        raise MusculoskeletalError(f'{_nothing_learned(learner)}; {args.out} was not written')
    checkpoint.save(learner.mae, args.out)  # first, so that no later error loses the training
    print(f'{len(learner.samples)} samples, {learner.updates} updates')
    zero = (
        np.zeros(robot.joint_count) if learner.trainer.body is None else learner.trainer.body.zero
    )
    if offsets := offset_text(robot, zero):
        print(f'estimated joint-sensor offsets: {offsets}')
    for path, pairs in recordings.items():
        kind = 'held out' if path in args.hold_out else 'learned from'
        unit, after = robot.units.distance_unit, error(learner.mae, pairs)
        change = f'{before[path]:.4f} → {after:.4f} {unit}'
        note = 'before → after learning; reference: the recorded joint sensors'
        if offsets:
            corrected = error(learner.mae, pairs._replace(theta=pairs.theta - zero))
            note += f'; after learning without their estimated offsets: {corrected:.4f} {unit}'
        print(f'{path} ({kind}): joint-angle error {change} ({note})')
        if path not in args.hold_out:
            continue
        learned = np.array([sample.theta for sample in learner.samples.all()])
        if warning := repetition(robot, pairs.theta, learned):
            warnings.append(f'{path} (held out): {warning}')
        with ProgressBar(f'looking for anomalies in {path}', len(pairs.time)) as bar:
            warning = anomaly_in(robot, pairs, learner.mae, args.preset, bar.add)
        if warning:
            warnings.append(f'{path} (held out): {warning}')
    print(f'checkpoint: {args.out}')
    sys.stdout.flush()
    _warn(warnings)


def _initial_network(robot: Robot, args: Namespace) -> Mae:
    """Return the network to start from.

    This is the network of `--checkpoint`. Without this option, it is the one that `bringup.sh`
    starts from too. It comes from the cache of initial networks, and is trained if it is not there.
    """
    if args.checkpoint:
        return checkpoint.load(args.checkpoint, robot)
    name = robot.description.directory.name
    if args.seed != DEFAULT_SEED or args.quick:  # the cache contains complete networks of one seed
        print(f'training the initial network of {name}; --checkpoint FILE skips this', flush=True)
        return train_on_model(robot, args).mae
    file = network_file(robot.description.directory, args.preset)
    if file.exists():
        try:
            mae = checkpoint.load(file, robot)
        except CheckpointError as error:
            _warn([f'the cached initial network is unusable and will be trained again: {error}'])
        else:
            print(f'initial network of {name} from the cache of bringup.sh: {file}', flush=True)
            return mae
    print(f'training the initial network of {name} (once; cached in {file})', flush=True)
    mae = train_on_model(robot, args).mae
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        checkpoint.save(mae, file)
    except OSError as error:
        _warn([f'the initial network was not cached: {error}'])
    return mae


def _learn_and_show(learner: Learner, path: Path, recording: Pairs) -> str:
    """Learn from a recording and show the progress; return a warning, or ''."""
    total = float(_without_pauses(np.diff(recording.time)).sum())

    def learned() -> str:
        return f'{len(learner.samples)} samples, {learner.updates} updates'

    with ProgressBar(f'learning from {path}', total, learned) as bar:
        bar.announce(f', a recording of {total:.0f} s')
        return learn(learner, recording, bar.add)


def _without_pauses(steps: ArrayLike) -> Array:
    """Return the times between messages [s], in which a pause of the recording counts little."""
    return np.minimum(steps, LONGEST_PAUSE / 1e9)


def _nothing_learned(learner: Learner) -> str:
    """Return why no update took place, and what to record instead."""
    return (
        'nothing was learned (0 updates). Different resting postures in the recordings: '
        f'{len(learner.samples)}; learning begins with {learner.scheduler.least_samples}. '
        'Record some minutes in which the healthy arm moves from posture to posture and rests in '
        f'each for at least {REST_TIME:g} s, as with controller/explore'
    )


def offset_text(robot: Robot, zero: Array) -> str:
    """Return a text with the joint-sensor offsets that are large enough to show, by joint.

    Args:
        robot: The geometric model.
        zero: Offset of each joint sensor [rad], (D,).
    """
    shown = np.flatnonzero(np.abs(zero) >= LEAST_OFFSET)
    each = ((robot.joints[j], robot.units[j].position_text(zero[j], '.4f')) for j in shown)
    return ', '.join(f'{name} {offset}' for name, offset in each)


def _keep(learner: Learner, args: Namespace) -> str:
    """Save the network of an interrupted run beside `--out`; return a sentence that says so.

    The file of `--out` does not change: it may have the network of an earlier, complete run.
    """
    if args.checkpoint and not learner.updates:
        return f'nothing was learned yet, and {args.out} was not written'
    file = args.out.with_name(f'{args.out.stem}.interrupted{args.out.suffix}')
    with STOP.reacting(Reaction.REMEMBER):  # a second Ctrl-C must not lose the network
        checkpoint.save(learner.mae, file)
    return (
        f'{file} has the network learned so far ({len(learner.samples)} samples, {learner.updates} '
        f'updates); --checkpoint continues from it. {args.out} was not written'
    )


def _warn(warnings: list[str]) -> None:
    for warning in warnings:
        print(f'warning: {warning}', file=sys.stderr)


def repetition(robot: Robot, theta: Array, learned: Array) -> str:
    """Return a warning if a held-out recording repeats the postures that were learned, or ''.

    Its error is then no measure of the error in new postures. Postures of a single joint are not
    judged, because they lie close together.

    Args:
        robot: The geometric model.
        theta: Postures of the recording [rad], (N, D), with NaN for unknown joint angles.
        learned: Learned postures [rad], (S, D), likewise.
    """
    known = np.isfinite(theta).all(axis=1), np.isfinite(learned).all(axis=1)
    theta, learned = theta[known[0]], learned[known[1]]
    if robot.joint_count < 2 or not len(theta) or not len(learned):
        return ''
    distance, _ = KDTree(learned).query(theta)
    share = float(np.mean(distance < REPEATED))
    if share <= REPEATED_SHARE:
        return ''
    return (
        f'{share:.0%} of its postures were learned from the other recordings, so the error in new '
        'postures may be larger. Hold out a recording with other postures, for example of an '
        'exploration with another seed: ./bringup.sh -p controller:seed:=1'
    )


def anomaly_in(
    robot: Robot,
    recording: Pairs,
    mae: Mae,
    preset: str,
    progress: Callable[[], None] = lambda: None,
) -> str:
    """Return a warning about the first anomaly in a recording; '' if there is none.

    The warning also states the error of the estimate before the anomaly. An estimator detects the
    anomaly with the learned network, as on a running arm. `progress` is called after each message.
    """
    estimator = Estimator(robot, preset)
    estimator.use(mae)
    for row, at in enumerate(recording.time):
        isolated = _isolated(recording.isolated[row], mae.isolated)
        if isolated != estimator.body.isolated:
            estimator.isolate(isolated)
        reading = muscle_reading(
            robot, length=recording.length[row], tension=recording.tension[row]
        )
        with suppress(RejectionError):
            estimator.take(reading, at, at)
        progress()
        finding = estimator.suspects.finding
        if finding is None:
            continue
        muscle = robot.muscles[finding.muscle]
        text = f'an anomaly ({muscle}: {finding.kind.identifier}) begins {at:.1f} s after the start'
        if row:
            before = error(mae, recording.first(row))
            text += f'; until then the error is {before:.4f} {robot.units.distance_unit}'
        return f'{text}. Hold out a healthy recording'
    return ''


def read(path: Path, robot: Robot, namespace: str | None = None) -> Pairs:
    """Return the paired messages of a bag, and print progress, and warnings about unused messages.

    Args:
        path: The bag.
        robot: The recorded robot.
        namespace: The namespace of the arm; required only if the bag has several.

    Raises:
        BagError: If the bag is unusable or has no pair of simultaneous messages.
    """
    with ProgressBar(f'reading {path}') as bar:
        bar.announce()
        bag = Bag.open(path)
        streams = read_streams(bag, robot, namespace, bar.add)
    for reason in bag.unfinished:
        print(f'warning: {path} is unfinished: {reason}', file=sys.stderr)
    for reason, count in streams.rejected.items():
        print(f'warning: {path}: {count} messages were rejected: {reason}', file=sys.stderr)
    for note in streams.notes:
        print(f'warning: {path}: {note}', file=sys.stderr)
    if streams.judged_joints.text:
        print(f'warning: {path}: {streams.judged_joints.advice}', file=sys.stderr)
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

    This function plays the part of the estimator node: it validates the networks, and an estimator
    decides when learning has to stop. `progress` is called with the recorded seconds since its last
    call.

    Returns:
        A warning if learning stopped before the end of the recording, or ''.
    """
    estimator = Estimator(learner.robot, learner.trainer.preset.name)
    validator = CheckpointValidator(learner.robot)
    newest, stop = None, ''
    learner.reset()
    learner.use_body(learner.body.with_anomaly(Anomaly.NONE))
    steps = np.diff(recording.time, prepend=recording.time[:1])
    for dt, at, theta, length, tension, recorded in zip(steps, *recording, strict=True):
        isolated = _isolated(recorded, learner.isolated)
        if isolated != estimator.body.isolated:
            learner.use_body(learner.body.with_isolated(isolated))
            estimator.isolate(isolated)
            validator.isolated = isolated
            validator.forget()
        if learner.mae is not newest:
            _decide(validator, estimator, learner, at)
            newest = learner.mae
        reading = muscle_reading(learner.robot, length=length, tension=tension)
        learner.joints(at, theta)
        with suppress(RejectionError):  # the learner counts it
            output = estimator.take(reading, at, at)
            assert output is not None
            sample = output.sample
            validator.message(sample.tension_read, sample.length, sample.sliding, at, theta)
        finding = estimator.suspects.finding
        if finding is not None and not stop:
            learner.use_body(learner.body.with_anomaly(Anomaly.FOUND, finding.muscle))
            if (before := validator.anomaly(True, at)) is not None:
                learner.note_accepted(estimator.use(before))
                learner.note_rejected(newest.version, 'an anomaly was detected soon after')
            stop = (
                f'learning stopped {at:.1f} s after the start: an anomaly begins there '
                f'({learner.robot.muscles[finding.muscle]}: {finding.kind.identifier})'
            )
        with suppress(RejectionError):
            learner.take(reading, at)
        learner.poll(at)
        if progress is not None:
            progress(float(_without_pauses(dt)))
    if learner.mae is not newest:
        _decide(validator, estimator, learner, at)
    return stop


def _decide(
    validator: CheckpointValidator, estimator: Estimator, learner: Learner, now: float
) -> None:
    """Decide on the learner's newest network, tell the learner, and use the network if accepted."""
    mae = learner.mae
    if validator.is_in_use(mae):
        return
    try:
        validator.check(mae)
    except GateError as error:
        learner.note_rejected(mae.version, str(error))
        if estimator.mae is None:
            estimator.use(mae)
    else:
        mae = estimator.use(mae)
        validator.take(mae, now)
        learner.note_accepted(mae)


def error(mae: Mae, recording: Pairs) -> float:
    """Return the mean of ‖θ_est − θ‖₂ [rad] over all messages with θ, for joints with sensors."""
    is_known = np.isfinite(recording.theta).any(axis=1)
    tension = mae.transmission.end(recording.tension, directions(recording.length))
    estimate = np.empty_like(recording.theta)
    for isolated in np.unique(recording.isolated, axis=0):
        rows = (recording.isolated == isolated).all(axis=1)
        without = mae.without(_isolated(isolated, mae.isolated))
        estimate[rows] = without.estimate(tension[rows], recording.length[rows]).theta
    errors = np.linalg.norm(np.nan_to_num(estimate - recording.theta), axis=1)
    return float(errors[is_known].mean())


def _isolated(row: Ints, default: tuple[int, ...]) -> tuple[int, ...]:
    """Return the indices of the isolated muscles; `default` if they were not recorded.

    `row` is a row of `Pairs.isolated`: 1 for an isolated muscle, 0 for others, negative if unknown.
    """
    return default if (row < 0).any() else tuple(map(int, np.flatnonzero(row)))
