# SPDX-License-Identifier: Apache-2.0
"""The streams of a recording as arrays, by the rules of validity: what offline training reads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.selection import interface_topics
from musculoskeletal_ae.exceptions import BagError, MessageError
from musculoskeletal_ae.messages import QUANTITIES, read_array, read_posture
from musculoskeletal_ae.robot.robot import Robot

# A source time that lies further back than this is another publisher's clock, not a reordering.
_REORDERING = 1_000_000_000  # [ns]


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
        """Pair each (T, l) with the nearest θ, if that is within half a period.

        Args:
            period: Of muscle_states [s]; None for the median one of the recording.
        """
        time, joint_time = self.muscles.time, self.joints.time
        if period is None:
            period = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        if not len(joint_time):
            found = nearest = np.zeros(0, dtype=int)
        else:
            right = np.searchsorted(joint_time, time).clip(0, len(joint_time) - 1)
            left = (right - 1).clip(0)
            closer_left = np.abs(time - joint_time[left]) <= np.abs(time - joint_time[right])
            nearest = np.where(closer_left, left, right)
            found = np.flatnonzero(np.abs(time - joint_time[nearest]) <= period / 2)
        chosen = self.muscles.values[found]
        theta = self.joints.values[nearest[found]]
        return Pairs(time[found], theta, chosen[:, 0], chosen[:, 1])


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
    topics = interface_topics(bag, namespace)
    rejected: Counter[str] = Counter()

    def series(topic: str, shape: tuple[int, ...], read: Callable[[Any], Array]) -> Series:
        return _series(bag, topics.get(topic), shape, read, rejected)

    return Streams(
        series(joint_topic, (robot.joint_count,), lambda m: read_posture(m, robot.joints)),
        series('muscle_states', (3, muscles), lambda m: read_array(m, len(QUANTITIES), muscles)),
        series('muscle_length_command', (muscles,), lambda m: read_array(m, 1, muscles)),
        series('muscle_tension_command', (muscles,), lambda m: read_array(m, 1, muscles)),
        rejected,
    )


def _series(
    bag: Bag,
    topic: str | None,
    shape: tuple[int, ...],
    read: Callable[[Any], Array],
    rejected: Counter[str],
) -> Series:
    times: list[float] = []
    values: list[Array] = []
    last_source, why = 0, ''
    for message in bag.messages([topic]) if topic else ():
        # As nodes do: of messages that come twice or late, the later ones are dropped.
        if 0 <= last_source - message.publish_time < _REORDERING and message.publish_time:
            rejected[f'{topic}: repeated or reordered'] += 1
            continue
        last_source = message.publish_time
        try:
            values.append(read(bag.decode(message)))
            times.append((message.log_time - bag.start) / 1e9)
        except MessageError as error:
            rejected[f'{topic}: {error.reason}'] += 1
            why = str(error)
    if why and not values:
        problem = f'no message of {topic} fits the robot ({why})'
        raise BagError(bag.path, None, problem, 'choose the robot it was recorded from')
    return Series(np.array(times), np.array(values).reshape(len(values), *shape))
