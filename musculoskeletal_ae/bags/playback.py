# SPDX-License-Identifier: Apache-2.0
"""Playback of a recording: messages to publish, the time line, and demonstrated motions.

While playback is not paused, recorded time advances with the time t of the steady clock:

    recorded(t) = recorded(t₀) + rate · (t − t₀)

t₀ is the time of the last start, jump, pause or resumption. A motion that was demonstrated by hand
becomes a smoothed trajectory, whose points are evenly spaced in time.
"""

import math
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from itertools import chain
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.storage import LONGEST_PAUSE, BagMessage
from musculoskeletal_ae.bags.timed_messages import TimedMessages
from musculoskeletal_ae.bags.topics import latched_topics
from musculoskeletal_ae.exceptions import BagError, MessageError
from musculoskeletal_ae.messages.arrival import SILENCE
from musculoskeletal_ae.messages.message_reading import MOST_ENTRIES, target_values

#: after skipping a pause of the recording, continue this long before the next message, in recorded
#: time [ns]
SKIP_LEAD = 500_000_000

TAUGHT_TOPIC = 'estimated_joint_states'  # read a demonstrated motion from this topic
#: Smooth a demonstrated motion by Gaussian weights of this standard deviation [s]. They keep the
#: motion of a hand, which takes longer than this, and remove noise, which varies faster.
SMOOTHING = 0.15
SPACING = 0.1  # place the points of the trajectory at this interval [s]
LEAD_TIME = 3.0  # let the arm reach the first posture of the motion in this time [s]
SHORTEST_MOTION = 0.5  # refuse to send a demonstrated motion that is shorter than this [s]


def window(bag: Bag, start: float, duration: float | None) -> tuple[int, int]:
    """Return the window of a recording to play: the times [ns] at which it begins and ends.

    Args:
        bag: The recording.
        start: Where to begin, from the start of the bag [s].
        duration: How long to play [s], or None to play to the end.

    Raises:
        BagError: If `start` is beyond the end of the bag.
    """
    length = (bag.end - bag.start) / 1e9
    if start > length:
        raise BagError(bag.path, f'is only {length:.3f} s long', 'choose a smaller --start')
    first = bag.start + round(start * 1e9)
    if duration is None or duration > length:
        return first, bag.end
    return first, min(bag.end, first + round(duration * 1e9))


def lap(messages: TimedMessages, start: int, stop: int) -> Iterator[BagMessage]:
    """Yield the messages of one lap of playback, from one recorded time to another [ns].

    In these messages, the log time is the time at which to publish the message. The last message
    before `start` of each latched topic comes first, because a subscriber that joins at this time
    would receive it.

    Args:
        messages: The messages of the topics to play.
        start: Recorded time of the first messages [ns].
        stop: Recorded time of the last messages [ns].

    Raises:
        BagError: If a message cannot be decoded; replay must not publish it.
    """
    bag, topics = messages.bag, messages.topics
    latched: dict[str, BagMessage] = {}
    if start > bag.start:
        for message in messages.messages(latched_topics(bag) & topics, stop=start - 1):
            latched[message.topic] = message._replace(log_time=start - 1)
    played = (
        message._replace(log_time=max(message.log_time, start))
        for message in messages.messages(topics, start, stop)
    )
    for message in chain(latched.values(), played):
        bag.decode(message)
        yield message


class Timeline:
    """Recorded time, which advances by `rate` seconds per second unless it is paused."""

    def __init__(self, start: int, rate: float, now: float) -> None:
        """Begin at the recorded time `start` [ns] when the steady clock reads `now` [s]."""
        self.paused = False
        self._rate, self._recorded, self._steady = rate, start, now

    def recorded(self, now: float) -> int:
        """Return the recorded time [ns] when the steady clock reads `now` [s]."""
        passed = 0.0 if self.paused else now - self._steady
        return self._recorded + int(passed * self._rate * 1e9)

    def wait(self, recorded: int, now: float) -> float:
        """Return the time until a recorded time [ns] is due [s].

        The result is at most 0 if the recorded time has been reached, and infinite while playback
        is paused before the recorded time.
        """
        if self.paused:
            return math.inf if recorded > self._recorded else 0.0
        return (recorded - self._recorded) / (self._rate * 1e9) - (now - self._steady)

    def jump(self, recorded: int, now: float) -> None:
        """Set recorded time to `recorded` [ns] when the steady clock reads `now` [s].

        While playback is paused, messages up to this time are due, and later messages are not.
        """
        self._recorded, self._steady = recorded, now

    def hold(self, paused: bool, now: float) -> None:
        """Hold playback, or resume it if `paused` is False, when the steady clock reads `now` [s].

        Both leave the recorded time that has been reached unchanged.
        """
        self.jump(self.recorded(now), now)
        self.paused = paused

    def skip_pause(self, before: int, recorded: int, now: float) -> None:
        """Jump to shortly before a message if nothing was recorded for a long time before it.

        Args:
            before: Recorded time of the message before [ns].
            recorded: Recorded time of the message [ns].
            now: Reading of the steady clock [s].
        """
        if recorded - before > LONGEST_PAUSE:
            self.jump(recorded - SKIP_LEAD, now)

    def catch_up(self, recorded: int, now: float, longest: float) -> None:
        """Set recorded time to `recorded` [ns] if that time was due more than `longest` [s] ago.

        After a long interruption, playback thus goes on at its normal rate and does not publish
        all late messages at once. `now` is the reading of the steady clock [s].
        """
        if self.wait(recorded, now) < -longest:
            self.jump(recorded, now)


