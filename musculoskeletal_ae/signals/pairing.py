# SPDX-License-Identifier: Apache-2.0
"""Pairs each message of the muscle modules with the posture θ that is nearest in time.

The posture must be within half a period of the muscle messages. A posture between two muscle
messages belongs to the nearer one, or to the earlier one if both are equally near. Hence no posture
is used twice. The rule applies to each joint separately, because several nodes may publish
different joints at different times. Live arms and recordings use the same rule.
"""

import math
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from musculoskeletal_ae.arrays import Array

Message = TypeVar('Message')


@dataclass(frozen=True)
class Paired(Generic[Message]):
    """A message of the muscle modules, with the θ nearest to it in time, if there is one.

    Attributes:
        time: Time of reception of the message [s].
        message: The message as the caller passed it.
        dt: Time since the previous message [s]; 0 for the first.
        theta: Joint angles θ [rad], (D,); NaN for joints without a matching value. None if no joint
            has one.
    """

    time: float
    message: Message
    dt: float
    theta: Array | None


class Pairing(Generic[Message]):
    """Pairs each muscle message with the posture θ that is nearest in time.

    The pair is complete, and is returned, when the next muscle message arrives.
    """

    def __init__(self, period: float) -> None:
        """Start without messages; `period` is the period of the muscle messages [s]."""
        self._half = 0.5 * period + 1e-9
        self.reset()

    def reset(self) -> None:
        """Discard all messages, for example after a backward jump of the clock."""
        # Time [s] and value of θ for each joint, (2, D), NaN if there is none: the last θ before
        # the pending muscle message, the first θ after it, and the latest θ of all.
        self._last = self._next = self._latest = np.full((2, 1), np.nan)
        self._came = -math.inf  # time of the latest message with θ [s]
        #: time [s] and content of the pending muscle message
        self._pending: tuple[float, Message] | None = None
        self._before: float | None = None  # time of the muscle message before the pending one [s]

    def joints(self, time: float, theta: Array) -> None:
        """Record θ [rad], (D,), received at `time` [s]; NaN for joints that are not included."""
        if time < self._came:
            self.reset()
        self._came = time
        new = np.where(np.isnan(theta), np.nan, [np.full(len(theta), time), theta])
        self._latest = np.where(np.isnan(new), self._latest, new)
        self._next = np.where(np.isnan(self._next), new, self._next)

    def muscles(self, time: float, message: Message | None) -> Paired[Message] | None:
        """Record a muscle message received at `time` [s]; return the previous message with its θ.

        At the end of a recording, pass None at time ∞ to get the last message.
        """
        if self._pending is not None and time < self._pending[0]:  # the clock has gone back
            self.reset()
        pending = self._pending
        self._pending = None if message is None else (time, message)
        paired = None
        if pending is not None:
            came, earlier = pending
            dt = 0.0 if self._before is None else came - self._before
            paired = Paired(came, earlier, dt, self._nearest(came, time))
            self._before = came
        self._last, self._next = self._latest, np.full((2, 1), np.nan)
        return paired

    def _nearest(self, came: float, following: float) -> Array | None:
        """Return the θ nearest to the pending muscle message; NaN for joints without a match.

        A value that is nearer to the muscle message before or after does not match. The result is
        None if no joint has a match.

        Args:
            came: Time of the pending message [s].
            following: Time of the muscle message after it [s].
        """
        before = -math.inf if self._before is None else self._before
        time, theta = np.stack(np.broadcast_arrays(self._last, self._next), axis=1)
        distance = np.abs(time - came)
        mine = distance <= np.minimum(self._half, np.abs(time - following))
        mine &= distance < np.abs(time - before)
        if not mine.any():
            return None
        last, first = np.where(mine, distance, math.inf)
        nearest: Array = np.where(first < last, theta[1], theta[0])
        return np.where(mine.any(axis=0), nearest, np.nan)
