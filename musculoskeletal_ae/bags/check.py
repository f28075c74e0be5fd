# SPDX-License-Identifier: Apache-2.0
"""Checks a recording: contents, completeness and fit to a robot (`replay --check`)."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.recorded_faults import find_faults
from musculoskeletal_ae.bags.storage import LONGEST_PAUSE
from musculoskeletal_ae.bags.streams import Pairs, Streams, read_streams
from musculoskeletal_ae.bags.timed_messages import find_pauses
from musculoskeletal_ae.bags.topics import interface_topics
from musculoskeletal_ae.exceptions import BagError, MusculoskeletalError, printable
from musculoskeletal_ae.learning.recordings import LEAST_RESTS, count_postures
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.progress_bar import ProgressBar
from musculoskeletal_ae.robot.directories import shipped_robots
from musculoskeletal_ae.robot.motors import NO_MOTORS, motor_topics
from musculoskeletal_ae.robot.robot import Robot

MOST_REJECTED = 0.1  # report a fault if more than this share of a topic's messages is rejected
#: report no fault, however many messages are rejected for these reasons: lengths were being
#: calibrated, or another program publishes its own joints on the topic
USUAL_REJECTIONS = 'length offsets unknown', 'missing joint', 'missing motor'
#: report a fault if one of these topics pauses while others are recorded
READINGS = 'joint_states', 'muscle_states'
#: remedy for an unfinished recording
_RECOVER = '`record --recover BAG` makes a finished copy for `ros2 bag`'


@dataclass
class BagCheck:
    """Report on a recording: its contents, whether it is complete, and whether it fits a robot."""

    lines: list[str] = field(default_factory=list)  # lines that describe the contents
    faults: list[str] = field(default_factory=list)  # why the recording is incomplete or unfit

    def __str__(self) -> str:
        lines = [*self.lines, *(f'fault: {fault}' for fault in self.faults)]
        return '\n'.join(map(printable, lines))


def check_bag(path: Path, robot: str | None = None, namespace: str | None = None) -> BagCheck:
    """Read a recording, and report its contents, completeness and fit to a robot.

    If the recording cannot be read, the report lists the error as a fault. The progress is printed
    to stderr.

    Args:
        path: The bag.
        robot: A shipped robot or a directory, or None to report which of the shipped robots fit.
        namespace: The namespace to check; required only if the bag has several.
    """
    check = BagCheck()
    try:
        with ProgressBar(f'reading {path}') as bar:
            bar.announce()
            bag = Bag.open(path)
            recover = f'; {_RECOVER}' if bag.message_count else ''
            check.faults += [f'unfinished: {reason}{recover}' for reason in bag.unfinished]
            times = _read_times(bag, bar.add)
        check.lines += _contents(bag, times)
        check.faults += [
            f'{pause.text(bag.start)}: the recorder was paused, or its clock was set; '
            '`replay --skip-pauses` does not wait there'
            for pause in find_pauses(times.values())
        ]
        topics = interface_topics(bag, namespace, motor_topics(robot) if robot else NO_MOTORS)
    except MusculoskeletalError as error:
        check.faults.append(str(error))
        return check
    check.faults += _silences(bag, topics, times)
    results = {
        name: _fit(bag, name, namespace) for name in ([robot] if robot else shipped_robots())
    }
    fits = [name for name, fit in results.items() if not fit.faults]
    recorded = [name for name, fit in results.items() if fit.has_its_messages]
    if robot:
        check.faults += results[robot].faults
    elif not fits and len(recorded) == 1:  # the faults say what is wrong with the recording
        check.faults += [f'as {recorded[0]}: {fault}' for fault in results[recorded[0]].faults]
    if fits:
        check.lines += results[fits[0]].notes
        check.lines.append(results[fits[0]].motion)
    if fits or not robot:
        check.lines.append(f'fits: {", ".join(fits) or "none of the shipped robots (see --robot)"}')
    return check


def motion_text(robot: Robot, recording: Pairs) -> str:
    """Return a text that tells the user how many different postures can be learned.

    `train --from-bag` learns from resting postures or, if there are few, from slow moments of the
    motion. If there are too few of both, the text also says what to record.
    """
    rests = _postures(robot, recording, 'resting postures')
    least = preset_named('default').least_samples
    text = f'different resting postures to learn from: {rests}'
    if rests >= LEAST_RESTS:
        return f'{text} (at least {least} are needed; more of them reduce the error)'
    moments = _postures(robot, recording, 'slow moments', from_motion=True)
    if moments >= max(least, rests + 1):
        return (
            f'{text}; as they are fewer than {LEAST_RESTS}, `train --from-bag` learns from '
            f'{moments} slow moments of the motion instead'
        )
    if rests >= least:
        return f'{text} (at least {least} are needed; more of them reduce the error)'
    return (
        f'{text}; `train --from-bag` needs at least {least} of them, or as many slow moments of '
        'the motion. Record an arm that moves from posture to posture, as with controller/explore'
    )


def _postures(robot: Robot, recording: Pairs, what: str, *, from_motion: bool = False) -> int:
    with ProgressBar(f'counting {what}', len(recording.time)) as bar:
        return count_postures(robot, recording, bar.add, from_motion=from_motion)


def _read_times(bag: Bag, progress: Callable[[float], None]) -> dict[str, array[int]]:
    """Decode all messages that can be used, and return the log times [ns] of each topic."""
    times = {name: array('q') for name in bag.topics}
    for message in bag.messages():
        times[message.topic].append(message.log_time)
        if not bag.topics[message.topic].problem:
            bag.decode(message)
        progress(1.0 / bag.message_count)
    return times


def _rejected(bag: Bag, streams: Streams) -> list[str]:
    """Return a fault for each reason for which a large share of a topic's messages was rejected."""
    faults = []
    for why, count in streams.rejected.items():
        label, _, reason = why.partition(': ')
        total = bag.topics[label.partition(' as ')[0]].message_count
        if count > MOST_REJECTED * total and reason not in USUAL_REJECTIONS:
            faults.append(
                f'{count / total:.0%} of the messages of {label} were rejected: {reason}. Run '
                'check_driver, correct the driver, and record again'
            )
    return faults