class TaughtMotion(NamedTuple):
    """A demonstrated motion of D joints, as the N points of a trajectory."""

    joints: tuple[str, ...]
    time: Array  # time of each point since the start, which includes LEAD_TIME [s], (N,)
    position: Array  # positions of the joints [rad or m], (N, D)
    velocity: Array  # velocities of the joints, zero at both ends [rad/s or m/s], (N, D)


def taught_motion(bag: Bag, topic: str, start: int, stop: int) -> TaughtMotion:
    """Return the motion on a recorded JointState topic between two recorded times [ns].

    Messages may name different joints; only messages with the most frequent set of joints are used.

    Raises:
        BagError: If the topic contains no motion of at least 0.5 s, if the motion has a gap of more
            than 1 s, or if it is too long for one trajectory.
    """
    postures = defaultdict[tuple[str, ...], list[tuple[float, Array]]](list)
    for message in TimedMessages(bag, [topic]).messages([topic], start, stop):
        joint_state = bag.decode(message)
        with suppress(MessageError):  # skip invalid messages, as a node does
            names = sorted(joint_state.name)
            values = target_values(joint_state, names)
            theta = np.array([values[name][0] for name in names])
            postures[tuple(names)].append(((message.log_time - start) / 1e9, theta))
    if not postures:
        raise _no_motion(bag, topic)
    joints = max(postures, key=lambda names: len(postures[names]))
    recorded, theta = map(np.array, zip(*postures[joints]))
    _check_motion(bag, topic, recorded, len(joints))
    time = np.linspace(recorded[0], recorded[-1], max(2, round(np.ptp(recorded) / SPACING)) + 1)
    # Messages further away than SILENCE get no weight.
    ends = np.searchsorted(recorded, [time - SILENCE, time + SILENCE]).T
    smooth: Array = np.empty((len(time), len(joints)))
    for n, (first, last) in enumerate(ends):
        weight = np.exp(-0.5 * ((time[n] - recorded[first:last]) / SMOOTHING) ** 2)
        smooth[n] = weight @ theta[first:last] / weight.sum()
    velocity = np.gradient(smooth, time, axis=0)
    velocity[[0, -1]] = 0.0
    return TaughtMotion(joints, LEAD_TIME + time - time[0], smooth, velocity)


def _check_motion(bag: Bag, topic: str, time: Array, joint_count: int) -> None:
    span = float(time[-1] - time[0])
    if span < SHORTEST_MOTION:
        raise _no_motion(bag, topic)
    gaps = np.diff(time)
    if (gap := float(gaps.max())) > SILENCE:
        begin = f'which begins {time[gaps.argmax()]:.1f} s after the start of this part of the bag'
        problem = f'{topic} has a gap of {gap:.1f} s, {begin}'
        remedy = 'use --start and --duration to choose a part without gaps'
        raise BagError(bag.path, problem, remedy)
    longest = SPACING * (MOST_ENTRIES // joint_count - 2)
    if span > longest:
        problem = f'the motion on {topic} lasts {span:.0f} s; legal: at most {longest:.0f} s'
        raise BagError(bag.path, problem, 'use --start and --duration to choose a shorter part')


def _no_motion(bag: Bag, topic: str) -> BagError:
    problem = f'{topic} contains no motion of at least {SHORTEST_MOTION:g} s'
    return BagError(bag.path, problem, 'record this topic while you demonstrate a motion')
