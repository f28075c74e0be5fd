# SPDX-License-Identifier: Apache-2.0
"""Reads the valid messages of a recording as arrays, for offline training."""

import heapq
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.storage import LATEST
from musculoskeletal_ae.bags.timed_messages import TimedMessages
from musculoskeletal_ae.bags.topics import interface_topics
from musculoskeletal_ae.exceptions import BagError, MusculoskeletalError
from musculoskeletal_ae.messages.arrival import Arrival
from musculoskeletal_ae.messages.message_reading import (
    joints_not_finite,
    read_array,
    read_posture,
)
from musculoskeletal_ae.messages.reception import Reception
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.urdf import parse_xml
from musculoskeletal_ae.signals.body_state import ROWS, BodyState
from musculoskeletal_ae.signals.joint_series import JointSeries, judge_series
from musculoskeletal_ae.signals.motor_interface import MotorInterface
from musculoskeletal_ae.signals.muscle_states import QUANTITIES, MuscleReadings, raw_muscle_states
from musculoskeletal_ae.signals.muscle_stream import MuscleStream
from musculoskeletal_ae.signals.pairing import Pairing


class Series(NamedTuple):
    """The times and values of the N valid messages of a topic."""

    time: Array  # times since the bag's start [s], (N,)
    values: Array  # values of the N messages, one row for each


class Pairs(NamedTuple):
    """P pairs, each of a muscle message and of the joint angles at the same time."""

    time: Array  # time since the bag's start [s], (P,)
    theta: Array  # joint angles [rad], (P, D); NaN for joints without a usable reading
    length: Array  # muscle lengths [m], (P, M)
    tension: Array  # tensions [N], (P, M)
    #: 1 for muscles that were isolated or suspected of a fault, 0 for others, -1 if not recorded,
    #: (P, M)
    isolated: Ints

    def at(self, rows: Ints | Bools | slice) -> 'Pairs':
        """Return the pairs in the rows that indices, a mask or a slice select."""
        time, theta, length, tension, isolated = self
        return Pairs(time[rows], theta[rows], length[rows], tension[rows], isolated[rows])


class Streams(NamedTuple):
    """Sensor data of one arm; missing topics are empty series."""

    joints: Series  # usable joint angles [rad], (N, D); NaN where a joint has no usable reading
    muscle_times: Array  # times of the readings of muscle modules since the bag's start [s], (N,)
    muscles: MuscleReadings  # the N readings, with corrected lengths and plausible temperatures
    isolated: Series  # 1 for muscles that are isolated or suspected of a fault, else 0, (N, M)
    rejected: Counter[str]  # rejected messages by topic and reason
    ignored: Counter[str]  # unused parts of messages by topic and part
    notes: tuple[str, ...]  # further remarks for the user
    judged_joints: JointSeries  # which readings of all messages of joint_states are usable
    false_joints: Array  # times of messages of joint_states without a usable reading [s], (F,)

    def pairs(self) -> Pairs:
        """Pair each muscle message with the joint angles at the same time.

        Online learning on the robot pairs messages in the same way (`signals/pairing.py`). Muscle
        messages without matching joint angles are left out, unless false joint angles were
        recorded at the same time: the lengths and tensions are then right nevertheless.
        """
        time = self.muscle_times
        period = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        is_beside = np.zeros(len(time), dtype=bool)
        if len(self.false_joints):
            after = np.searchsorted(self.false_joints, time).clip(1, len(self.false_joints) - 1)
            nearest = np.abs(self.false_joints[np.stack([after - 1, after])] - time).min(axis=0)
            is_beside = nearest <= 0.5 * period
        unknown = np.full(self.joints.values.shape[1], np.nan)
        pairing = Pairing[int](period)
        joints = ((came, 0, row) for row, came in enumerate(self.joints.time))
        # A muscle message at time ∞ makes `Pairing` return the last pair.
        muscles = ((came, 1, row) for row, came in enumerate([*time, math.inf]))
        theta, muscle = [], []  # θ, and the row of the muscle message
        for came, kind, row in heapq.merge(joints, muscles):
            if kind == 0:
                pairing.joints(came, self.joints.values[row])
                continue
            paired = pairing.muscles(came, row if came < math.inf else None)
            if paired is None or (paired.theta is None and not is_beside[paired.message]):
                continue
            theta.append(unknown if paired.theta is None else paired.theta)
            muscle.append(paired.message)
        readings, time = self.muscles.at(muscle), time[muscle]
        length, tension = readings.length, readings.tension
        isolated = np.full(length.shape, -1)
        if len(self.isolated.time):
            isolated[:] = self.isolated.values[_latched(self.isolated.time, time)]
        postures = np.array(theta).reshape(-1, self.joints.values.shape[1])
        return Pairs(time, postures, length, tension, isolated)


