# SPDX-License-Identifier: Apache-2.0
"""Learns from recorded readings, and measures the errors of a network on them.

    bag, CSV file or arrays ─► Table ─► collect ─► Learner ─► complete ─► network

Successive readings pass through the learner message by message, as on a running arm. Resting
postures are stored as samples at once. At the end, `complete` makes updates until the network
represents the body that was fitted to all samples (`convergence`).
"""

import math
from collections.abc import Callable
from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.bags.storage import LONGEST_PAUSE
from musculoskeletal_ae.bags.streams import Pairs
from musculoskeletal_ae.body_model.observations import Sample
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.exceptions import CheckpointError
from musculoskeletal_ae.learning.collector import SampleCollector
from musculoskeletal_ae.learning.convergence import STEPS, until_converged
from musculoskeletal_ae.learning.detector_calibration import Reservoir
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.learning.scheduler import LEAST_INTERVAL, Update
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import Anomaly
from musculoskeletal_ae.signals.friction import directions
from musculoskeletal_ae.signals.joint_stream import JointStream
from musculoskeletal_ae.signals.muscle_states import MuscleReadings
from musculoskeletal_ae.signals.muscle_stream import MuscleStream, RejectionError
from musculoskeletal_ae.tables.table import Table

#: learn from slow moments of the motion if a recording has fewer different resting postures
LEAST_RESTS = 20


def learn_table(
    learner: Learner, table: Table, progress: Callable[[float], None] | None = None
) -> str:
    """Learn from a table: collect its samples, and make updates until the network has converged.

    To learn from several tables, `collect` them first, and `complete` the network once.

    Args:
        learner: The learner; its updates must run in this process.
        table: The table.
        progress: Called with the seconds or rows, and later the updates, since its last call.

    Returns:
        A warning for users if learning stopped before the end of the table, or has learned nothing;
        '' otherwise.
    """
    stop = collect(learner, table, progress)
    complete(learner, progress)
    return stop or unchanged(learner)


def collect(learner: Learner, table: Table, progress: Callable[[float], None] | None = None) -> str:
    """Collect the samples of a table; successive readings also cause updates, as on a running arm.

    `progress` is called with the seconds or rows since its last call (`work`).

    Returns:
        A warning if learning stopped before the end of the table, or ''.
    """
    if table.at_rest:
        collect_rests(learner, table.rows, progress)
        return ''
    for segment in table.segments():
        if stop := learn(learner, segment, progress):
            return stop
    return ''


def complete(learner: Learner, progress: Callable[[float], None] | None = None) -> list[float]:
    """Make updates until the network represents the body that was fitted to all samples.

    Nothing happens if there are too few samples.

    Args:
        learner: The learner; its updates must run in this process.
        progress: Called with 1 after each update.

    Returns:
        The error on synthetic samples after each update (`until_converged`) [rad].
    """
    learner.use_body(learner.body.with_anomaly(Anomaly.NONE))
    now = 0.0  # the caller's clock was that of the recording; a new one begins here

    def make_update() -> Update | None:
        nonlocal now
        before = learner.updates
        now += LEAST_INTERVAL
        learner.scheduler.note_news()
        learner.poll(now, STEPS)
        return None if learner.updates == before else learner.last_update

    errors = list[float]()
    for _, error in until_converged(make_update, lambda: learner.trainer.body):
        errors.append(error)
        if progress is not None:
            progress(1.0)
    return errors


def unchanged(learner: Learner) -> str:
    """Return why the last update changed no network, as a text for users; '' if it changed one."""
    if offsets := learner.impossible_offsets:
        each = ', '.join(f'{joint} ({text})' for joint, text in offsets.items())
        return (
            f'{learner.refused} of {learner.updates} updates were refused, because they found '
            f'offsets that no joint sensor has: {each}. State the positions of these joints with '
            'the zero, the sign and the unit of robot.urdf, or correct robot.urdf; check the '
            'lengths as well'
        )
    if learner.last_update is not None:
        return learner.last_update.unchanged
    return (
        f'{len(learner.samples)} different resting postures, and preset '
        f'{learner.trainer.preset.name} learns from at least {learner.scheduler.least_samples}'
    )


def count_postures(
    robot: Robot,
    recording: Pairs,
    progress: Callable[[], None] = lambda: None,
    *,
    from_motion: bool = False,
    enough: float = math.inf,
) -> int:
    """Count the different postures that a learner would learn from a recording.

    Args:
        robot: The recorded robot.
        recording: Successive readings.
        progress: Called after each reading.
        from_motion: Whether to count slow moments of a moving arm instead of rests.
        enough: Number of postures at which counting ends.
    """
    samples, healthy = SampleStore(), Reservoir(robot.muscle_count)
    collector = SampleCollector(robot, samples, healthy, from_motion=from_motion)
    isolated: tuple[int, ...] = ()
    for time, theta, length, tension, row in zip(*recording, strict=True):
        newest = tuple(np.flatnonzero(row == 1).tolist())
        if newest != isolated:
            isolated = newest
            collector.use_body(collector.body.with_isolated(isolated))
        collector.joints(time, theta)
        paired = None
        with suppress(RejectionError):
            paired = collector.take(time, MuscleReadings(length=length, tension=tension))
        if paired is not None:
            collector.collect(paired)
        progress()
        if samples.accepted >= enough:
            break
    return samples.accepted


def work(table: Table) -> float:
    """Return how much `collect` has to do: recorded seconds, or resting postures."""
    if table.at_rest:
        return len(table)
    return sum(float(without_pauses(np.diff(part.time)).sum()) for part in table.segments())


