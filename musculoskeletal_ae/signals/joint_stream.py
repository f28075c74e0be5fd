# SPDX-License-Identifier: Apache-2.0
"""Turns readings of joint sensors into joint angles, and says which of them are usable.

    |θ_j − θ_j,accepted| ≤ step + speed · dt

A reading is usable if it is a number within the joint limits (plus `LIMITS.joint_outside`) and
satisfies this inequality. θ_j,accepted is the last usable reading of joint j, and dt is the time
since its previous reading, limited to `LIMITS.longest_step`. Single impossible readings, such as 0
or −π, and bursts of them are therefore not usable. Each joint is judged by itself, so that a bad
sensor does not affect the readings of the others. However, if at least half of the readings in a
message are impossible, no reading in it is usable: the message then describes another posture, for
example that of another program. The other sensors of this message are not blamed for it, because
half of the sensors may as well be broken.

The level of a sensor changes if the sensor slips on its axis. The new level is accepted after all
readings have followed each other plausibly for `LIMITS.settled`. This file cannot say which level
is right: the estimator compares both with the muscle lengths
(`estimation/detectors/joint_sensor_trust.py`).

Each node that reads the messages drops single readings with its own stream, as with `MuscleStream`.
Only the estimator decides whether a sensor with a lasting fault is trusted, and publishes this
trust for the other nodes (`joint_trust_message.py`).
"""

import math
from collections import Counter
from enum import Enum
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.reading_limits import LIMITS

#: accept a change of at most this plus SPEED · dt between two readings of a joint sensor [rad]; it
#: is far beyond the noise, resolution and backlash of sensors
STEP = 0.1
#: expect no joint to move faster than this [rad/s]; emulated arms reach 5.4 rad/s when a tendon
#: slips
SPEED = 10.0
#: report a series of impossible readings that has lasted for this time [s]; a burst of glitches is
#: shorter, even together with the time after which new readings are accepted (`LIMITS.settled`)
LASTING = 2.0
MISSING = 1.0  # report a joint sensor that has stopped sending readings after this time [s]
#: treat a series of impossible readings as ended when the last one is older than this [s]
ENDED = 1.0
#: Reject a whole message if at least this share of its readings is impossible. A single sensor
#: never rejects the readings of others.
FOREIGN_SHARE = 0.5


class JointReading(Enum):
    """Whether a reading of a joint sensor is usable; the values are texts for users."""

    USABLE = 'usable'
    MISSING = 'missing'
    OUTSIDE = 'θ far outside the joint limits'
    JUMPED = 'θ jumped further than a joint can move'
    FOREIGN = 'most other joint angles of the message are impossible'


class ImpossibleSeries(NamedTuple):
    """A series of impossible readings of one joint sensor.

    Attributes:
        since: Time of its first impossible reading [s].
        until: Time of its newest impossible reading [s].
        impossible: Number of impossible readings in the series.
        total: Number of all readings in the series, including possible readings.
    """

    since: float
    until: float
    impossible: int
    total: int

    def is_present(self, now: float) -> bool:
        """Return whether the series still continues at the time `now` [s]."""
        return now - self.until <= ENDED

    def is_lasting(self, now: float) -> bool:
        """Return whether the series is present, and longer than a burst or a slip of the sensor."""
        return self.is_present(now) and self.until - self.since > LASTING


_NONE = ImpossibleSeries(-math.inf, -math.inf, 0, 0)  # stands for no series so far


class JointChannel:
    """Judges the readings of one joint sensor, and records series of impossible readings.

    Attributes:
        series: The newest series of impossible readings.
        read_at: Time of the newest reading, on the clock of `JointStream.pass_time` [s]; None if
            no readings are expected, because there was none yet, or because the user removed the
            sensor.
    """

    def __init__(self, low: float, high: float) -> None:
        """Start without readings.

        Args:
            low: Lowest possible reading [rad].
            high: Highest possible reading [rad].
        """
        self._low, self._high = low, high
        self.read_at: float | None = None
        self.reset()

    def reset(self) -> None:
        """Discard all readings, but remember whether the joint has a sensor."""
        # All four are NaN before the first reading.
        self._time = self._last = math.nan  # last reading within the limits: its time [s] and angle
        self._accepted = math.nan  # last usable reading [rad]
        self._settling_since = math.nan  # since when readings follow each other plausibly [s]
        self.series = _NONE

    def judge(self, time: float, value: float) -> JointReading:
        """Judge whether a reading [rad] received at `time` [s] is usable, by those before it."""
        if not math.isfinite(value):
            return JointReading.MISSING
        if not self._low <= value <= self._high:
            return JointReading.OUTSIDE
        elapsed = time - self._time
        largest = STEP + SPEED * min(elapsed, LIMITS.longest_step)
        # After a pause, any reading may be right, as at the beginning.
        is_first = not elapsed <= LIMITS.pause
        if not abs(value - self._last) <= largest:
            self._settling_since = time
        is_settled = time - self._settling_since >= LIMITS.settled - 1e-9
        is_near = abs(value - self._accepted) <= largest
        self._last, self._time = value, time
        if is_first or is_near or is_settled:
            return JointReading.USABLE
        return JointReading.JUMPED

    def note(self, time: float, value: float, kind: JointReading) -> None:
        """Note a reading [rad] received at `time` [s], and how it was judged in the end.

        A reading that is not usable only because of the others says nothing about this sensor.
        """
        series = self.series
        if kind is JointReading.FOREIGN:
            return
        if kind is JointReading.USABLE:
            self._accepted = value
            if series is not _NONE and series.is_present(time):
                self.series = series._replace(total=series.total + 1)
        elif not series.is_present(time):
            self.series = ImpossibleSeries(time, time, 1, 1)
        else:
            self.series = ImpossibleSeries(
                series.since, time, series.impossible + 1, series.total + 1
            )


