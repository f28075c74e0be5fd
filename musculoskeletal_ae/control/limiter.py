# SPDX-License-Identifier: Apache-2.0
"""The limiter: the final check of every command before publication.

    desired ─► rate limit ─► tension limit ─► finite check ─► published

Muscle stiffness control exerts T_bias + K_stiff (l − l_target). Therefore the tension limit of a
muscle limits its commanded length. With the measured length l and tension T, the lag λ of the
muscle module and a tension feedback r:

    l_target ≥ l + l_comp(T_limit) + r − λ max(0, −dl/dt),   l_comp(T) = −(T − T_bias) / K_stiff
    dr/dt = RELIEF (T − T_limit)/K_stiff,   0 ≤ r ≤ −l_comp(T_limit)

No module is commanded to exert more than T_limit, whatever a plan, a feedback, a wrong network or
contact demands. While a muscle winds in (dl/dt < 0), its motor lags behind the command (`winches`).
A part λ K_stiff |dl/dt| of the demanded tension then only turns the motor, and does not reach the
tendon. Therefore the command may lead the length by λ |dl/dt|. This lead ends when the muscle stops
winding in, or as soon as the measured tension is above the limit.

If the measured tension exceeds the limit nevertheless, for example because K_stiff or a sensor is
wrong, the feedback r pays the muscle out further. A muscle whose measured tension is above
`tension.limit` may be paid out faster than the rate limit. No muscle is wound in faster than the
rate limit. A muscle is also paid out if its tension is above `tension.limit` in a rejected message,
for example after a jump of lengths.

Position-controlled modules turn a command into tension by stretching the series elastic elements:

    l_target ≥ l − SHARE (L_e(T_limit) − L_e(T′)) + r        while T ≤ T_limit, T′ = T + AHEAD dT/dt
    l_target ≥ l + L_e(T) − L_e(T_limit) + r = l_exceeded    while T > T_limit
    l_target ≥ l_exceeded, which shortens at RECOVERY        after T has exceeded T_limit

L_e is the elongation of the series elastic element; the constants are in `robot/actuation.py`.
Since T is measured, the limit holds in any posture and for any error of the network. l_exceeded
shortens slowly, because tendon friction and the age of T would otherwise make a muscle at its limit
oscillate (`recovered`). These modules receive length commands only: a desired tension becomes the
length that corrects the fraction `ADMITTANCE` of the tension error.

A tension that is computed from a motor current is uncertain (`signals.friction.Transmission`). With
the standard deviation σ_T of this tension, its limit is lowered by CONFIDENCE σ_T, so that the true
tension does not exceed T_limit.

T_limit is the smallest of `tension.limit`, the momentary limit from the temperature of the motors
(`watchdog.HeatLimit`) and, while the length offsets are unknown, `calibration_motion.gentle_limit`.

The rate limit applies to the change since the last published command, in every mode. Length and
tension commands are compared by the tension that they demand of a module:

    T_target = T_bias + max(0, K_stiff (l − l_target))

All commanded lengths above l demand T_bias. Of these lengths, the one nearest to the last published
length is used. The first command keeps the present tensions, because a restarted controller does
not know the earlier commands.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Setup
from musculoskeletal_ae.motion.activities import (
    LENGTH,
    TENSION,
    Command,
    msc_compensation,
    unchanging,
)
from musculoskeletal_ae.robot.model_errors import LARGEST
from musculoskeletal_ae.signals.muscle_states import MuscleReadings
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

POSTURES = 200  # sample this many random postures to find the longest length of each muscle
LONGEST_INTERVAL = 0.05  # assume dT/dt = 0 if two messages are further apart than this [s]
CONFIDENCE = 2.0  # lower the tension limit by this many standard deviations of the measured tension
#: gain of the tension feedback r [1/s]; its time constant of 0.2 s is long compared with the lag of
#: a module, which is about 30 ms
RELIEF = 5.0


class CommandLimiter:
    """Limits commands relative to the last published command.

    Attributes:
        command: The last published command, or None.
        slack_length: Commanded length at which each muscle is slack in any posture [m], (M,).
        span: By how much `slack_length` exceeds the shortest length of each muscle [m], (M,).
        offsets_known: Whether the length offsets are known.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup, robot = setup, setup.robot
        self.command: Command | None = None
        #: last published length command [m], (M,), and its age [s]
        self._last_length: tuple[Array, float] | None = None
        #: length r by which each muscle is paid out further while T is too high [m], (M,)
        self._relief: Array = np.zeros(robot.muscle_count)
        #: time of sending [s], T [N] and dT/dt [N/s], (M,), of the last message
        self._tension: tuple[float, Array, Array] | None = None
        #: l_exceeded of each muscle (see the module's description) [m], (M,)
        self._exceeded: Array = np.full(robot.muscle_count, -np.inf)
        self.offsets_known = True
        postures = robot.random_postures(POSTURES, np.random.default_rng(0))
        lengths = robot.routes.relative_lengths(postures)
        self.slack_length: Array = lengths.max(axis=0) + LARGEST
        self.span: Array = self.slack_length - lengths.min(axis=0)

    @property
    def longest(self) -> Array:
        """Largest possible muscle lengths [m], (M,); infinite while the offsets are unknown."""
        return self.slack_length if self.offsets_known else np.full_like(self.slack_length, np.inf)

    def restart(self, sample: MuscleSample, may_pull_harder: bool = True) -> None:
        """Replace the last command by one that keeps the present tensions, if there is one.

        Args:
            sample: The newest muscle states.
            may_pull_harder: Whether the new command may demand more of a muscle than the last one,
                which it must not while the arm is stopped.
        """
        if self.command is None:
            return
        before, self.command = self.command, None
        kind, self.command = before.kind, self.last(before.kind, sample)
        if not may_pull_harder:
            softer = np.maximum if kind == LENGTH else np.minimum
            self.command = Command(kind, softer(self.command.value, before.value))
        if kind == LENGTH:
            self._last_length = self.command.value, 0.0

    def shift(self, offset: Array) -> None:
        """Shift the last commands to new length offsets, which are larger by `offset` [m], (M,).

        Corrected lengths are shorter by the same amount, and so are the stored length commands.
        """
        self._exceeded = self._exceeded - offset
        if self._last_length is not None:
            self._last_length = self._last_length[0] - offset, self._last_length[1]
        if self.command is not None and self.command.kind == LENGTH:
            self.command = Command(LENGTH, self.command.value - offset)

    def last(self, kind: str, sample: MuscleSample) -> Command:
        """Return the last command, converted to the given kind (`LENGTH` or `TENSION`).

        Before the first command, return a command that keeps the present tensions.
        """
        if self.command is None:
            command = unchanging(self._setup.robot, kind, sample)
            if kind == LENGTH:
                command = Command(kind, np.minimum(command.value, self.longest))
            return command
        if self.command.kind == kind:
            return self.command
        if kind == TENSION:
            before, tension = self.command.value, sample.motor_tension
            present = self._setup.robot.actuation.present_tension(sample.length, before, tension)
            return Command(TENSION, present)
        return Command(LENGTH, self._length_demanding(self.command.value, sample))

    def _length_demanding(self, tension: Array, sample: MuscleSample) -> Array:
        """Return length commands [m], (M,), that demand given tensions [N], (M,).

        If several lengths demand a tension, the one nearest to the last published length is chosen.
        The lengths are not shorter than the rate limit permits since that length.
        """
        robot = self._setup.robot
        demand = np.maximum(tension, robot.tension.bias)
        length = np.minimum(sample.length, self.longest) + msc_compensation(robot, demand)
        if self._last_length is None:
            return length
        before, age = self._last_length
        length = np.where(demand > robot.tension.bias, length, np.maximum(length, before))
        return np.maximum(length, before - self.largest_change(LENGTH, age))

    def largest_change(self, kind: str, dt: float) -> Array:
        """Return the largest change within dt [s] of a length command [m] or tension command [N].

        The result has the shape (M,).
        """
        actuation, bias = self._setup.robot.actuation, self._setup.robot.tension.bias
        rate = actuation.fastest(self._setup.settings.rate_limit) * dt
        return rate if kind == LENGTH else rate * actuation.tension_per_length(bias)

    def limit(
        self,
        desired: Command,
        sample: MuscleSample,
        tension_limit: Array,
        dt: float,
        lead: Array | float = 0.0,
        rejected: MuscleReadings | None = None,
    ) -> Command | None:
        """Limit a command and record the result as published.

        Args:
            desired: The desired command.
            sample: The newest muscle states.
            tension_limit: Momentary limit of each tension [N], (M,); the lower one of this and
                the robot's `tension.limit` applies.
            dt: Time since the last command [s].
            lead: Length by which each command may lead the measured length while the muscle winds
                in, λ max(0, −dl/dt) [m], (M,).
            rejected: `RejectionError.plausible` if the newest message was rejected; else None.

        Returns:
            The limited command. None if it is not finite; the last command then stays valid.
        """
        actuation = self._setup.robot.actuation
        kind = desired.kind
        if kind == TENSION:
            length, tension = sample.length, sample.motor_tension
            kind, value = actuation.command_for(length, tension, desired.value)
            if kind == LENGTH:  # readings of isolated muscles may be wrong
                value = np.where(self._setup.robot.used, value, self.slack_length)
            desired = Command(kind, value)
        before = self.last(kind, sample).value
        change = self.largest_change(kind, dt)
        value = np.clip(desired.value, before - change, before + change)
        # Isolated muscles have a limit of 0 in `_robot`. Use the limits of the full description
        # instead, because a suspect is isolated, but is wound in to verify the fault.
        limit = np.minimum(tension_limit, self._setup.robot.description.tension.limit)
        limit = self._certain(limit, sample)
        if kind == TENSION:
            # The last command of a muscle that was isolated may be below T_bias. Such a command
            # rises to T_bias at the limited rate.
            least = np.minimum(self._setup.robot.tension.bias, before)
            value = np.clip(value, least, limit)
        else:
            shortest = self._shortest(before, change, sample, limit, dt)
            is_relaxed = sample.motor_tension * sample.usable <= limit
            shortest -= actuation.usable_lead(lead) * is_relaxed
            value = np.maximum(value, shortest)
            if rejected is not None:
                value = np.maximum(value, self._relieved(rejected, sample, limit))
        if not np.isfinite(value).all():
            return None
        self.command = Command(kind, value)
        if kind == LENGTH:
            self._last_length = value, 0.0
        elif self._last_length is not None:
            self._last_length = self._last_length[0], self._last_length[1] + dt
        return self.command

    def _certain(self, limit: Array, sample: MuscleSample) -> Array:
        """Return `limit` [N], (M,), lowered by the uncertainty of the measured tension.

        The result is not lowered below T_bias, so that uncertainty alone makes no tendon slack.
        """
        bias = self._setup.robot.description.tension.bias
        return np.maximum(limit - CONFIDENCE * sample.tension_spread, np.minimum(limit, bias))

    def _relieved(self, rejected: MuscleReadings, sample: MuscleSample, limit: Array) -> Array:
        """Return lower bounds of the length commands [m], (M,), due to rejected messages.

        A module compares l_target with its own reading of l. If this reading jumps, the module
        may wind in until the tension is beyond the limit. Therefore l_target of a muscle whose
        tension is too high has to follow the jump. For all other muscles, the bound is −∞.

        Args:
            rejected: Readings of rejected messages; −∞ where they are implausible.
            sample: The last accepted muscle states.
            limit: Tension limit [N], (M,).
        """
        tension = np.where(sample.usable, rejected.tension, -np.inf)
        too_tense = tension > self._setup.robot.description.tension.limit
        depth = self._setup.robot.actuation.depth(
            np.where(too_tense, tension, 0.0), np.zeros_like(tension), limit
        )
        relieved: Array = np.where(too_tense, rejected.length - depth, -np.inf)
        return relieved

    def _tension_rate(self, time: float, tension: Array) -> Array:
        """Return the rates of change of the tensions [N/s], (M,), between the last two messages.

        `tension` [N], (M,), are those of the last message, which was sent at `time` [s].
        """
        rate = np.zeros_like(tension)
        if self._tension is not None:
            before, old, rate = self._tension
            if 0.0 < time - before < LONGEST_INTERVAL:
                rate = (tension - old) / (time - before)
            elif time != before:
                rate = np.zeros_like(tension)
        self._tension = time, tension, rate
        return rate

    def _shortest(
        self, before: Array, change: Array, sample: MuscleSample, limit: Array, dt: float
    ) -> Array:
        """Return the shortest length commands [m], (M,), that demand no tension above the limit.

        Unless a measured tension is too high, they exceed the last command `before` by at most
        `change`, both [m], (M,). `limit` is in [N], (M,), and dt in [s].
        """
        robot, actuation = self._setup.robot, self._setup.robot.actuation
        tension = sample.motor_tension * sample.usable * robot.tension_source.is_known
        rate = self._tension_rate(sample.sent_at, tension)
        depth, most = actuation.depth(tension, rate, limit), actuation.largest_depth(limit)
        per_length = actuation.tension_per_length(limit)
        self._relief = np.clip(
            self._relief + RELIEF * dt * (tension - limit) / per_length, 0.0, most
        )
        length = np.minimum(sample.length, self.longest)
        recovered = actuation.recovered(self._exceeded, dt)
        exceeded = np.maximum(recovered, length - depth)
        self._exceeded = np.where(tension > limit, exceeded, recovered)
        shortest = np.maximum(length - depth + self._relief, self._exceeded)
        # Exceed the rate limit only if the measured tension is too high. A length alone is no
        # reason, because a length sensor may be wrong.
        too_tense = tension > robot.description.tension.limit
        return np.where(too_tense, shortest, np.minimum(shortest, before + change))