def _silences(bag: Bag, topics: dict[str, str], times: dict[str, array[int]]) -> list[str]:
    """Return a fault for each topic of readings that is silent while others are recorded.

    A recorder may lose a topic in the middle of a recording. Pauses of the whole recording are not
    reported here.

    Args:
        bag: The recording.
        topics: Recorded names of the topics, by name in the interface.
        times: Log times [ns] of each topic, by recorded name.
    """
    pauses = find_pauses(times.values())
    faults = []
    for name in dict.fromkeys(topics[each] for each in READINGS if each in topics):
        marks = np.unique([bag.start, *times[name], bag.end])
        for begin, end in zip(marks[:-1].tolist(), marks[1:].tolist()):
            within = [each for each in pauses if begin <= each.begin and each.end <= end]
            paused = sum(pause.end - pause.begin for pause in within)
            if end - begin - paused > LONGEST_PAUSE:
                since, until = ((mark - bag.start) / 1e9 for mark in (begin, end))
                faults.append(
                    f'no message of {name} was recorded from {since:.1f} s to {until:.1f} s after '
                    'the start, while other topics went on: see whether its publisher had ended, '
                    'and record again'
                )
    return faults


def _contents(bag: Bag, times: dict[str, array[int]]) -> list[str]:
    begin = datetime.fromtimestamp(bag.start / 1e9, timezone.utc)
    length = f'{(bag.end - bag.start) / 1e9:.3f} s from {begin:%Y-%m-%d %H:%M:%S} UTC'
    has_checksums = all(file.has_checksums for file in bag.files)
    lines = [
        f'{bag.path}: {bag.message_count} messages, {length}',
        f'checksums: {"for all messages" if has_checksums else "none, or not for all messages"}',
        '',
        f'{"topic":<44} {"messages":>9} {"Hz":>9} {"gap s":>8}  type',
    ]
    for name, topic in sorted(bag.topics.items()):
        gaps = np.diff(times[name]) / 1e9
        usual = gaps[gaps <= LONGEST_PAUSE / 1e9]  # a pause says nothing about the rate
        rate = f'{1 / usual.mean():.2f}' if usual.any() else ''
        line = f'{name:<44} {len(times[name]):>9} {rate:>9} {gaps.max(initial=0.0):8.3f}'
        ignored = f'; ignored: {topic.problem}' if topic.problem else ''
        lines.append(f'{line}  {topic.type}{ignored}')
    return [*lines, '']


class _Fit(NamedTuple):
    faults: list[str]  # reasons why the bag does not fit the robot
    notes: list[str]  # remarks on unused messages
    motion: str = ''  # text for users: how much can be learned from the motion
    has_its_messages: bool = False  # whether the messages have the joints and muscles of the robot


def _fit(bag: Bag, name: str, namespace: str | None) -> _Fit:
    """Return the reasons why a bag does not fit a robot, and remarks on messages left unused."""
    try:
        robot = Robot.load(name)
        with ProgressBar(f'comparing {bag.path} with {name}') as bar:
            streams = read_streams(bag, robot, namespace, bar.add)
    except BagError as error:
        return _Fit([f'does not fit {name}: {error}'], [])
    except MusculoskeletalError as error:
        return _Fit([str(error)], [])
    left_out = [f'rejected {n}: {why}' for why, n in streams.rejected.items()]
    left_out += streams.notes
    left_out += [
        f'{n} messages were used only in part: {why}' for why, n in streams.ignored.items()
    ]
    joint_text = streams.judged_joints.advice
    joint_faults = [joint_text] if streams.judged_joints.is_fault else []
    if streams.judged_joints.text and not joint_faults:
        left_out.append(joint_text)
    rejected_faults = _rejected(bag, streams)
    if not len(streams.muscle_times) and not len(streams.joints.time):
        problem = f'the bag has neither joint_states nor muscle_states that fit {name}'
        return _Fit([problem, *joint_faults], left_out)
    pairs = streams.pairs()
    wiring, sensor_faults = find_faults(robot, pairs)
    faults = rejected_faults + joint_faults + sensor_faults
    if wiring.faulty:
        what = 'order' if wiring.misplaced else 'signs'
        faults.append(f'the muscles do not have the {what} of {name}: {wiring.text(robot.muscles)}')
    return _Fit(faults, left_out, '' if faults else motion_text(robot, pairs), True)
