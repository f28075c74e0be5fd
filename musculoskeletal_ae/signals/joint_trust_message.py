# SPDX-License-Identifier: Apache-2.0
"""Which joint sensors to trust, as the estimator has decided.

The estimator compares the joint sensors with the muscle lengths, and watches for impossible
readings that persist (`estimation/detectors/joint_sensor_trust.py`). It publishes its decision on
the latched topic `joint_sensor_trust`. No other code judges whether a plausible reading is right.
Every change creates a new `JointTrust`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import ClassVar

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools


class SensorTrust(IntEnum):
    """Whether a joint sensor is trusted; the numbers are published."""

    #: The readings of the sensor are used, but not those from a time in which it was in doubt.
    TRUSTED = 0
    #: The sensor is in doubt, and its readings are not used from the beginning of the doubt on.
    DOUBTED = 1
    #: The user has confirmed the sensor, so its readings in the doubtful time are used as well.
    CONFIRMED = 2
    #: The sensor sends a series of impossible readings, and meanwhile none of them is used.
    IMPOSSIBLE = 3


#: use no readings of a sensor with one of these values of the trust
NOT_USED = frozenset({SensorTrust.DOUBTED, SensorTrust.IMPOSSIBLE})


@dataclass(frozen=True, eq=False)
class JointTrust:
    """The trust in every joint sensor of one arm, with the evidence.

    Attributes:
        trust: Trust in each joint sensor, D values.
        since: Beginning of the newest time in which each sensor was not used [s], (D,); NaN if
            there was none.
        deviation: Reading of each sensor minus the angle that the muscle lengths showed when the
            newest doubt began [rad], (D,); 0 if there was no doubt.
    """

    ROWS: ClassVar[int] = 3  # number of rows of the published message

    trust: tuple[SensorTrust, ...]
    since: Array
    deviation: Array

    @classmethod
    def full(cls, joint_count: int) -> JointTrust:
        """Return full trust: no sensor has ever been in doubt."""
        unknown = np.full(joint_count, np.nan)
        return cls((SensorTrust.TRUSTED,) * joint_count, unknown, np.zeros(joint_count))

    @cached_property
    def is_used(self) -> Bools:
        """Which joint sensors are used, (D,): those whose trust is not in NOT_USED."""
        return np.array([each not in NOT_USED for each in self.trust], dtype=bool)

    @cached_property
    def unused(self) -> tuple[int, ...]:
        """Indices of the joint sensors that are not used."""
        return tuple(np.flatnonzero(~self.is_used).tolist())

    @cached_property
    def is_doubted(self) -> Bools:
        """Which joint sensors are in doubt because of the muscle lengths, (D,)."""
        return np.array([each is SensorTrust.DOUBTED for each in self.trust], dtype=bool)

    @cached_property
    def doubted(self) -> tuple[int, ...]:
        """Indices of the joint sensors that are in doubt because of the muscle lengths."""
        return tuple(np.flatnonzero(self.is_doubted).tolist())

    def rows(self, now: float) -> Array:
        """Return the message that is published at `now` [s]: trust, age of the doubt, deviation.

        Args:
            now: Time on the clock of `since` [s].

        Returns:
            The numbers of `SensorTrust`, the times since `since` [s] (0 if there is none) and the
            deviations [rad], (3, D).
        """
        age = np.nan_to_num(np.maximum(now - self.since, 0.0))
        return np.array([np.array(self.trust, dtype=float), age, self.deviation])

    @classmethod
    def from_rows(cls, rows: Array, now: float) -> JointTrust:
        """Return the trust that a message (3, D) received at `now` [s] describes.

        Raises:
            ValueError: If a number in the message is not a `SensorTrust`.
        """
        trust = tuple(SensorTrust(number) for number in rows[0].tolist())
        return cls(trust, np.where(rows[1] > 0.0, now - rows[1], np.nan), rows[2])