def without_pauses(steps: ArrayLike) -> Array:
    """Return the times between messages [s], with longer pauses cut to LONGEST_PAUSE."""
    return np.minimum(steps, LONGEST_PAUSE / 1e9)


def collect_rests(
    learner: Learner, rests: Pairs, progress: Callable[[float], None] | None = None
) -> None:
    """Store resting postures as samples.

    Implausible rows are not stored, but counted in `learner.collector.rejected`. The direction in
    which the tendons slid before each rest is unknown. `progress` is called with 1 for each row.
    """
    robot = learner.robot
    muscles, joints = MuscleStream(robot, learner.body), JointStream(robot)
    for row, length, tension in zip(rests.theta, rests.length, rests.tension, strict=True):
        if progress is not None:
            progress(1.0)
        muscles.reset()  # successive rows need not be near to each other
        joints.reset()
        theta = joints.take(0.0, row)
        try:
            reading = MuscleReadings(length=length, tension=tension)
            sample = muscles.take(reading, 0.0).without_isolated()
        except RejectionError as error:
            learner.collector.rejected[error.reason] += 1
            continue
        if np.isnan(theta).all():
            learner.collector.rejected['no plausible joint position'] += 1
            continue
        still = np.zeros(robot.muscle_count)
        learner.accept(Sample(theta, sample.tension_read, sample.length, still))


def learn(
    learner: Learner, recording: Pairs, progress: Callable[[float], None] | None = None
) -> str:
    """Learn from a recording, message by message, as on a running arm.

    An estimator plays the part of its node: it validates the networks, and decides when learning
    has to stop. `progress` is called with the recorded seconds since its last call.

    Returns:
        A warning if learning stopped before the end of the recording, or ''.
    """
    estimator = Estimator(learner.robot, learner.trainer.preset.name)
    networks = estimator.networks
    networks.accepted = learner.note_accepted
    networks.rejected = lambda mae, reason: learner.note_rejected(mae.version, reason)
    newest, stop = None, ''
    learner.reset()
    learner.use_body(learner.body.with_anomaly(Anomaly.NONE))
    steps = np.diff(recording.time, prepend=recording.time[:1])
    for dt, at, theta, length, tension, recorded in zip(steps, *recording, strict=True):
        isolated = isolated_in(recorded, learner.isolated)
        if isolated != estimator.body.isolated:
            learner.use_body(learner.body.with_isolated(isolated))
            estimator.isolate(isolated)
        if learner.mae is not newest:
            _decide(estimator, learner.mae, at)
            newest = learner.mae
        reading = MuscleReadings(length=length, tension=tension)
        learner.joints(at, theta)
        with suppress(RejectionError):  # the learner counts it
            estimator.take(reading, at, at, recorded=theta)
        finding = estimator.suspects.finding
        if finding is not None and not stop:
            learner.use_body(learner.body.with_anomaly(Anomaly.FOUND, finding.muscle))
            stop = (
                f'learning stopped {at:.1f} s after the start: an anomaly begins there '
                f'({learner.robot.muscles[finding.muscle]}: {finding.kind.identifier})'
            )
        with suppress(RejectionError):
            learner.take(reading, at)
        learner.poll(at)
        if progress is not None:
            progress(float(without_pauses(dt)))
    if learner.mae is not newest:
        _decide(estimator, learner.mae, at)
    return stop


def _decide(estimator: Estimator, mae: Mae, now: float) -> None:
    """Let the estimator decide on a network; without any, it uses even one that is rejected."""
    with suppress(CheckpointError):  # `rejected` is called
        for _ in estimator.networks.propose(mae, lambda: now):
            pass
    if estimator.mae is None:
        estimator.use(mae)


def errors(mae: Mae, recording: Pairs, at_rest: bool = False) -> Array:
    """Return the errors θ_est − θ [rad], (N, D); NaN where θ was not measured.

    Args:
        mae: The network.
        recording: The readings.
        at_rest: Whether each row is a resting posture. Such rows do not show how tendons slid.
    """
    sliding = np.zeros_like(recording.length) if at_rest else directions(recording.length)
    tension = mae.transmission.end(recording.tension, sliding)
    estimate = np.empty_like(recording.theta)
    for isolated in np.unique(recording.isolated, axis=0):
        rows = (recording.isolated == isolated).all(axis=1)
        without = mae.without(isolated_in(isolated, mae.isolated))
        estimate[rows] = without.estimate(tension[rows], recording.length[rows]).theta
    difference: Array = estimate - recording.theta
    return difference


def table_errors(mae: Mae, table: Table) -> Array:
    """Return the errors θ_est − θ of a network on all N rows of a table [rad], (N, D).

    NaN marks angles that were not measured.
    """
    return np.concatenate([errors(mae, part, table.at_rest) for part in table.segments()])


def error(mae: Mae, recording: Pairs) -> float:
    """Return the error of a network on a recording: the mean norm of its angle errors [rad].

    Joints without a measured angle are ignored.
    """
    return mean_error(errors(mae, recording))


def mean_error(off: Array) -> float:
    """Return the mean norm of angle errors [rad], (N, D), in which NaN marks unknown ones."""
    is_known = np.isfinite(off).any(axis=1)
    return float(np.linalg.norm(np.nan_to_num(off), axis=1)[is_known].mean())


def isolated_in(row: Ints, default: tuple[int, ...]) -> tuple[int, ...]:
    """Return the indices of the muscles to isolate; `default` if they were not recorded.

    `row` is a row of `Pairs.isolated`: 1 for a muscle that was isolated or suspected of a fault, 0
    for others, negative if unknown.
    """
    return default if (row < 0).any() else tuple(map(int, np.flatnonzero(row)))
