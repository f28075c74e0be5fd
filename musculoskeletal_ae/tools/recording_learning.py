# SPDX-License-Identifier: Apache-2.0
"""`train --from-bag` and `--from-csv`: learns from recordings, and reports the errors."""

import sys
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.recorded_faults import find_faults
from musculoskeletal_ae.bags.streams import CHECK_DRIVER, Pairs, read_streams
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.estimation.network_validation.validator import CheckpointValidator
from musculoskeletal_ae.exceptions import (
    BagError,
    CheckpointError,
    GateError,
    MusculoskeletalError,
)
from musculoskeletal_ae.learning.convergence import MOST_UPDATES, is_falling
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.recordings import (
    LEAST_RESTS,
    collect,
    complete,
    count_postures,
    errors,
    isolated_in,
    table_errors,
    unchanged,
    work,
)
from musculoskeletal_ae.learning.rest import REST_TIME
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import DEFAULT_SEED
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.process_signals import STOP, Reaction
from musculoskeletal_ae.progress_bar import ProgressBar
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_states import MuscleReadings, possible_readings
from musculoskeletal_ae.signals.muscle_stream import RejectionError
from musculoskeletal_ae.signals.reading_limits import LIMITS
from musculoskeletal_ae.tables.columns import UNITS, Column
from musculoskeletal_ae.tables.csv_file import looks_like_a_sequence, read_csv
from musculoskeletal_ae.tables.table import Table, TableError
from musculoskeletal_ae.tools.model_training import prepare, train_on_model
from musculoskeletal_ae.tools.network_cache import network_file

LEAST_OFFSET = 0.002  # do not report a smaller joint-sensor offset [rad]
#: Warn that a held-out recording repeats what was learned if more than REPEATED_SHARE of its
#: postures are closer than REPEATED [rad] to a learned one. In two explorations of a neck of two
#: joints, this holds for 70 % of the postures with the same seed, and for 2 % with different seeds.
REPEATED, REPEATED_SHARE = 0.03, 0.25
#: refuse a table with a larger length zero than this [m], unless --estimate-zeros is given; on five
#: emulated arms, lengths differ from the geometric model by up to 15 mm
LARGEST_ZERO = 0.03
#: refuse a table if more than this share of the values of a joint or muscle is impossible
MOST_IMPOSSIBLE = 0.5


class TableSource(NamedTuple):
    """A recording or a part of one, to learn from or to measure the error on."""

    name: str
    table: Table
    is_held_out: bool

    @property
    def use(self) -> str:
        """Text for users that says whether the recording is held out or learned from."""
        return 'held out' if self.is_held_out else 'learned from'


def train(args: Namespace) -> None:
    """Train on recordings in order; print the errors on them and on held-out recordings."""
    robot = prepare(args)
    # Read all recordings first, because training takes minutes and one may be unusable.
    sources = _csv_sources(robot, args) if args.from_csv else _bag_sources(robot, args)
    warnings = list(_warnings(robot, sources, bool(args.from_csv)))
    _warn(warnings)  # also before the training, because the user may want to stop here
    at_rest = any(source.table.at_rest for source in sources)
    from_motion = not at_rest and _learns_from_motion(robot, sources, args.preset)
    mae = _initial_network(robot, args)
    CheckpointValidator(robot).check(mae)
    learner = Learner(robot, mae, args.preset, args.seed, from_motion=from_motion)
    # Where a recording does not say which muscles were isolated, assume those of this network.
    learner.use_body(learner.body.with_isolated(mae.isolated))
    before = [table_errors(mae, source.table) for source in sources]
    try:
        for source in sources:
            if source.is_held_out:
                continue
            if stop := _collect_and_show(learner, source):
                warnings.append(f'{source.name}: {stop}')
        if warning := _complete_and_show(learner):
            warnings.append(warning)
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt(_keep(learner, args)) from interrupt
    for reason, count in learner.collector.rejected.items():
        if at_rest:
            warnings.append(f'{count} rows were not learned: {reason}')
    if why := _nothing_learned(learner, at_rest):
        _warn(warnings)
        raise MusculoskeletalError(f'{why}; {args.out} was not written')
    if learner.impossible_offsets:
        warnings.append(unchanged(learner))
    checkpoint.save(learner.mae, args.out)  # first, so that no later error loses the training
    print(_learned(learner))
    zero = (
        np.zeros(robot.joint_count) if learner.trainer.body is None else learner.trainer.body.zero
    )
    if offsets := offset_text(robot, zero):
        print(f'estimated joint-sensor offsets: {offsets}')
    learned = np.array([sample.theta for sample in learner.samples.samples])
    for source, earlier in zip(sources, before, strict=True):
        off = table_errors(learner.mae, source.table)
        change = f'{robot.units.error_text(earlier)} → {robot.units.error_text(off)}'
        note = 'before → after learning; reference: the recorded joint sensors'
        if offsets:
            corrected = robot.units.error_text(off + zero)
            note += f'; after learning without their estimated offsets: {corrected}'
        if source.is_held_out:
            guess = robot.units.error_text(np.nanmean(learned, axis=0) - source.table.rows.theta)
            note += f'; always estimating the mean learned posture: {guess}'
        print(f'{source.name} ({source.use}): joint-angle error {change} ({note})')
        if not source.is_held_out:
            continue
        if warning := repetition(robot, source.table.rows.theta, learned):
            warnings.append(f'{source.name} (held out): {warning}')
        anomalies = _anomalies(robot, source, learner.mae, args.preset)
        warnings += [f'{source.name} (held out): {text}' for text in anomalies]
    try:
        CheckpointValidator(robot).check(learner.mae)
    except GateError as refused:
        warnings.append(f'the nodes would reject this network: {refused}')
    print(f'checkpoint: {args.out}')
    sys.stdout.flush()
    _warn(warnings)


