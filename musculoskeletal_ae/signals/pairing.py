# SPDX-License-Identifier: Apache-2.0
"""Which θ belongs to which (T, l): the nearest in time, within half a period.

A θ between two messages of the muscle modules belongs to the nearer one, the earlier one if it lies
in the middle, so none is used twice. That holds joint by joint: several nodes may publish some of
them each, at times of their own. The rule is the same on a live arm and on a recording.
"""

import math
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from musculoskeletal_ae.arrays import Array

Message = TypeVar('Message')


@dataclass(frozen=True)
class Paired(Generic[Message]):
    """One message of the muscle modules, with the θ of the same time if there is one.

    Attributes:
        time: When the message came [s].
        message: What the caller passed.
        dt: Time since the message before [s]; 0 for the first.
        theta: θ [rad], (D,), NaN of joints of which none belongs to it; None if there is no θ.
    """

    time: float
    message: Message
    dt: float
    theta: Array | None


class Pairing(Generic[Message]):
    """Joins two streams; gives out a muscle message when the next one has come."""

    def __init__(self, period: float) -> None:
        """Pair within half a `period` [s] of the muscle messages."""
        self._half = 0.5 * period + 1e-9
        self.reset()

    def reset(self) -> None:
        """Forget, as after a backward jump of the clock."""
        # Of each joint the last θ before the muscle message that waits, the first one after it, and
        # the latest one: when it came [s], and what it is, (2, D); NaN: none.
        self._last = self._next = self._latest = np.full((2, 1), np.nan)
        self._came = -math.inf
        self._pending: tuple[float, Message] | None = None
        self._before: float | None = None

    def joints(self, time: float, theta: Array) -> None:
        """Take a θ [rad] (D,) that came at `time` [s]; NaN of joints that it says nothing of."""
        if time < self._came:
            self.reset()
        self._came = time
        new = np.where(np.isnan(theta), np.nan, [np.full(len(theta), time), theta])
        self._latest = np.where(np.isnan(new), self._latest, new)
        self._next = np.where(np.isnan(self._next), new, self._next)

    def muscles(self, time: float, message: Message | None) -> Paired[Message] | None:
        """Take a message that came at `time` [s]; return the message before, paired.

        At the end of a recording, None at time ∞ returns the last message.
        """
        # The clock went back, or became another one.
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
        """Return the θ nearest to the message that waits, unless it is nearer to a neighbour."""
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
