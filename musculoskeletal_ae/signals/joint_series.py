# SPDX-License-Identifier: Apache-2.0
"""Finds false readings of joint sensors in a finished series, such as a recording.

A node judges each reading by the earlier ones (`joint_stream.py`). In a finished series, the later
readings help as well. A constant that interrupts other readings again and again is false: it comes
from a program that publishes zeros beside the driver, or from a driver that publishes 0 for a
failed read. Such a constant is recognised by the jumps with which it begins and ends,

    |θ_n − θ_n−1| > step + speed · dt

with the step and speed of `joint_stream.py`, or by readings that are nearly the same before and
after it, and differ from it by more than the step. All readings with the value of a false constant
are left out, even where the arm happens to be close to it. The remaining readings pass through a
`JointStream`.

Encoders may count whole turns, or wrap around at 0 or π. Whole turns are therefore subtracted from
readings if the remaining angles are continuous and within the joint limits.

If a sensor still has impossible readings again and again, none of its readings during that time is
usable, as on a running arm (`estimation/detectors/joint_sensor_trust.py`).
"""

from collections import defaultdict
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.joint_stream import (
    FOREIGN_SHARE,
    SPEED,
    STEP,
    JointReading,
    JointStream,
)
from musculoskeletal_ae.signals.reading_limits import LIMITS

#: treat a repeated value as false if at least this share of its appearances begins and ends with a
#: jump
INTERRUPTING = 0.5
LEAST_REPEATED = 3  # examine a repeated value only if it occurs at least this often
#: Treat a value that appears in one uninterrupted run as false in three cases: the readings before
#: and after the run differ by less than the share RETURNING of the jumps at its ends; at least
#: FOREIGN_SHARE of the joints jump at once; or the run lasts although at most the share NOISY of
#: the other readings repeat the reading before. Otherwise, a sensor may have slipped.
RETURNING, NOISY = 0.5, 0.1
#: Assume that the unit, sign or zero of a joint is wrong, and drop no single reading, in two cases:
#: more than this share of its readings is far outside its limits, or it crosses the limits without
#: a jump in more than this share of the crossings. `joint_sensors.py` then finds the fault.
WRONG_SCALE = 0.5
#: subtract whole turns from readings of a joint only if at least this share of those readings is
#: then within the limits and close to the reading before
CONTINUOUS = 0.95
#: report a smaller share of messages with false readings as a remark instead of a fault
TOLERATED = 0.01
MOST_NAMED = 6  # name at most this many kinds of false readings in a text
#: advice for users if readings are false
REMEDY = (
    'stop a second program that publishes joint_states, and let the driver leave out readings that '
    'failed'
)
#: advice for users if readings are off by whole turns
TURN_REMEDY = (
    'let the driver subtract the whole turns that the encoder counts, so that θ is within the '
    'limits of robot.urdf'
)


class JointSeries(NamedTuple):
    """The usable readings of joint sensors in a series of N messages.

    Attributes:
        theta: Joint angles θ without whole turns [rad], (N, D); NaN where a reading is unknown or
            not usable.
        share: Share of the messages with at least one false reading, in [0, 1].
        text: Description of the false readings for users; '' if there are none.
        remedy: What users should do about the false readings.
    """

    theta: Array
    share: float
    text: str
    remedy: str

    @property
    def is_fault(self) -> bool:
        """Whether false readings are so frequent that the driver has to be corrected.

        Glitches in at most 1 % of the messages (TOLERATED) do no harm.
        """
        return self.share > TOLERATED

    @property
    def advice(self) -> str:
        """Description of the false readings with the remedy, as a text for users."""
        return f'joint_states: {self.text}; {self.remedy}'