def _bag_sources(robot: Robot, args: Namespace) -> list[TableSource]:
    return [
        TableSource(str(path), Table.of_pairs(read(path, robot, args.from_namespace)), is_held_out)
        for paths, is_held_out in ((args.from_bag, False), (args.hold_out, True))
        for path in paths
    ]


def _csv_sources(robot: Robot, args: Namespace) -> list[TableSource]:
    """Read the CSV files, hold out a part of them, and subtract the zeros of their lengths.

    Raises:
        TableError: If a file is unusable, or if the files or their values do not fit together.
    """
    sources = []
    for paths, is_held_out in ((args.from_csv, False), (args.hold_out, True)):
        for path in paths:
            table, columns = read_csv(path, robot, args.columns, args.units, args.rate)
            print(f'{path}: {_table_text(table, columns)}', flush=True)
            for reason, count in table.left_out.items():
                _warn([f'{path}: {count} rows were left out: {reason}'])
            if looks_like_a_sequence(table):
                text = (
                    'each row is used as a resting posture, but successive rows are close to each '
                    'other. If they are readings of a moving arm, name the column of their times '
                    'with --columns time=HEADER, or add --rate HZ'
                )
                _warn([f'{path}: {text}'])
            if is_held_out or args.hold_out:
                sources.append(TableSource(str(path), table, is_held_out))
                continue
            try:
                learned, held_out = table.split()
            except TableError as error:
                raise TableError(f'{path}: {error}') from error
            sources.append(TableSource(f'{path}, {len(learned)} rows', learned, False))
            sources.append(TableSource(f'{path}, {len(held_out)} rows', held_out, True))
    if len({source.table.at_rest for source in sources}) > 1:
        raise TableError(
            'some files have times and others do not; learn from each kind in a run of its own, '
            'and pass the network of the first run to the second with --checkpoint'
        )
    zeros = _zeros(robot, sources, args.estimate_zeros)
    shifted = [source._replace(table=source.table.without_zeros(zeros)) for source in sources]
    for source in shifted:
        _check_range(robot, source)
    return shifted


def _table_text(table: Table, columns: tuple[Column, ...]) -> str:
    time = table.rows.time
    what = 'resting postures' if table.at_rest else f'readings in {np.ptp(time):.1f} s'
    units = dict.fromkeys((c.key.kind, c.unit or next(iter(UNITS[c.key.kind]))) for c in columns)
    return f'{len(table)} {what}; ' + ', '.join(f'{kind.value} in {unit}' for kind, unit in units)


def _zeros(robot: Robot, sources: list[TableSource], estimate: bool) -> Array:
    """Return the length zeros [m] (M,), estimated from the learned tables if `estimate`, else 0.

    Raises:
        TableError: If a length has a large zero, but zeros are not to be estimated.
    """
    learned = [source.table.rows for source in sources if not source.is_held_out]
    joined = Table.of_pairs(Pairs(*map(np.concatenate, zip(*learned, strict=True))))
    if estimate:
        zeros = joined.length_zeros(robot)
        each = ', '.join(f'{name} {1e3 * zero:.1f}' for name, zero in zip(robot.muscles, zeros))
        print(f'estimated length zeros [mm], which were subtracted: {each}', flush=True)
        return zeros
    if np.isfinite(joined.rows.theta).all(axis=1).any():
        zeros = joined.length_zeros(robot)
        worst = int(np.abs(zeros).argmax())
        if abs(zeros[worst]) > LARGEST_ZERO:
            raise TableError(
                f'the lengths of {robot.muscles[worst]} differ by {1e3 * zeros[worst]:.0f} mm from '
                'those of the model at the same joint positions (median); legal: up to '
                f'{1e3 * LARGEST_ZERO:.0f} mm. Lengths must be relative to those at θ = 0, and '
                'grow as the muscle gets longer. If their zeros are unknown, add --estimate-zeros; '
                'if they are in another unit, or motor angles, add --units length=UNIT'
            )
    return np.zeros(robot.muscle_count)


