# SPDX-License-Identifier: Apache-2.0
"""Rejects messages after a length has jumped, until the length has stayed at its new level.

A length jumps if it changes faster than a muscle can, for example because a module has lost its
length offset. The change between two messages is compared with the pause between their receptions
or between their sendings, whichever is longer: messages in between may have been lost, and the
later message may have arrived right after a late one (`arrival`). `LengthJumps.step`
receives every message and decides:

    no jump ── a length jumps ──────────────────────────────► waiting: messages are rejected
    waiting ── the lengths have returned ───────────────────► no jump
    waiting ── no length has jumped for `LIMITS.settled` ───► no jump: the new level is accepted

A failed read may yield a length so close to the one before it that only the return to the true
length is a jump. Changes of more than half the legal change are therefore counted as well, if they
come shortly before a jump, or while the new level after a jump is not accepted yet.

The sample with which the new level is accepted names these muscles (`newest`). Only the estimator
acts on that: it finds out why, and revokes length offsets if necessary.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.messages.arrival import longer_pause
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.reading_limits import LENGTH_JUMPED, LIMITS

#: remember a change of a length, as a possible part of a jump, if it exceeds this fraction of the
#: largest legal change
LARGE = 0.5


@dataclass(frozen=True)
class Change:
    """Sum of the changes of lengths that exceed half the legal change, over one or more messages.

    The sum over several messages shows whether a length is still at another level. The length
    itself does not show this: a module whose length jumped winds in or pays out, which can bring
    the length back to the previous value.

    Attributes:
        change: Sum of these changes [m], (M,); 0 for muscles whose length has changed little.
        allowed: The largest change that was legal in any of the messages [m], (M,).
        at: Time of reception of the last message [s].
        jumped_at: Time of the last change that was too large [s]; −∞ if none was.
    """

    change: Array
    allowed: Array
    at: float
    jumped_at: float = -math.inf

    @property
    def is_jump(self) -> bool:
        """Whether a change was too fast for a winch. If so, the lengths count as jumped."""
        return self.jumped_at > -math.inf

    def __add__(self, later: Change) -> Change:
        """Return the sum of these changes and later changes."""
        return Change(
            self.change + later.change,
            np.maximum(self.allowed, later.allowed),
            later.at,
            max(self.jumped_at, later.jumped_at),
        )

    def remaining(self, used: Bools) -> Bools:
        """Return which muscles in `used` (M,) have not returned to their level before the jump."""
        is_far: Bools = (np.abs(self.change) > self.allowed) & used
        return is_far


class LengthJumps:
    """Detects jumps between successive messages, and waits until the new level has lasted.

    Lengths are compared as they were measured, without subtracting length offsets. A change of the
    offsets therefore does not look like a jump.

    Attributes:
        newest: Indices of the muscles whose new level was accepted with the last message.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.newest: tuple[int, ...] = ()
        self.reset()

    def reset(self) -> None:
        """Discard earlier messages."""
        self._last: Array | None = None  # the last lengths, accepted or not [m], (M,)
        self._last_at = math.inf  # time of reception of the last message [s]
        self._last_delay = 0.0  # delay of the last message [s]
        self._jump: Change | None = None  # the jump whose new level is not accepted yet
        #: large changes within the last `LIMITS.glitch` that belong to no jump
        self._large: list[Change] = []

    def step(
        self, length: Array, used: Bools, now: float, delay: float = 0.0
    ) -> tuple[str, str] | None:
        """Follow the lengths of a message, and decide whether to reject it because of a jump.

        Args:
            length: Lengths as measured [m], (M,).
            used: Which muscles to check, (M,).
            now: Time of reception by a steady clock [s].
            delay: How late the message is (`Arrival.delay`) [s].

        Returns:
            Reason and detail of the rejection, for users; None if the message is accepted.
        """
        self.newest = ()
        if not self.follow(length, used, now, delay):
            return None
        jump = self._jump
        if jump is not None and jump.remaining(used).any():
            if now - jump.jumped_at <= LIMITS.settled:
                return self._problem(jump, used)
            # The new level has lasted, so it is accepted.
            self.newest = self.jumping(used)
        self._jump = None
        return None

    def follow(self, length: Array, used: Bools, now: float, delay: float = 0.0) -> bool:
        """Compare the lengths of a message with those of the previous one, and note large changes.

        A message that is rejected because of other values is followed as well, because its lengths
        show how far the arm has moved until the next message.

        Args:
            length: Lengths as measured [m], (M,). A length that is not finite is taken as
                unchanged.
            used: Which muscles to check, (M,).
            now: Time of reception by a steady clock [s].
            delay: How late the message is (`Arrival.delay`) [s].

        Returns:
            False for the first message, which cannot be compared.
        """
        last, pause = self._last, self._pause(now, delay)
        if last is not None:
            length = np.where(np.isfinite(length), length, last)
        self._last, self._last_at, self._last_delay = length, now, delay
        if last is None:
            return False
        allowed = LIMITS.step + LIMITS.speed * min(pause, LIMITS.longest_step)
        change = length - last
        is_large: Bools = (np.abs(change) > LARGE * allowed) & used
        if is_large.any():
            is_jump = bool((np.abs(change[is_large]) > allowed).any())
            large = Change(
                change=np.where(is_large, change, 0.0),
                allowed=np.where(is_large, allowed, 0.0),
                at=now,
                jumped_at=now if is_jump else -math.inf,
            )
            self._note(large)
        return True

    def _note(self, large: Change) -> None:
        """Note a large change: add it to the present jump, or begin a jump if it is too large."""
        if self._jump is not None:
            self._jump += large
            return
        self._large = [each for each in self._large if large.at - each.at <= LIMITS.glitch]
        self._large.append(large)
        if large.is_jump:
            first, *later = self._large
            self._jump, self._large = sum(later, first), []

    def jumping(self, used: Bools) -> tuple[int, ...]:
        """Return indices of the muscles in `used` (M,) whose jump has not been accepted yet.

        Messages are rejected meanwhile.
        """
        if self._jump is None:
            return ()
        return tuple(np.flatnonzero(self._jump.remaining(used)).tolist())

    def _pause(self, now: float, delay: float) -> float:
        """Return the pause between receptions or between sendings, whichever is longer [s]."""
        return longer_pause(max(now - self._last_at, 0.0), self._last_delay, delay)

    def _problem(self, jump: Change, used: Bools) -> tuple[str, str]:
        """Return reason and detail of the rejection of a message."""
        muscle = int(np.abs(jump.change * used).argmax())
        return LENGTH_JUMPED, f'{self._robot.muscles[muscle]} by {1e3 * jump.change[muscle]:.0f} mm'
