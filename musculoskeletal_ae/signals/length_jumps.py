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

The muscles whose new level is accepted are displaced until the next length calibration, unless a
rupture explains the jump (`PresumedRupture`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.messages.arrival import longer_pause
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import BodyState
from musculoskeletal_ae.signals.limits import LENGTH_JUMPED, LIMITS, slack_tension

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
        winding: Length that the motors can have wound in during these changes [m], (M,).
        pause: Pause before the first message whose change was too large [s].
        at: Time of reception of the last message [s].
        jumped_at: Time of the last change that was too large [s]; −∞ if none was.
    """

    change: Array
    allowed: Array
    winding: Array
    pause: float
    at: float
    jumped_at: float = -math.inf

    @property
    def is_jump(self) -> bool:
        """Whether a change was too fast for a winch. If so, the lengths count as jumped."""
        return self.jumped_at > -math.inf

    @property
    def is_unseen(self) -> bool:
        """Whether the jump was during a pause of the messages, in which the arm may have moved."""
        return self.pause > LIMITS.pause

    def __add__(self, later: Change) -> Change:
        """Return the sum of these changes and later changes."""
        return Change(
            self.change + later.change,
            np.maximum(self.allowed, later.allowed),
            self.winding + later.winding,
            self.pause if self.is_jump else later.pause,
            later.at,
            max(self.jumped_at, later.jumped_at),
        )

    def remaining(self, used: Bools) -> Bools:
        """Return which muscles in `used` (M,) have not returned to their level before the jump."""
        is_far: Bools = (np.abs(self.change) > self.allowed) & used
        return is_far


class PresumedRupture:
    """Recognises jumps of a length that a ruptured tendon may have caused.

    A motor winds in a ruptured tendon quickly. If messages are late or lost meanwhile, the length
    of this tendon appears to jump. A rupture is presumed if exactly one tendon is slack and has
    become shorter. The change must not exceed the length that the motor can have wound in since the
    last message. The muscle then does not count as displaced, and the detectors of ruptures decide.

    If the tendon pulls again, it has not ruptured. Its module may then have lost its length offset,
    so the muscle counts as displaced after all.
    """

    def __init__(self, robot: Robot) -> None:
        self._slack = slack_tension(robot.description.tension.bias)
        #: for which muscles a rupture is presumed, (M,)
        self._presumed: Bools = np.zeros(robot.muscle_count, dtype=bool)
        #: time at which each of these muscles began to pull again [s], (M,); ∞ if it does not pull
        self._taut_since: Array = np.full(robot.muscle_count, math.inf)

    def explains(self, jump: Change, tension: Array, used: Bools) -> bool:
        """Return whether a rupture may have caused a jump; if so, remember the muscle.

        This is the case if a single tendon has jumped, is slack, and may have been wound in.

        Args:
            jump: The jump whose new level has lasted.
            tension: Measured tensions [N], (M,); NaN where they are unknown.
            used: Which muscles are not isolated, (M,).
        """
        muscles = np.flatnonzero(jump.remaining(used))
        slack = np.flatnonzero((tension < self._slack) & used)
        if not np.array_equal(slack, muscles) or len(muscles) != 1:
            return False
        m = muscles[0]
        if not -jump.winding[m] <= jump.change[m] < 0.0:
            return False
        self._presumed[m] = True
        return True

    def refuted(self, tension: Array, used: Bools, now: float) -> tuple[int, ...]:
        """Presume no rupture of muscles that have pulled again for `LIMITS.settled`.

        Returns:
            Indices of these muscles.
        """
        if not self._presumed.any():
            return ()
        is_taut = self._presumed & used & (tension >= self._slack)
        self._taut_since = np.where(is_taut, np.minimum(self._taut_since, now), math.inf)
        is_refuted = now - self._taut_since > LIMITS.settled
        self._presumed &= ~is_refuted
        return tuple(np.flatnonzero(is_refuted).tolist())

    def forget(self) -> None:
        """Forget all presumed ruptures, because the length offsets have been calibrated."""
        self._presumed[:] = False


class LengthJumps:
    """Detects jumps between successive messages, and waits until the new level has lasted.

    Lengths are compared as they were measured, without subtracting length offsets. A change of the
    offsets therefore does not look like a jump.

    Attributes:
        displaced: Indices of the muscles whose lengths have jumped since their last length
            calibration; these lengths are not reliable.
        newest: Indices of the muscles whose new level was accepted with the last message.
        is_unseen: Whether the last of these jumps was during a pause of the messages
            (`Change.is_unseen`).
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.displaced: frozenset[int] = frozenset()
        self.newest: tuple[int, ...] = ()
        self.is_unseen = False
        self.reset()

    def reset(self) -> None:
        """Discard earlier messages; muscles remain displaced."""
        self._last: Array | None = None  # the last lengths, accepted or not [m], (M,)
        self._last_at = math.inf  # time of reception of the last message [s]
        self._last_delay = 0.0  # delay of the last message [s]
        self._jump: Change | None = None  # the jump whose new level is not accepted yet
        #: large changes within the last `LIMITS.glitch` that belong to no jump
        self._large: list[Change] = []
        self._was_unseen = False  # `Change.is_unseen` of the last accepted jump
        self._rupture = PresumedRupture(self._robot)

    def step(
        self, length: Array, tension: Array, used: Bools, now: float, delay: float = 0.0
    ) -> tuple[str, str] | None:
        """Follow the lengths of a message, and decide whether to reject it because of a jump.

        Args:
            length: Lengths as measured [m], (M,).
            tension: Tensions as measured [N], (M,); NaN where they are unknown.
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
        if jump is None or not jump.remaining(used).any():
            self._jump = None
            self._displace(self._rupture.refuted(tension, used, now))
            return None
        if now - jump.jumped_at <= LIMITS.settled:
            return self._problem(jump, used)
        # The new level has lasted, so it is accepted.
        self._jump, self._was_unseen = None, jump.is_unseen
        if not self._rupture.explains(jump, tension, used):
            self._displace(tuple(np.flatnonzero(jump.remaining(used)).tolist()))
        return None

    def _displace(self, muscles: tuple[int, ...]) -> None:
        self.newest = muscles
        if muscles:
            self.displaced |= set(muscles)
            self.is_unseen = self._was_unseen

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
                winding=np.where(is_large, LIMITS.step + LIMITS.speed * pause, 0.0),
                pause=pause,
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

    def use_body(self, body: BodyState, is_calibrated: bool) -> None:
        """Use another body state: remove its isolated muscles from `displaced`.

        Args:
            body: The body state that applies from now on.
            is_calibrated: Whether new length offsets have been calibrated. If so, `displaced` is
                emptied, and no rupture is presumed any more.
        """
        if is_calibrated:
            self._rupture.forget()
            self.displaced = frozenset()
        self.displaced -= set(body.isolated)