def judge_series(robot: Robot, time: Array, theta: Array) -> JointSeries:
    """Judge the readings of joint sensors in a finished series.

    Args:
        robot: The robot.
        time: Times of the messages [s], (N,), in order.
        theta: Measured joint angles θ [rad], (N, D); NaN for joints that a message does not name.
    """
    usable = theta.copy()
    turned = _subtract_turns(robot, time, usable)
    found = _drop_constants(robot, time, usable)
    stream = JointStream(robot)
    impossible = defaultdict[tuple[int, JointReading], list[float]](list)  # readings [rad]
    is_outside = np.zeros(theta.shape, dtype=bool)
    lasting = dict[tuple[int, float], float]()  # newest time of each lasting series [s]
    for n, now in enumerate(time.tolist()):
        values = usable[n].copy()
        usable[n] = stream.take(now, values)
        for j in np.flatnonzero(np.isfinite(values) & np.isnan(usable[n])).tolist():
            impossible[j, stream.newest[j]].append(values[j])
            is_outside[n, j] = stream.newest[j] is JointReading.OUTSIDE
        for j, series in stream.impossible(now).items():
            lasting[j, series.since] = series.until
    if _has_wrong_scale(time, theta, is_outside):
        return JointSeries(theta, 0.0, '', '')
    for (j, since), until in lasting.items():
        usable[(since <= time) & (time <= until), j] = np.nan
    for (j, kind), readings in impossible.items():
        if readings:
            name, example = robot.joints[j], robot.units[j].position_text(readings[0], '.3g')
            found.append((len(readings), f'{name}: {kind.value}, such as {example}'))
    is_unused = np.asarray((np.isfinite(theta) & np.isnan(usable)).any(axis=1))
    is_turned = np.asarray((np.abs(usable - theta) > np.pi).any(axis=1))
    texts = [_text(is_unused, found, ', which are not used')] if found else []
    texts += [_text(is_turned, turned, '')] if turned else []
    remedies = [REMEDY] if found else []
    remedies += [TURN_REMEDY] if turned else []
    share = float((is_unused | is_turned).mean()) if len(theta) else 0.0
    return JointSeries(usable, share, '; '.join(texts), '; '.join(remedies))


def _subtract_turns(robot: Robot, time: Array, theta: Array) -> list[tuple[int, str]]:
    """Subtract whole turns from readings of revolute joints that are then within the limits.

    Readings in degrees may look like whole turns as well, but then most joints seem to be turned by
    different numbers of turns.

    Args:
        robot: The robot.
        time: Times of the messages [s], (N,).
        theta: Measured joint angles θ [rad], (N, D), which is changed in place.

    Returns:
        The number of changed readings of each joint, with a text about it.
    """
    margin = LIMITS.joint_outside * (robot.upper - robot.lower)
    middle = 0.5 * (robot.lower + robot.upper)
    turns = np.round((theta - middle) / (2.0 * np.pi))
    turns[:, robot.units.slides] = 0.0
    is_turned = np.nan_to_num(turns) != 0.0
    joints = np.flatnonzero(is_turned.any(axis=0)).tolist()
    is_positive = not (theta[:, joints] < 0.0).any() and np.nanmax(theta, initial=0.0) < 2.0 * np.pi
    if len(joints) > max(1.0, 0.5 * robot.joint_count) and not is_positive:
        return []
    found = []
    for j in joints:
        rows = np.flatnonzero(np.isfinite(theta[:, j]))
        shifted = theta[rows, j] - 2.0 * np.pi * turns[rows, j]
        is_inside = np.abs(shifted - middle[j]) <= middle[j] - robot.lower[j] + margin[j]
        is_smooth = np.abs(np.diff(shifted, prepend=shifted[0])) <= np.concatenate(
            [[np.inf], _largest_changes(time[rows])]
        )
        which = is_turned[rows, j]
        if (is_inside & is_smooth)[which].mean() < CONTINUOUS:
            continue
        example = theta[rows[which][0], j]
        theta[rows, j] = shifted
        text = f'{robot.joints[j]} is whole turns off, such as {example:.3g} rad'
        found.append((int(which.sum()), text))
    return found


def _drop_constants(robot: Robot, time: Array, theta: Array) -> list[tuple[int, str]]:
    """Replace constants that interrupt other readings by NaN.

    A program that publishes beside the driver appears as a constant posture, and a failing sensor
    as a constant reading of one joint.

    Args:
        robot: The robot.
        time: Times of the messages [s], (N,).
        theta: Measured joint angles θ [rad], (N, D), which is changed in place.

    Returns:
        The number of readings of each false constant, with a text about it.
    """
    found = []
    groups = [[*range(robot.joint_count)]] if robot.joint_count > 1 else []
    groups += [[j] for j in range(robot.joint_count)]
    for joints in groups:
        rows = np.flatnonzero(np.isfinite(theta[:, joints]).all(axis=1))
        readings = theta[np.ix_(rows, joints)]
        if len(rows) < LEAST_REPEATED:
            continue
        constants, which = np.unique(readings, axis=0, return_inverse=True)
        largest = _largest_changes(time[rows])
        for constant in _interrupting(which.ravel(), readings, largest):
            is_it = which.ravel() == constant
            theta[np.ix_(rows[is_it], joints)] = np.nan
            values = ', '.join(
                f'{robot.joints[j]} {robot.units[j].position_text(value + 0.0, ".3g")}'
                for j, value in zip(joints, constants[constant].tolist())
            )
            found.append((int(is_it.sum()), f'a constant interrupts the other readings: {values}'))
    return found


