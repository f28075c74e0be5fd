# SPDX-License-Identifier: Apache-2.0
"""The streams of a recording as arrays, by the rules of validity: what offline training reads."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.topics import interface_topics
from musculoskeletal_ae.exceptions import BagError, MessageError
from musculoskeletal_ae.pairing import Paired, Pairing
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.validity import LATE, QUANTITIES, SourceOrder, read_array, read_posture

# A source time that lies further back than this is another publisher's clock, not a reordering.


class Series(NamedTuple):
    """Times [s] since the bag's start, shape (N,), and values, shape (N, …)."""

    time: Array
    values: Array


class Pairs(NamedTuple):
    """θ and (T, l) that belong together: time [s] (P,), θ [rad] (P, D), l [m], T [N] (P, M)."""

    time: Array
    theta: Array
    length: Array
    tension: Array


@dataclass(frozen=True)
class Streams:
    """Valid messages of one arm; a topic that is not in the bag is an empty series.

    Attributes:
        joints: θ [rad], (N, D).
        muscles: Length [m], tension [N], temperature [°C], (N, 3, M).
        length_commands: l_target [m], (N, M).
        tension_commands: T_target [N], (N, M).
        rejected: Messages left out, by topic and reason.
    """

    joints: Series
    muscles: Series
    length_commands: Series
    tension_commands: Series
    rejected: Counter[str]

    def pairs(self, period: float | None = None) -> Pairs:
        """Pair θ and (T, l) as a live learner does (`musculoskeletal_ae.pairing`).

        Args:
            period: Of muscle_states [s]; None for the median one of the recording.
        """
        time = self.muscles.time
        if period is None:
            period = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        pairing = Pairing(period)
        paired: list[Paired | None] = []
        joints = ((came, 0, row) for row, came in enumerate(self.joints.time))
        muscles = ((came, 1, row) for row, came in enumerate(time))
        # A muscle message at the end of time gives out the last one.
        end = [(math.inf, 1, -1)] if len(time) else []
        for came, kind, row in heapq.merge(joints, muscles, end):
            if kind == 0:
                pairing.joints(came, self.joints.values[row])
            else:
                length, tension, _ = self.muscles.values[row]
                paired.append(pairing.muscles(came, tension, length))
        matched = [one for one in paired if one is not None and one.theta is not None]
        shape = -1, self.muscles.values.shape[2]
        return Pairs(
            np.array([one.time for one in matched]),
            np.array([one.theta for one in matched]).reshape(-1, self.joints.values.shape[1]),
            np.array([one.length for one in matched]).reshape(shape),
            np.array([one.tension for one in matched]).reshape(shape),
        )


def read_streams(
    bag: Bag, robot: Robot, joint_topic: str = 'joint_states', namespace: str | None = None
) -> Streams:
    """Read the sensors and commands of one arm.

    Args:
        bag: An opened bag.
        robot: Whose arm it is.
        joint_topic: `joint_states` or `vision_joint_states`.
        namespace: Of the arm, where the bag has several.

    Raises:
        BagError: If no message of a topic fits the robot, or the bag is damaged.
    """
    muscles = robot.muscle_count
    streams = {
        joint_topic: _Stream((robot.joint_count,), lambda m: read_posture(m, robot.joints)),
        'muscle_states': _Stream((3, muscles), lambda m: read_array(m, len(QUANTITIES), muscles)),
        'muscle_length_command': _Stream((muscles,), lambda m: read_array(m, 1, muscles)),
        'muscle_tension_command': _Stream((muscles,), lambda m: read_array(m, 1, muscles)),
    }
    recorded = interface_topics(bag, namespace)
    topics = {recorded[name]: stream for name, stream in streams.items() if name in recorded}
    start, rejected = bag.start, Counter[str]()
    for message in bag.messages(topics):
        topic, stream = message.topic, topics[message.topic]
        if stream.order.is_late(message.publish_time):
            rejected[f'{topic}: {LATE}'] += 1
            continue
        stream.order.take(message.publish_time)
        try:
            stream.values.append(stream.read(bag.decode(message)))
            stream.times.append((message.log_time - start) / 1e9)
        except MessageError as error:
            rejected[f'{topic}: {error.reason}'] += 1
            stream.problem = str(error)
    for topic, stream in topics.items():
        if stream.problem and not stream.values:
            problem = f'no message of {topic} fits the robot ({stream.problem})'
            raise BagError(bag.path, None, problem, 'choose the robot it was recorded from')
    joints, states, lengths, tensions = (stream.series for stream in streams.values())
    return Streams(joints, states, lengths, tensions, rejected)


@dataclass
class _Stream:
    """A topic that is being read: the shape of its values, and what was wrong with the last one."""

    shape: tuple[int, ...]
    read: Callable[[Any], Array]
    order: SourceOrder = field(default_factory=SourceOrder)
    times: list[float] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)
    problem: str = ''

    @property
    def series(self) -> Series:
        return Series(np.array(self.times), np.array(self.values).reshape(-1, *self.shape))