@dataclass
class _Stream:
    """Collects the times and values of a topic's messages while the bag is being read."""

    shape: tuple[int, ...]  # shape of the values of one message
    read: Callable[[Any, Arrival], Array]  # converts a message to values
    times: list[float] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)

    def take(self, message: Any, arrival: Arrival) -> None:
        """Convert a decoded message to values and append them; `arrival` says when it arrived."""
        self.values.append(self.read(message, arrival))
        self.times.append(arrival.received_at)

    def series(self) -> Series:
        """Return the times and values of all messages."""
        return Series(np.array(self.times), np.array(self.values).reshape(-1, *self.shape))


class _ArmStreams:
    """The values that the topics of one arm carried, converted from messages to arrays.

    Attributes:
        by_topic: The values of each topic, by relative topic name such as 'joint_states'.
        had_offsets: For each message of muscle_states, whether the length offsets were known when
            it was received.
    """

    def __init__(self, robot: Robot, ignore: Callable[[str], None]) -> None:
        """Prepare empty streams.

        Args:
            robot: The robot, whose joints and muscles the messages must have.
            ignore: Function that is called with a text for each position in joint_states that is
                not finite and therefore not used.
        """
        self._robot, self._ignore = robot, ignore
        self._interface = MotorInterface(robot.description.motors, robot.tension_source)
        self._muscle_stream = MuscleStream(robot)
        self.had_offsets: list[bool] = []
        #: lowest and highest recorded tension of each muscle, (M,) each, if tensions are not used
        self._unused_tension = np.array([np.inf, -np.inf])[:, None] * np.ones(robot.muscle_count)
        muscles = robot.muscle_count
        self._bodies: list[BodyState] = []
        self._body = _Stream((ROWS, muscles), self._body_rows)
        self.by_topic = {
            'joint_states': _Stream((robot.joint_count,), self._posture),
            'muscle_states': _Stream((len(QUANTITIES), muscles), self._muscle_states),
            'body_state': self._body,
        }

    def _posture(self, message: Any, _: Arrival) -> Array:
        theta = read_posture(message, self._robot.units, some=True)
        for name in joints_not_finite(message, self._robot.joints):
            self._ignore(f'position of {name} is not finite')
        return theta

    def _muscle_states(self, message: Any, arrival: Arrival) -> Array:
        stream = self._muscle_stream
        now = arrival.received_at
        stream.use_body(self._body_at(now, stream.body))
        reading = self._interface.reading(message)
        if not self._robot.tension_source.is_known:
            self._note_unused_tension(reading)
        sample = stream.take(reading, now, delay=arrival.delay)
        self.had_offsets.append(stream.body.offsets.known)
        return sample.newest.replace(
            length=sample.length, tension=sample.tension_read, temperature=sample.temperature
        ).rows

    def _note_unused_tension(self, reading: Any) -> None:
        tension = raw_muscle_states(reading, self._robot).tension
        low, high = self._unused_tension
        self._unused_tension[:] = np.fmin(low, tension), np.fmax(high, tension)

    @property
    def tension_note(self) -> str:
        """A remark for the user if recorded tensions are not used, or ''."""
        low, high = self._unused_tension
        if not (high > low).any():
            return ''
        return (
            f'muscle_states has tensions from {low.min():.1f} to {high.max():.1f} N, which are not '
            'used because muscles.yaml says tension_source: none; if they were measured, set '
            'tension_source: sensor'
        )

    def _body_rows(self, message: Any, _: Arrival) -> Array:
        body = BodyState.of_rows(read_array(message, ROWS, self._robot.muscle_count))
        self._bodies.append(body)
        return body.rows

    def isolated(self) -> Series:
        """Return which muscles are isolated or suspected of a fault, as 1, others as 0.

        The series has one row for each recorded body state.
        """
        unreliable = [~body.used | body.suspected for body in self._bodies]
        shape = -1, self._robot.muscle_count
        return Series(np.array(self._body.times), np.array(unreliable, dtype=int).reshape(shape))

    @property
    def finding_notes(self) -> Iterator[str]:
        """A remark for the user on each fault of a muscle that the estimator found."""
        before: Bools = np.zeros(self._robot.muscle_count, dtype=bool)
        for time, body in zip(self._body.times, self._bodies):
            for muscle in np.flatnonzero(body.suspected & ~before).tolist():
                name = self._robot.muscles[muscle]
                yield (
                    f'the estimator found a fault of {name} {time:.1f} s after the start; its '
                    'readings are not used while this fault or its isolation lasts'
                )
            before = body.suspected

    def _body_at(self, time: float, before: BodyState) -> BodyState:
        """Return the body state at a time [s] of the recording; `before` if nothing has changed.

        The first message also applies to the time before it, except for unknown offsets: it was
        published before the bag began, but the recorder received it a little late.
        """
        if not self._bodies:
            return before
        number = int(np.searchsorted(self._body.times, time, side='right'))
        body = self._bodies[max(number - 1, 0)]
        if number == 0 and not body.offsets.known:
            body = body.with_offsets(before.offsets)
        return before if body == before else body