class JointStream:
    """Judges the readings of one arm's joint sensors.

    Attributes:
        rejected: Number of impossible readings by joint and kind, such as ('elbow', JUMPED).
        newest: Whether the reading of each joint in the newest message is usable.
    """

    def __init__(self, robot: Robot) -> None:
        """Start without readings."""
        margin = LIMITS.joint_outside * (robot.upper - robot.lower)
        limits = robot.lower - margin, robot.upper + margin
        self._joints = robot.joints
        self._channels = [JointChannel(*each) for each in zip(*(part.tolist() for part in limits))]
        self.rejected: Counter[tuple[str, JointReading]] = Counter()
        self.newest: list[JointReading] = [JointReading.MISSING] * robot.joint_count
        self._newest_at = -math.inf  # time of the newest message [s]
        self._impossible_at = -math.inf  # time of the newest impossible reading of any joint [s]
        self._passed = 0.0  # sum of the times of `pass_time` [s]

    def reset(self) -> None:
        """Discard all readings, for example after a backward jump of the clock."""
        self._impossible_at = -math.inf
        for channel in self._channels:
            channel.reset()

    def take(self, time: float, theta: Array) -> Array:
        """Judge the readings θ [rad] (D,) received at `time` [s]; NaN for joints not measured.

        Returns:
            θ [rad], (D,); NaN where the reading is not usable.
        """
        if time < self._newest_at:  # the clock has gone back
            self.reset()
        self._newest_at = time
        values, channels = theta.tolist(), self._channels
        kinds = [each.judge(time, value) for each, value in zip(channels, values, strict=True)]
        usable, foreign = JointReading.USABLE, JointReading.FOREIGN
        if self._is_foreign(kinds):
            kinds = [foreign if kind is usable else kind for kind in kinds]
        self.newest = kinds
        for j, kind in enumerate(kinds):
            if kind is JointReading.MISSING:
                values[j] = math.nan
                continue
            channels[j].read_at = self._passed
            channels[j].note(time, values[j], kind)
            if kind is not usable:
                self.rejected[self._joints[j], kind] += 1
                self._impossible_at = time
                values[j] = math.nan
        return np.array(values)

    @staticmethod
    def _is_foreign(kinds: list[JointReading]) -> bool:
        """Return whether at least half of the readings, and at least two, are impossible.

        The message then describes another posture, such as that of a second publisher.
        """
        usable = kinds.count(JointReading.USABLE)
        impossible = len(kinds) - usable - kinds.count(JointReading.MISSING)
        return impossible > 1 and impossible >= FOREIGN_SHARE * (impossible + usable)

    def pass_time(self, seconds: float) -> None:
        """Let time pass [s] in which readings should have arrived, to notice missing sensors.

        Callers limit the time between two messages that are far apart: pauses of the driver or of
        this process do not count.
        """
        self._passed += seconds

    @property
    def missing(self) -> list[str]:
        """The joints that had readings, and have had none for longer than MISSING."""
        return [
            name
            for name, channel in zip(self._joints, self._channels, strict=True)
            if channel.read_at is not None and self._passed - channel.read_at > MISSING
        ]

    def do_without_missing(self) -> tuple[int, ...]:
        """Expect no readings of the missing joints until they report again; return the joints."""
        missing = tuple(self._joints.index(name) for name in self.missing)
        for j in missing:
            self._channels[j].read_at = None
        return missing

    def impossible(self, now: float) -> dict[int, ImpossibleSeries]:
        """Return the lasting series of impossible readings, by index of the joint.

        Args:
            now: Time on the clock of the readings [s].
        """
        if now - self._impossible_at > ENDED:
            return {}
        return {
            j: each.series for j, each in enumerate(self._channels) if each.series.is_lasting(now)
        }

    @property
    def text(self) -> str:
        """Counts of impossible readings as a text for users; '' if there were none."""
        return ', '.join(
            f'{name}: {count} × {kind.value}' for (name, kind), count in self.rejected.items()
        )
