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

A failed read may be so close to the lengths before it that only the way back is a jump. Changes of
more than half the legal one are therefore counted as well, if they come shortly before a jump or
while its new level is not accepted yet.

The muscles whose new level is accepted are displaced until the next length calibration
(`DisplacedMuscles`), unless a rupture explains the jump (`PresumedRupture`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.arrival import longer_pause
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import BodyState
from musculoskeletal_ae.signals.limits import LENGTH_JUMPED, LIMITS


class JumpVerdict(NamedTuple):
    """What the lengths of one message show.

    Attributes:
        problem: Reason and detail if the message is rejected, or None.
        displaced: Muscles that are displaced from now on; usually none.
        is_unseen: Whether the displaced muscles jumped during a pause of the messages, in which the
            arm may have moved.
    """

    problem: tuple[str, str] | None = None
    displaced: tuple[int, ...] = ()
    is_unseen: bool = False


#: count a change of more than this fraction of the legal change as a possible part of a jump
LARGE = 0.5


class LargeChange(NamedTuple):
    """A message in which lengths have changed by much.

    Attributes:
        at: Time of reception by a steady clock [s].
        which: Muscles whose lengths have changed by more than `LARGE` of the legal change, (M,).
        change: Changes of all lengths since the previous message [m], (M,).
        allowed: Largest change that was legal [m].
        pause: Time since the previous message [s].
        is_jump: Whether any of the changes was too large.
    """

    at: float
    which: Bools
    change: Array
    allowed: float
    pause: float
    is_jump: bool


@dataclass
class Jump:
    """A jump whose new level is not accepted yet; arrays have the shape (M,).

    The changes that were too large, or nearly so, are added up for each muscle. The sum shows
    whether the length is still at another level. The length itself does not show this: a module
    whose length jumped winds in or pays out, which can bring the length back to the previous value.

    Attributes:
        change: Sum of these changes [m].
        allowed: The largest change that was legal at any of these changes [m].
        winding: Length that the motors can have wound in during these changes [m].
        is_unseen: Whether the first change followed a pause of the messages.
        last_at: Time of the last change that was too large [s].
    """

    change: Array
    allowed: Array
    winding: Array
    is_unseen: bool
    last_at: float = math.inf

    @classmethod
    def begin(cls, muscle_count: int, pause: float) -> Jump:
        """Return a jump without any change; `pause` [s] is the pause before its first message."""
        nothing = np.zeros(muscle_count)
        return cls(nothing, nothing.copy(), nothing.copy(), pause > LIMITS.pause)

    def add(self, large: LargeChange) -> None:
        """Add the changes of the muscles whose lengths have changed by much in one message."""
        which = large.which
        if large.is_jump:
            self.last_at = large.at
        self.change[which] += large.change[which]
        self.allowed[which] = np.maximum(self.allowed[which], large.allowed)
        self.winding[which] += LIMITS.step + LIMITS.speed * large.pause

    def remaining(self, used: Bools) -> Bools:
        """Return which muscles in `used` (M,) have not returned to their level before the jump."""
        is_far: Bools = (np.abs(self.change) > self.allowed) & used
        return is_far


class PresumedRupture:
    """Recognizes jumps of a length that a ruptured tendon may have caused.

    A motor winds in a ruptured tendon quickly. If messages are late or lost meanwhile, the length
    of this tendon appears to jump. A rupture is presumed if exactly one tendon is slack and has
    become shorter. The change must not exceed the length that the motor can have wound in since the
    last message. The muscle then does not count as displaced, and the detectors of ruptures decide.

    If the tendon pulls again, it has not ruptured. Its module may then have lost its length offset,
    so the muscle counts as displaced after all.
    """

    def __init__(self, robot: Robot) -> None:
        self._slack = LIMITS.slack_share * robot.description.tension.bias
        #: for which muscles a rupture is presumed, (M,)
        self._presumed: Bools = np.zeros(robot.muscle_count, dtype=bool)
        #: time at which each of these muscles began to pull again [s], (M,); ∞ if it does not pull
        self._taut_since: Array = np.full(robot.muscle_count, math.inf)

    def explains(self, jump: Jump, tension: Array, used: Bools) -> bool:
        """Return whether a rupture may have caused a jump; if so, remember the muscle.

        This is the case if a single tendon has jumped, is slack, and may have been wound in.

        Args:
            jump: The jump.
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
        """Return muscles that pull again, for which no rupture is presumed any more."""
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
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._last: Array | None = None  # the last lengths, accepted or not [m], (M,)
        self._last_at = math.inf  # time of reception of the last message [s]
        self._last_delay = 0.0  # delay of the last message [s]
        self._jump: Jump | None = None  # the jump whose new level is not accepted yet
        #: large changes within the last `LIMITS.glitch` that belong to no jump
        self._large: list[LargeChange] = []
        self._was_unseen = False  # `Jump.is_unseen` of the last accepted jump
        self._rupture = PresumedRupture(robot)

    def step(
        self, length: Array, tension: Array, used: Bools, now: float, delay: float = 0.0
    ) -> JumpVerdict:
        """Return what the lengths of the newest message show.

        Args:
            length: Lengths as measured [m], (M,).
            tension: Tensions as measured [N], (M,); NaN where they are unknown.
            used: Which muscles to check, (M,).
            now: Time of reception by a steady clock [s].
            delay: How late the message is (`Arrival.delay`) [s].
        """
        if not self.follow(length, used, now, delay):
            return JumpVerdict()
        jump = self._jump
        if jump is None or not jump.remaining(used).any():
            self._jump = None
            return JumpVerdict(None, self._rupture.refuted(tension, used, now), self._was_unseen)
        if now - jump.last_at <= LIMITS.settled:
            return JumpVerdict(self._problem(jump, used))
        # The new level has lasted, so it is accepted.
        self._jump, self._was_unseen = None, jump.is_unseen
        if self._rupture.explains(jump, tension, used):
            return JumpVerdict()
        muscles = np.flatnonzero(jump.remaining(used)).tolist()
        return JumpVerdict(None, tuple(muscles), jump.is_unseen)

    def follow(self, length: Array, used: Bools, now: float, delay: float = 0.0) -> bool:
        """Compare lengths with those before them; return False if there are none before them.

        This is all that happens with a message that is rejected because of other values: its
        lengths show how far the arm has moved until the next message.

        Args:
            length: Lengths as measured [m], (M,). One that is not finite counts as unchanged.
            used: Which muscles to check, (M,).
            now: Time of reception by a steady clock [s].
            delay: How late the message is (`Arrival.delay`) [s].
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
            self._note(LargeChange(now, is_large, change, allowed, pause, is_jump))
        return True

    def _note(self, large: LargeChange) -> None:
        """Note a large change: add it to the present jump, or begin one if it is too large."""
        self._large = [each for each in self._large if large.at - each.at <= LIMITS.glitch]
        if self._jump is None and not large.is_jump:
            self._large.append(large)
            return
        if self._jump is None:
            self._jump = Jump.begin(len(large.change), large.pause)
            for each in self._large:
                self._jump.add(each)
            self._large = []
        self._jump.add(large)

    def jumping(self, used: Bools) -> tuple[int, ...]:
        """Return the muscles in `used` (M,) whose new level has not been accepted yet."""
        if self._jump is None:
            return ()
        return tuple(np.flatnonzero(self._jump.remaining(used)).tolist())

    def _pause(self, now: float, delay: float) -> float:
        """Return the pause between receptions or between sendings, whichever is longer [s]."""
        return longer_pause(max(now - self._last_at, 0.0), self._last_delay, delay)

    def _problem(self, jump: Jump, used: Bools) -> tuple[str, str]:
        """Return reason and detail of the rejection of a message."""
        muscle = int(np.abs(jump.change * used).argmax())
        return LENGTH_JUMPED, f'{self._robot.muscles[muscle]} by {1e3 * jump.change[muscle]:.0f} mm'

    def calibrated(self) -> None:
        """Discard presumed ruptures, because the length offsets have been calibrated."""
        self._rupture.forget()


@dataclass
class DisplacedMuscles:
    """Records muscles whose lengths have jumped since their last length calibration.

    Attributes:
        muscles: Indices of these muscles; their lengths are not reliable.
        jumps: Number of accepted jumps since the start.
        is_unseen: Whether the last jump was during a pause of the messages, in which the arm may
            have moved.
    """

    muscles: frozenset[int] = frozenset()
    jumps: int = 0
    is_unseen: bool = False

    def note(self, verdict: JumpVerdict) -> None:
        """Note the muscles that are displaced from now on."""
        if verdict.displaced:
            self.muscles |= set(verdict.displaced)
            self.jumps += 1
            self.is_unseen = verdict.is_unseen

    def use_body(self, body: BodyState, is_calibrated: bool) -> None:
        """Remove isolated muscles, or all muscles if new length offsets have been calibrated."""
        if is_calibrated:
            self.muscles = frozenset()
        self.muscles -= set(body.isolated)