#: suspect the recording of another robot if messages are rejected for one of these reasons
OTHER_ROBOT = 'wrong length', 'missing joint', 'missing motor', 'wrong layout'
CHOOSE_ROBOT = 'choose the robot that was recorded'  # remedy for a reason in OTHER_ROBOT
#: remedy if all messages of a topic are rejected for another reason
CHECK_DRIVER = (
    'if this robot was recorded, correct what the driver publishes (check_driver names the fault), '
    'and record again; otherwise choose the robot that was recorded'
)


def read_streams(
    bag: Bag,
    robot: Robot,
    namespace: str | None = None,
    progress: Callable[[float], None] = lambda _: None,
    stop: int = LATEST,
) -> Streams:
    """Read the sensor data of one arm.

    Muscle states pass through the same `MuscleStream` as on a robot, which rejects and counts
    implausible messages. Each length is corrected by the length offsets of the newest body state
    (topic `body_state`). If the offsets of the first body state are known, they also correct
    earlier lengths. Muscle states that were received while offsets were unknown are rejected.

    False readings of joint sensors are left out (`signals/joint_series.py`).

    An isolated muscle may have any readings. Lengths and tensions of an isolated muscle that are
    not finite or exceed the legal range become 0, and such temperatures become NaN.

    Args:
        bag: The recording.
        robot: The robot, whose joints and muscles the messages must have.
        namespace: The namespace of the arm; required only if the bag has several.
        progress: Called after each message with its share of all messages; all shares add up to 1.
        stop: Latest log time [ns] of the messages to read.

    Raises:
        BagError: If no message of a topic fits the robot, the bag is damaged, `interface_topics`
            raises an error, or the recorded `robot_description` lacks joints of the robot and there
            are no joint angles.
    """
    recorded = interface_topics(bag, namespace, robot.description.motor_topics)
    labels = _labels(recorded)
    warnings = list[str]()
    reception = Reception(warnings.append)
    arm = _ArmStreams(robot, lambda part: reception.ignore(labels['joint_states'], part))
    used = {labels[name]: stream for name, stream in arm.by_topic.items() if name in recorded}
    takers = defaultdict[str, dict[str, Callable[[Any, Arrival], None]]](dict)
    for name, stream in arm.by_topic.items():
        if name in recorded:
            takers[recorded[name]][labels[name]] = stream.take
    messages = TimedMessages(bag, takers, stop)
    # Read body states before all other messages: the recorder may have received a body state only
    # after the first readings to which it applies.
    early = [recorded['body_state']] if 'body_state' in recorded else []
    _deliver(messages, takers, early, reception, progress, stop)
    # A topic of motors that also counts as joint_states need not contain joint angles, because the
    # joints may have no sensors.
    optional = f'{recorded.get("joint_states")} as joint_states'
    _check_fit(bag, {key: each for key, each in used.items() if key != optional}, warnings)
    notes = tuple(filter(None, (messages.note, arm.tension_note, *arm.finding_notes)))
    joints, states = (arm.by_topic[name].series() for name in ('joint_states', 'muscle_states'))
    is_known = np.array(arm.had_offsets, dtype=bool)
    if not is_known.all():
        reason = f'{labels["muscle_states"]}: length offsets unknown'
        reception.rejected[reason] += int((~is_known).sum())
        states = Series(states.time[is_known], states.values[is_known])
    readings = MuscleReadings.of_rows(states.values)
    judged = judge_series(robot, joints.time, joints.values)
    is_usable, times_read = np.isfinite(judged.theta).any(axis=1), joints.time
    joints = Series(joints.time[is_usable], judged.theta[is_usable])
    if not len(joints.time):
        _check_description(bag, recorded.get('robot_description'), robot)
    series = joints, states.time, readings, arm.isolated()
    false = times_read[~is_usable]
    return Streams(*series, reception.rejected, reception.ignored, notes, judged, false)