def _check_range(robot: Robot, source: TableSource) -> None:
    """Check whether most values of a joint or muscle are possible; otherwise raise a TableError."""
    rows = source.table.rows
    margin = LIMITS.joint_outside * (robot.upper - robot.lower)
    low, high = possible_readings(robot)
    for what, names, values, lowest, highest in (
        ('positions', robot.joints, rows.theta, robot.lower - margin, robot.upper + margin),
        ('lengths', robot.muscles, rows.length, low.length, high.length),
        ('tensions', robot.muscles, rows.tension, low.tension, high.tension),
    ):
        share = np.mean((values < lowest) | (values > highest), axis=0)
        worst = int(share.argmax())
        if share[worst] <= MOST_IMPOSSIBLE:
            continue
        scale, unit = {'lengths': (1.0, 'm'), 'tensions': (1.0, 'N')}.get(
            what, (robot.units[worst].radian, robot.units[worst].position)
        )
        reached = ' to '.join(f'{scale * f(values[:, worst]):.3g}' for f in (np.nanmin, np.nanmax))
        legal = f'{scale * lowest[worst]:.3g} to {scale * highest[worst]:.3g} {unit}'
        raise TableError(
            f'{source.name}: the {what} of {names[worst]} are {reached} {unit}; possible: {legal}. '
            'State their unit with --units, choose other columns with --columns, or correct the '
            'robot directory'
        )


def _warnings(robot: Robot, sources: list[TableSource], is_csv: bool) -> Iterator[str]:
    """Yield warnings about the joint sensors and the columns of muscles."""
    if is_csv:
        remedy = (
            '. Correct the columns with --columns, and signs with a negative number as unit: '
            '--units length=-1'
        )
    else:
        remedy = f'; {CHECK_DRIVER}'
    for source in sources:
        wiring, texts = find_faults(robot, source.table.rows, source.table.at_rest)
        for text in texts:
            yield f'{source.name}: {text}'
        if wiring.faulty:
            yield f'{source.name}: {wiring.text(robot.muscles)}{remedy}'


def _initial_network(robot: Robot, args: Namespace) -> Mae:
    """Return the network to start from.

    This is the network of `--checkpoint`. Without this option, it is the initial network that
    `bringup.sh` also uses: from the cache, or trained and cached if it is missing there. With
    another seed or with `--quick`, a network is trained and not cached.
    """
    if args.checkpoint:
        return checkpoint.load(args.checkpoint, robot)
    name = robot.description.directory.name
    if args.seed != DEFAULT_SEED or args.quick:  # the cache contains complete networks of one seed
        print(f'training the initial network of {name}; --checkpoint FILE skips this', flush=True)
        return train_on_model(robot, args)[0]
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
    mae = train_on_model(robot, args)[0]
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        checkpoint.save(mae, file)
    except OSError as error:
        _warn([f'the initial network was not cached: {error}'])
    return mae


def _learns_from_motion(robot: Robot, sources: list[TableSource], preset: str) -> bool:
    """Return whether to learn from slow moments of a motion, because there are too few rests.

    Raises:
        MusculoskeletalError: If there are too few of both, before anything is trained.
    """
    least = preset_named(preset).least_samples
    wanted = max(LEAST_RESTS, least)
    rests = _count(robot, sources, wanted, from_motion=False)
    if rests >= wanted:
        return False
    moments = _count(robot, sources, wanted, from_motion=True)
    if least <= rests >= moments:
        return False
    few = f'the recordings have {rests} different resting postures'
    if moments >= least:
        text = (
            f'{few}, fewer than {wanted}. The slowest moment of each second is learned instead. If '
            'joints and muscles are not measured at the same time, fast motion makes the error '
            f'larger; an arm that rests in each posture for {REST_TIME:g} s avoids this'
        )
        _warn([text])
        return True
    raise MusculoskeletalError(
        f'nothing can be learned: {few} and {moments} different slow moments; preset {preset} '
        f'learns from at least {least}. Record some minutes in which the healthy arm moves from '
        'posture to posture, as with controller/explore'
    )


