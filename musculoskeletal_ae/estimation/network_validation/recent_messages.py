# SPDX-License-Identifier: Apache-2.0
"""Stores the healthy messages of the last seconds, on which candidate networks are validated."""

from collections import deque
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae

SPAN = 10.0  # drop messages that are older than this [s]
SPACING = 0.1  # store at most one message in this time [s]
LEAST = 20  # skip the checks on recent messages if there are fewer than this


class _Message(NamedTuple):
    time: float  # time on the steady clock [s]
    tension: Array  # tensions as read [N], (M,)
    length: Array  # muscle lengths [m], (M,)
    sliding: Array  # s: direction in which each tendon slid last, (M,)
    theta: Array  # measured θ [rad], NaN if it was not measured, (D,)


class RecentMessages:
    """Stores the healthy messages of the last 10 s, at most one in 0.1 s.

    All times come from one steady clock [s].
    """

    def __init__(self, joint_count: int) -> None:
        self._unmeasured = np.full(joint_count, np.nan)
        self._messages: deque[_Message] = deque()

    def __len__(self) -> int:
        return len(self._messages)

    @property
    def are_enough(self) -> bool:
        """Whether there are enough messages to validate a network on them."""
        return len(self._messages) >= LEAST

    @property
    def theta(self) -> Array:
        """Measured joint angles [rad], (N, D); NaN where they were not measured."""
        return np.array([message.theta for message in self._messages])

    def note(
        self,
        tension: Array,
        length: Array,
        sliding: Array,
        now: float,
        theta: Array | None,
    ) -> None:
        """Note a message of the healthy arm, if the last stored one is at least 0.1 s old.

        Args:
            tension: Tensions as read [N], (M,).
            length: Muscle lengths [m], (M,).
            sliding: Direction in which each tendon slid last, (M,).
            now: Time of the message [s].
            theta: Measured joint angles [rad], (D,), or None.
        """
        is_too_early = bool(self._messages) and 0.0 <= now - self._messages[-1].time < SPACING
        if is_too_early:
            return
        measured = self._unmeasured if theta is None else theta
        self._messages.append(_Message(now, tension, length, sliding, measured))
        while now - self._messages[0].time > SPAN:
            self._messages.popleft()

    def readings(self, mae: Mae) -> tuple[Array, Array]:
        """Return bone-side tensions [N] and muscle lengths [m] of the messages, (N, M) each.

        The bone-side tensions are computed with the tendon friction that the network has learned.
        """
        tension = np.array([message.tension for message in self._messages])
        length = np.array([message.length for message in self._messages])
        sliding = np.array([message.sliding for message in self._messages])
        return mae.transmission.end(tension, sliding), length

    def drop_after(self, time: float) -> None:
        """Drop the messages that are newer than a time [s]."""
        while self._messages and self._messages[-1].time > time:
            self._messages.pop()

    def clear(self) -> None:
        """Clear all messages, because they no longer describe the arm."""
        self._messages.clear()
