# SPDX-License-Identifier: Apache-2.0
"""Pairs each (T, l) with the θ nearest in time, within half a period of the muscle messages.

A θ between two messages of the muscle modules belongs to the nearer one, or to the earlier one if
both are equally near. Hence no θ is used twice. The rule applies to each joint separately, because
several nodes may publish different joints at different times. Live arms and recordings use the same
rule.
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
        theta: θ [rad], (D,), NaN for joints without a matching value; None if no joint has one.
    """

    time: float
    message: Message
    dt: float
    theta: Array | None


class Pairing(Generic[Message]):
    """Pairs two streams; returns each muscle message when the next one has arrived."""

    def __init__(self, period: float) -> None:
        """Start; `period` is the period of the muscle messages [s]."""
        self._half = 0.5 * period + 1e-9
        self.reset()

    def reset(self) -> None:
        """Discard all messages, for example after a backward jump of the clock."""
        # For each joint, time [s] and θ (2, D) of the last value before the pending muscle message,
        # of the first one after it, and of the latest one; NaN if there is none.
        self._last = self._next = self._latest = np.full((2, 1), np.nan)
        self._came = -math.inf
        self._pending: tuple[float, Message] | None = None
        self._before: float | None = None

    def joints(self, time: float, theta: Array) -> None:
        """Record θ [rad] (D,) received at `time` [s]; NaN for joints that are not included."""
        if time < self._came:
            self.reset()
        self._came = time
        new = np.where(np.isnan(theta), np.nan, [np.full(len(theta), time), theta])
        self._latest = np.where(np.isnan(new), self._latest, new)
        self._next = np.where(np.isnan(self._next), new, self._next)

    def muscles(self, time: float, message: Message | None) -> Paired[Message] | None:
        """Record a message received at `time` [s], and return the previous message with its θ.

        At the end of a recording, pass None at time ∞ to get the last message.
        """
        # The clock has gone back or been replaced.
        if self._pending is not None and time < self._pending[0]:
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
        """Return the θ nearest to the pending message, without values nearer to a neighbour."""
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