def _count(robot: Robot, sources: list[TableSource], enough: int, *, from_motion: bool) -> int:
    """Count how many postures would be learned, up to `enough`.

    They are resting postures, or slow moments of a motion if `from_motion`.
    """
    count = 0
    learned = [source for source in sources if not source.is_held_out]
    what = 'slow moments' if from_motion else 'resting postures'
    with ProgressBar(f'counting {what}', sum(len(source.table) for source in learned)) as bar:
        for segment in (each for source in learned for each in source.table.segments()):
            left = enough - count
            if left > 0:
                count += count_postures(
                    robot, segment, bar.add, from_motion=from_motion, enough=left
                )
    return count


def _collect_and_show(learner: Learner, source: TableSource) -> str:
    """Collect the samples of a recording and show the progress; return a warning, or ''."""
    total = work(source.table)
    with ProgressBar(f'learning from {source.name}', total, lambda: _learned(learner)) as bar:
        what = f'{len(source.table)} postures' if source.table.at_rest else f'{total:.0f} s'
        bar.announce(f', a recording of {what}')
        return collect(learner, source.table, bar.add)


def _complete_and_show(learner: Learner) -> str:
    """Make updates until they have converged, and show the progress; return a warning, or ''."""
    title = 'training the network on the learned body'
    with ProgressBar(title, MOST_UPDATES, lambda: _learned(learner), ends_early=True) as bar:
        bar.announce(f' until its error stops falling, in at most {MOST_UPDATES} updates')
        errors = complete(learner, bar.add)
    if len(errors) < MOST_UPDATES or not is_falling(errors):
        return ''
    return (
        f'after {MOST_UPDATES} updates, the network still comes closer to the learned body; to '
        'continue, repeat the command with the written network as --checkpoint'
    )


def _learned(learner: Learner) -> str:
    return f'{len(learner.samples)} samples, {learner.updates} updates'


def _nothing_learned(learner: Learner, at_rest: bool) -> str:
    """Return why no update changed the network, and what to do; '' if one did.

    `at_rest` says whether the recording consists of resting postures only.
    """
    last = learner.last_update
    if learner.updates > learner.refused and not (last and last.unchanged):
        return ''
    why = f'nothing was learned ({learner.updates} updates): {unchanged(learner)}'
    if learner.impossible_offsets:
        return why
    rest = '' if at_rest else f' and rests in each for at least {REST_TIME:g} s'
    return (
        f'{why}. Record some minutes in which the healthy arm moves from posture to posture{rest}, '
        'as with controller/explore'
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
    """Keep the network of an interrupted run beside `--out`; return a sentence that says so.

    The file of `--out` does not change: it may have the network of an earlier, complete run.
    """
    if args.checkpoint and learner.updates == learner.refused:
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

    The error on such a recording is no measure of the error in new postures. Postures of a single
    joint are not judged, because they lie close together.

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


def _anomalies(robot: Robot, source: TableSource, mae: Mae, preset: str) -> Iterator[str]:
    """Yield a warning for each segment of a recording that has an anomaly (`anomaly_in`)."""
    if source.table.at_rest:  # the detectors need successive readings
        return
    label = f'looking for anomalies in {source.name}'
    with ProgressBar(label, len(source.table)) as bar:
        for segment in source.table.segments():
            if warning := anomaly_in(robot, segment, mae, preset, bar.add):
                yield warning


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
        isolated = isolated_in(recording.isolated[row], mae.isolated)
        if isolated != estimator.body.isolated:
            estimator.isolate(isolated)
        reading = MuscleReadings(length=recording.length[row], tension=recording.tension[row])
        with suppress(RejectionError):
            estimator.take(reading, at, at)
        progress()
        finding = estimator.suspects.finding
        if finding is None:
            continue
        muscle = robot.muscles[finding.muscle]
        text = f'an anomaly ({muscle}: {finding.kind.identifier}) begins {at:.1f} s after the start'
        if row:
            before = robot.units.error_text(errors(mae, recording.at(slice(row))))
            text += f'; until then the error is {before}'
        return f'{text}. Hold out a healthy recording'
    return ''


def read(path: Path, robot: Robot, namespace: str | None = None) -> Pairs:
    """Read the paired messages of a bag; print progress, and warnings about unused messages.

    Args:
        path: Path of the bag.
        robot: The robot that the bag should fit.
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