def _largest_changes(time: Array) -> Array:
    """Return the largest possible change of θ [rad] from each message to the next one, (N − 1,)."""
    changes: Array = STEP + SPEED * np.minimum(np.diff(time), LIMITS.longest_step)
    return changes


def _has_wrong_scale(time: Array, theta: Array, is_outside: Bools) -> bool:
    """Return whether readings are outside the limits because of their unit, sign or zero.

    Args:
        time: Times of the messages [s], (N,).
        theta: Measured joint angles θ [rad], (N, D).
        is_outside: Which readings are far outside the limits, (N, D).
    """
    for j in np.flatnonzero(is_outside.any(axis=0)).tolist():
        rows = np.flatnonzero(np.isfinite(theta[:, j]))
        outside = is_outside[rows, j]
        crosses = outside[1:] != outside[:-1]
        changes = np.abs(np.diff(theta[rows, j]))
        is_smooth = changes <= _largest_changes(time[rows])
        if outside.mean() > WRONG_SCALE or is_smooth[crosses].mean() > WRONG_SCALE:
            return True
    return False


def _interrupting(which: Ints, readings: Array, largest: Array) -> list[int]:
    """Return the indices of the repeated values that interrupt a series of changing readings.

    Args:
        which: Index of the repeated value in each message, (N,).
        readings: The messages [rad], (N, K).
        largest: Largest possible change from each message to the next one [rad], (N − 1,).
    """
    edges = np.flatnonzero(np.diff(which)) + 1
    begins, ends = edges[:-1], edges[1:] - 1  # appearances with other messages on both sides
    entry = np.abs(readings[begins] - readings[begins - 1])
    exit_ = np.abs(readings[ends + 1] - readings[ends])
    enters, leaves = entry > largest[begins - 1, None], exit_ > largest[ends, None]
    jumps = enters.any(axis=1) & leaves.any(axis=1)
    change = np.abs(readings[ends + 1] - readings[begins - 1]).max(axis=1, initial=0.0)
    least = np.minimum(entry.max(axis=1, initial=0.0), exit_.max(axis=1, initial=0.0))
    returns = (least > STEP) & (change < RETURNING * least)
    are_most = [
        (each.sum(axis=1) > 1) & (each.mean(axis=1) >= FOREIGN_SHARE) for each in (enters, leaves)
    ]
    is_sure = returns | (are_most[0] & are_most[1])

    constants = which[begins]
    count = int(which.max()) + 1
    appearances = np.bincount(constants, minlength=count)
    interruptions = np.bincount(constants[jumps | returns], minlength=count)
    sure = np.bincount(constants[is_sure], minlength=count)
    repeated = np.bincount(which, minlength=count)
    same = np.bincount(which[1:][np.diff(which) == 0], minlength=count)
    is_noisy = same.sum() - same < NOISY * (len(which) - repeated)  # without the constant
    is_held = is_noisy & (same >= LEAST_REPEATED - 1)
    is_false = repeated >= LEAST_REPEATED
    is_false &= interruptions >= np.maximum(INTERRUPTING * appearances, 1)
    is_false &= (interruptions > 1) | (sure > 0) | is_held
    return np.flatnonzero(is_false).tolist()


def _text(is_affected: Bools, found: list[tuple[int, str]], consequence: str) -> str:
    """Return a text on false readings.

    Args:
        is_affected: Which messages have false readings, (N,).
        found: The number of readings of each kind, with a text about it.
        consequence: What is done with the readings.
    """
    named = [f'{number} × {text}' for number, text in sorted(found, reverse=True)[:MOST_NAMED]]
    if len(found) > MOST_NAMED:
        named.append(f'{len(found) - MOST_NAMED} more kinds')
    percent = distinct(100.0 * float(is_affected.mean()), 0.0)[0]
    return (
        f'{percent} % of the {len(is_affected)} messages have false joint angles{consequence} '
        f'({"; ".join(named)})'
    )