def described_robot(bag: Bag, topic: str | None) -> tuple[str, list[str]]:
    """Return the name and the movable joints of the URDF in a recording.

    They are '' and [] if the recording has no URDF.

    Args:
        bag: The recording.
        topic: Recorded name of the topic `robot_description`, or None if it was not recorded.
    """
    for message in bag.messages([topic] if topic else []):
        try:
            root = parse_xml(bag.path, bag.decode(message).data)
        except MusculoskeletalError:
            continue
        joints = [
            joint.get('name', '')
            for joint in root.iterfind('joint')
            if joint.get('type') != 'fixed'
        ]
        return root.get('name', ''), joints
    return '', []


def _labels(recorded: Mapping[str, str]) -> dict[str, str]:
    """Return, for each topic of the interface, the name by which reports refer to its messages.

    Usually, this is the recorded name. However, one recorded topic may carry the angles of the
    joints as well as those of the motors, and thus stand for two topics of the interface. Its
    messages are then counted twice, under two names of the form 'RECORDED NAME as INTERFACE NAME'.

    Args:
        recorded: The recorded name of each topic of the interface.
    """
    count = Counter(recorded.values())
    return {
        name: f'{topic} as {name}' if count[topic] > 1 else topic
        for name, topic in recorded.items()
    }


def _deliver(
    messages: TimedMessages,
    takers: Mapping[str, Mapping[str, Callable[[Any, Arrival], None]]],
    early: Sequence[str],
    reception: Reception,
    progress: Callable[[float], None],
    stop: int,
) -> None:
    """Read messages, and pass each one to the functions for its topic.

    The functions receive the decoded message, and an `Arrival` with the times [s], since the start
    of the bag, at which messages of its sender arrived.

    Args:
        messages: The messages to read.
        takers: For each recorded topic, the functions to call, by the name under which `reception`
            counts the messages.
        early: Recorded names of the topics that are read before the other topics.
        reception: Rejects messages for which a function raises a MessageError, and counts them.
        progress: Called after each message with its share of all messages.
        stop: Latest log time [ns] of the messages to read.
    """
    bag = messages.bag
    count = sum(bag.topics[topic].message_count for topic in takers)
    arrivals = defaultdict[tuple[str, ...], Arrival](Arrival)
    for message in chain(
        messages.messages(early, stop=stop), messages.messages(takers.keys() - early, stop=stop)
    ):
        decoded = bag.decode(message)
        # Publishers of different joints on one topic may have different clocks: keep one Arrival
        # for each of them.
        arrival = arrivals[(message.topic, *getattr(decoded, 'name', ()))]
        is_new = arrival.receive((message.log_time - bag.start) / 1e9, message.publish_time)
        for label, take in takers[message.topic].items():
            if is_new:
                reception.deliver(label, take, decoded, arrival)
            else:
                reception.note_repeated(label)
        progress(1.0 / count)


def _check_fit(bag: Bag, used: Mapping[str, _Stream], warnings: Sequence[str]) -> None:
    """Check that no topic has had all its messages rejected.

    Args:
        bag: The recording.
        used: The stream of accepted messages of each topic, by the topic's name in warnings.
        warnings: A text for each reason for which messages of a topic were rejected.

    Raises:
        BagError: If all messages of a topic were rejected.
    """
    for label, stream in used.items():
        reasons = [text.partition(f' {label}: ')[2] for text in warnings if f' {label}: ' in text]
        if reasons and not stream.values:
            problem = f'no message of {label} fits the robot ({reasons[-1]})'
            is_of_shape = reasons[-1].startswith(OTHER_ROBOT)
            raise BagError(bag.path, problem, CHOOSE_ROBOT if is_of_shape else CHECK_DRIVER)


def _check_description(bag: Bag, topic: str | None, robot: Robot) -> None:
    """Check that the URDF in a recording without joint angles has the joints of the robot.

    Otherwise, only the number of muscles would be known to fit. The arguments are as in
    `described_robot`.

    Raises:
        BagError: If the URDF lacks a joint of the robot.
    """
    _, described = described_robot(bag, topic)
    if described and not set(robot.joints) <= set(described):
        problem = f'its robot_description has the joints {", ".join(described)}'
        raise BagError(bag.path, problem, CHOOSE_ROBOT)


def _latched(times: ArrayLike, when: ArrayLike) -> Any:
    """Return the index of the newest message of a latched topic at each time of `when`.

    For times before the first message, the index is 0, because the first message of a latched topic
    may have been published before recording began.
    """
    return np.maximum(np.searchsorted(times, when, side='right') - 1, 0)
