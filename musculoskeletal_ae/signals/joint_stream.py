# SPDX-License-Identifier: Apache-2.0
"""Turns readings of joint sensors into joint angles, and says which of them are usable.

    |θ_j − θ_j,accepted| ≤ step + speed · dt

A reading is usable if it is a number within the joint limits (plus `LIMITS.joint_outside`) and
satisfies this equation. θ_j,accepted is the last usable reading of joint j, and dt is the time
since its previous reading, limited to `LIMITS.longest_step`. Single impossible readings, such as 0
or −π, and bursts of them are therefore not usable. Each joint is judged by itself, so that a bad
sensor does not affect the readings of the others.

The level of a sensor changes if the sensor slips on its axis. The new level is accepted after all
readings have followed each other plausibly for `LIMITS.settled`. This file cannot say which level
is right: the estimator compares both with the muscle lengths (`estimation/joint_trust.py`).

Live arms and recordings use the same `JointStream`.
"""

from collections import Counter
from enum import Enum
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.limits import LIMITS, share_outside

#: Constant part of the largest change between two readings of a joint sensor [rad]; for prismatic
#: joints times `kinematics.radian`. It is far beyond the noise, resolution and backlash of sensors.
STEP = 0.1
#: Largest speed of a joint [rad/s]; for prismatic joints times `kinematics.radian`. Emulated arms
#: reach 5.4 rad/s when a tendon slips.
SPEED = 10.0
LASTING = 1.0  # report a joint sensor without a possible reading for this time [s]


class JointReading(Enum):
    """Whether a reading of a joint sensor is usable; the values are texts for users."""

    USABLE = 'usable'
    MISSING = 'missing'
    OUTSIDE = 'θ far outside the joint limits'
    JUMPED = 'θ jumped further than a joint can move'


#: readings that are not usable although the sensor has reported a number
IMPOSSIBLE = frozenset({JointReading.OUTSIDE, JointReading.JUMPED})


class JointSample(NamedTuple):
    """The readings of all joint sensors in one message.

    Attributes:
        theta: θ [rad], (D,); NaN where the reading is not usable.
        read: θ as the sensors reported it [rad], (D,); NaN where a joint was not measured.
        status: Whether the reading of each joint is usable, D values.
    """

    theta: Array
    read: Array
    status: tuple[JointReading, ...]


class JointStream:
    """Judges the readings of one arm's joint sensors.

    Attributes:
        rejected: Number of impossible readings by joint and kind, such as ('elbow', JUMPED).
    """

    def __init__(self, robot: Robot) -> None:
        """Start without readings."""
        self._robot = robot
        self._step = STEP * robot.kinematics.radian
        self._speed = SPEED * robot.kinematics.radian
        self.rejected: Counter[tuple[str, JointReading]] = Counter()
        self.reset()

    def reset(self) -> None:
        """Discard all readings, for example after a backward jump of the clock."""
        count = self._robot.joint_count
        # The last usable reading, the last reading of all [rad], its time, and the time since which
        # all readings have followed each other plausibly [s], (D,) each; NaN before the first.
        self._accepted, self._last, self._time, self._settling_since = np.full((4, count), np.nan)
        self._impossible_since = np.full(count, np.inf)  # [s]; ∞ for joints that can be read

    def take(self, time: float, theta: Array) -> JointSample:
        """Judge the readings θ [rad] (D,) received at `time` [s]; NaN for joints not measured."""
        read = np.array(theta, dtype=float)
        is_measured = np.isfinite(read)
        with np.errstate(invalid='ignore'):
            is_outside = is_measured & (share_outside(self._robot, read) > LIMITS.joint_outside)
        is_candidate = is_measured & ~is_outside
        has_jumped = self._jumped(time, read, is_candidate)
        is_usable = is_candidate & ~has_jumped
        self._accepted[is_usable] = read[is_usable]
        status = tuple(
            JointReading.MISSING
            if not measured
            else JointReading.OUTSIDE
            if outside
            else JointReading.JUMPED
            if jumped
            else JointReading.USABLE
            for measured, outside, jumped in zip(is_measured, is_outside, has_jumped, strict=True)
        )
        for name, kind in zip(self._robot.joints, status, strict=True):
            if kind in IMPOSSIBLE:
                self.rejected[name, kind] += 1
        since = np.minimum(self._impossible_since, time)
        self._impossible_since = np.where(is_measured & ~is_usable, since, np.inf)
        return JointSample(np.where(is_usable, read, np.nan), read, status)

    def unreadable(self, now: float) -> list[str]:
        """Return the joints whose readings have all been impossible for longer than LASTING."""
        is_lasting = now - self._impossible_since > LASTING
        return [name for name, lasts in zip(self._robot.joints, is_lasting, strict=True) if lasts]

    def _jumped(self, time: float, read: Array, is_candidate: Bools) -> Bools:
        """Return which readings are too far from the last usable one, (D,)."""
        elapsed = time - self._time
        if (elapsed < 0.0).any():  # the clock has gone back
            self.reset()
            elapsed = time - self._time
        # After a pause, any reading may be right, as at the beginning.
        is_first = is_candidate & ~(elapsed <= LIMITS.pause)
        largest = self._step + self._speed * np.minimum(elapsed, LIMITS.longest_step)
        follows = is_candidate & (np.abs(read - self._last) <= largest)
        self._settling_since[is_candidate & ~follows] = time
        is_settled = follows & (time - self._settling_since >= LIMITS.settled - 1e-9)
        is_near = is_candidate & (np.abs(read - self._accepted) <= largest)
        self._last[is_candidate], self._time[is_candidate] = read[is_candidate], time
        has_jumped: Bools = is_candidate & ~(is_first | is_near | is_settled)
        return has_jumped

    @property
    def text(self) -> str:
        """Counts of impossible readings as a text for users; '' if there were none."""
        return ', '.join(
            f'{name}: {count} × {kind.value}' for (name, kind), count in self.rejected.items()
        )
