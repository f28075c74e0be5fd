# SPDX-License-Identifier: Apache-2.0
"""Converts raw `muscle_states` messages to checked samples.

    message ─► shape, finite ─► plausible level ─► plausible step ─► median ─► length offset
            ─► tendon friction, plausible temperature ─► MuscleSample

A message that fails a check raises a `RejectionError`, which names the reason, the value and the
legal range. Nodes, bags and experiments all use `MuscleStream`; `signals/limits.py` has the limits.
Values of isolated muscles are not checked. A rejected message may contain valid tensions, for
example if only a length jumped. `RejectionError.pull` contains them, for the limiter.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints, median_of_rows
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import BodyState
from musculoskeletal_ae.signals.friction import FrictionDirection, Transmission
from musculoskeletal_ae.signals.limits import (
    LENGTH,
    LENGTH_JUMPED,
    LIMITS,
    TEMPERATURE,
    TENSION,
    Persistence,
    longest_lengths,
    reading_range,
)
from musculoskeletal_ae.validity import QUANTITIES, read_muscle_states


class RejectionError(MessageError):
    """A message is rejected.

    Attributes:
        reason: Short text under which the message is counted.
        states: The raw l, T and temperature, (3, M); None if the message had another shape.
        pull: l [m] with the length offset removed, and T_read [N], (2, M): medians of the last
            messages, including rejected ones; −∞ where they are implausible. None if there are not
            enough messages.
    """

    def __init__(
        self, reason: str, detail: str, states: Array | None = None, pull: Array | None = None
    ) -> None:
        super().__init__(reason, detail)
        self.states, self.pull = states, pull


@dataclass(frozen=True)
class MuscleSample:
    """A checked message of the muscle modules. Arrays have the shape (M,).

    Attributes:
        time: Time of reception by the caller's clock [s].
        length: l, with the length offset removed [m].
        length_read: l as the sensor measured it [m].
        tension_read: T_read [N], the reading of the tension sensor, or the motor current converted
            to newtons; NaN where tension is not known.
        motor_tension: Motor-side tension T [N]; NaN where it is not known. It equals T_read for
            tension sensors, and for motor currents until their friction has been learned.
        bone_tension: Bone-side tension T_end, with tendon friction removed [N]. Where tension is
            not known, it is the tension that models assume (`Actuation.assumed_tension`).
        sliding: Direction in which each tendon slid last: 1 when wound in, −1 when paid out.
        temperature: Plausible temperature of the module's housing [°C]; NaN where it is unknown.
        usable: Which muscles are not isolated.
        newest: l (offset removed), T and temperature of the last message alone, without the median
            filter, (3, M).
        jumped: Muscles whose new level after a jump is accepted with this message; usually none.
        tension_spread: Standard deviation σ_T of T [N]; 0 for tension sensors.
    """

    time: float
    length: Array
    length_read: Array
    tension_read: Array
    motor_tension: Array
    bone_tension: Array
    sliding: Array
    temperature: Array
    usable: Bools
    newest: Array
    jumped: tuple[int, ...] = ()
    tension_spread: Array | float = 0.0

    @property
    def model_tension(self) -> Array:
        """T [N] (M,) as measured, or as models assume it where it is not known."""
        tension: Array = np.where(
            np.isnan(self.motor_tension), self.bone_tension, self.motor_tension
        )
        return tension

    @property
    def learned_tension(self) -> Array:
        """T_read [N] (M,), or the tension that models assume where it is not known."""
        tension: Array = np.where(np.isnan(self.tension_read), self.bone_tension, self.tension_read)
        return tension

    def shifted(self, offset: Array) -> MuscleSample:
        """Return the same sample with lengths reduced by `offset` [m], (M,)."""
        newest = self.newest.copy()
        newest[0] -= offset
        return replace(self, length=self.length - offset, newest=newest)


class LevelCheck:
    """Checks every value of a message against the limits of plausible sensor values."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        longest = longest_lengths(robot)
        (least, most), ones = reading_range(robot), np.ones_like(longest)
        #: lowest and highest l [m], T [N] and temperature [°C], (3, M)
        self._low = np.array([-longest, least, LIMITS.lowest_temperature * ones])
        self._high = np.array([longest, most, LIMITS.highest_temperature * ones])
        self._slack = LIMITS.slack_share * robot.description.tension.bias

    def plausible_pull(self, states: Array, offset: Array) -> Array:
        """Return l [m] with `offset` [m] (M,) removed and T [N], (2, M); −∞ where implausible.

        A length may be as far beyond any posture as that of a module that lost its length offset.
        """
        pull = states[:2].copy()
        pull[0] -= offset
        margin = np.array([[LIMITS.slack_length_margin], [0.0]])
        legal = (pull >= self._low[:2] - margin) & (pull <= self._high[:2] + margin)
        plausible: Array = np.where(legal, pull, -np.inf)
        return plausible

    def problem(self, states: Array, used: Bools, lengths_known: bool) -> tuple[str, str] | None:
        """Return reason and detail of the first implausible value, or None.

        Args:
            states: l [m], T [N] and temperature [°C] (3, M); NaN is ignored.
            used: Which muscles to check, (M,).
            lengths_known: Whether to check l, which requires known length offsets.
        """
        low = self._low.copy()
        # A slack tendon, such as that of a ruptured muscle, can be wound in beyond any posture.
        low[0] -= np.where(states[1] < self._slack, LIMITS.slack_length_margin, 0.0)
        beyond = ((states < low) | (states > self._high)) & used
        beyond[0] &= lengths_known
        if not np.count_nonzero(beyond):
            return None
        quantity, muscle = np.argwhere(beyond)[0]
        reason, unit = ((LENGTH, 'm'), (TENSION, 'N'), (TEMPERATURE, '°C'))[quantity]
        place = quantity, muscle
        value, least, most = distinct(states[place], low[place], self._high[place])
        legal = f'{least} to {most} {unit}'
        return reason, f'{self._robot.muscles[muscle]} {value} {unit}, legal: {legal}'


class StepCheck:
    """Checks that no length changes faster than a muscle can; accepts a new level that lasts.

    The changes between messages that are too large are added up for each muscle. The sum shows
    whether a length is still at another level. Its present value does not: a module whose length
    jumped winds in or pays out, which can bring the length back to the previous value.

    It uses lengths as measured, so that new length offsets do not look like jumps.

    A motor winds in a ruptured tendon quickly. If messages are late or lost meanwhile, its length
    appears to jump as well. One slack tendon that has become shorter while the others pull is
    therefore accepted without being named, and left to the detectors of ruptures. This requires
    that the motor can have wound in so much since the last message. If the tendon pulls again, it
    has not ruptured: its module may have lost its length offset, so the muscle is named then.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._slack = LIMITS.slack_share * robot.description.tension.bias
        self._last: Array | None = None  # the last lengths, accepted or not [m], (M,)
        self._last_at = math.inf  # time of the last message [s]
        #: sum of the jumps since the last accepted message [m], (M,)
        self._jump: Array = np.zeros(robot.muscle_count)
        #: the largest change that was legal at any of these jumps [m], (M,)
        self._allowed: Array = np.zeros(robot.muscle_count)
        self._winding: Array = np.zeros(robot.muscle_count)  # what motors can have wound in [m]
        #: which muscles have a jump that is not named because a rupture explains it, (M,)
        self._unnamed: Bools = np.zeros(robot.muscle_count, dtype=bool)
        #: time since when each of these pulls again [s]; ∞ if it does not, (M,)
        self._taut_since: Array = np.full(robot.muscle_count, math.inf)
        self._settled_since = math.inf  # time of the last jump [s]; ∞ if there is none
        self._after_pause = False  # whether the first jump followed a pause of the messages
        self.jumped: tuple[int, ...] = ()  # muscles whose new level was just accepted
        self.jumped_in_pause = False

    def problem(
        self, length: Array, tension: Array, used: Bools, now: float
    ) -> tuple[str, str] | None:
        """Return reason and detail if a length jumped, or None.

        When a new level is accepted, `jumped` contains the muscles that have jumped to it.

        Args:
            length: Lengths as measured [m], (M,).
            tension: T_read [N], (M,); NaN where it is unknown.
            used: Which muscles to check, (M,).
            now: Time of reception by a steady clock [s].
        """
        self.jumped = ()
        last, pause = self._last, max(now - self._last_at, 0.0)
        self._last, self._last_at = length, now
        if last is None:
            return None
        allowed = LIMITS.step + LIMITS.speed * min(pause, LIMITS.longest_step)
        change = length - last
        jumps = (np.abs(change) > allowed) & used
        if jumps.any():
            if self._settled_since == math.inf:
                self._after_pause = pause > LIMITS.pause
            self._settled_since = now
            self._jump[jumps] += change[jumps]
            self._allowed[jumps] = np.maximum(self._allowed[jumps], allowed)
            self._winding[jumps] += LIMITS.step + LIMITS.speed * pause
        far = (np.abs(self._jump) > self._allowed) & used
        if not far.any():
            self._accept()
            self.jumped = self._taut_again(tension, used, now)
            return None
        if now - self._settled_since > LIMITS.settled:
            muscles = np.flatnonzero(far)
            if self._is_rupture(muscles, tension, used):
                self._unnamed[muscles] = True
            else:
                self.jumped = tuple(muscles.tolist())
            self.jumped_in_pause = self._after_pause
            self._accept()
            return None
        muscle = int(np.abs(self._jump * used).argmax())
        by = 1e3 * self._jump[muscle]
        return LENGTH_JUMPED, f'{self._robot.muscles[muscle]} by {by:.0f} mm'

    def _is_rupture(self, far: Ints, tension: Array, used: Bools) -> bool:
        """Return whether one tendon alone is slack and wound in, as after a rupture."""
        slack = np.flatnonzero((tension < self._slack) & used)
        if not np.array_equal(slack, far) or len(far) != 1:
            return False
        return bool(-self._winding[far[0]] <= self._jump[far[0]] < 0.0)

    def _taut_again(self, tension: Array, used: Bools, now: float) -> tuple[int, ...]:
        """Return muscles that pull although a rupture seemed to explain their jump."""
        if not self._unnamed.any():
            return ()
        is_taut = self._unnamed & used & (tension >= self._slack)
        self._taut_since = np.where(is_taut, np.minimum(self._taut_since, now), math.inf)
        named = now - self._taut_since > LIMITS.settled
        self._unnamed &= ~named
        return tuple(np.flatnonzero(named).tolist())

    def forget_jumps(self) -> None:
        """Forget unnamed jumps, because the length offsets have been calibrated."""
        self._unnamed[:] = False

    def _accept(self) -> None:
        self._jump[:] = self._allowed[:] = self._winding[:] = 0.0
        self._settled_since = math.inf


class TemperatureCheck:
    """Accepts a temperature only if the housing can have reached it since the last accepted one.

    A few messages with 199 °C have no effect. A sensor that continues to read 199 °C is accepted
    some seconds later, because a hot module must stop the arm.
    """

    def __init__(self, muscle_count: int) -> None:
        self._believed: Array = np.full(muscle_count, math.nan)  # last accepted [°C], (M,)
        self._age: Array = np.zeros(muscle_count)  # age of the last accepted temperature [s]
        self._first: Array = self._believed.copy()  # candidate for the first temperature [°C]
        #: time for which readings have agreed with it [s]
        self._first_age: Array = np.zeros(muscle_count)
        self._last_at = math.nan

    def step(self, read: Array, now: float) -> Array:
        """Return the accepted temperatures [°C] (M,), or NaN, after readings at `now` [s]."""
        elapsed = max(now - self._last_at, 0.0) if math.isfinite(self._last_at) else 0.0
        self._last_at = now
        possible = (read >= LIMITS.lowest_temperature) & (read <= LIMITS.highest_temperature)
        self._age += elapsed
        change = LIMITS.temperature_step + LIMITS.temperature_rate * self._age
        accepted = possible & (np.abs(read - self._believed) <= change)
        accepted |= self._begins(np.where(possible, read, math.nan), elapsed)
        self._believed = np.where(accepted, read, self._believed)
        self._age = np.where(accepted, 0.0, self._age)
        return np.where(possible, self._believed, math.nan)

    def _begins(self, read: Array, elapsed: float) -> Bools:
        """Return where readings have agreed long enough to accept a first temperature, (M,)."""
        agrees = np.abs(read - self._first) <= LIMITS.temperature_step
        self._first_age = np.where(agrees, self._first_age + elapsed, 0.0)
        self._first = np.where(agrees, self._first, read)
        begins: Bools = np.isnan(self._believed) & (self._first_age > LIMITS.glitch)
        return begins


class MuscleStream:
    """Turns the messages of one arm's muscle modules into samples.

    Attributes:
        body: Length offsets and isolated muscles.
        displaced: Muscles whose lengths have jumped to another level since their last length
            calibration. Their lengths are not reliable.
        jumps: Number of times that lengths have jumped to another level.
        has_displaced_unseen: Whether the last jump was during a pause of the messages, in which
            the arm may have moved.
    """

    def __init__(self, robot: Robot, body: BodyState | None = None, window: int = 1) -> None:
        """Start without messages.

        Args:
            robot: The nominal body.
            body: Length offsets and isolated muscles; by default, offsets of 0 and no isolated
                muscle.
            window: Number of messages in the median filter against outliers; 1 for no filter.
        """
        self._robot = robot
        self.body = body or BodyState.healthy(robot.muscle_count)
        self.use_transmission(Transmission(np.zeros(robot.muscle_count)))
        self._levels = LevelCheck(robot)
        self._window = window
        #: the last messages as measured, (3, M) each
        self._readings: deque[Array] = deque(maxlen=window)
        #: the last messages, including rejected ones, (3, M) each
        self._all_readings: deque[Array] = deque(maxlen=window)
        self._implausible = Persistence()
        self.displaced: frozenset[int] = frozenset()
        self.has_displaced_unseen = False
        self.jumps = 0
        self._temperatures = TemperatureCheck(robot.muscle_count)
        self.reset()

    def reset(self) -> None:
        """Discard earlier messages, for example after a jump of the clock."""
        self._steps = StepCheck(self._robot)
        self._direction = FrictionDirection()
        self._readings.clear()
        self._all_readings.clear()
        self._time = math.inf

    def use_transmission(self, transmission: Transmission) -> None:
        """Remove friction and errors of the readings of tension from now on; at first, none."""
        if self._robot.tension_source.is_current and transmission.drive is None:
            unknown = Transmission.unknown(self._robot.description.tension.limit)
            transmission = replace(unknown, friction=transmission.friction)
        self._transmission = transmission

    def use_body(self, body: BodyState) -> None:
        """Use another body state from now on."""
        if body.offsets is not self.body.offsets:  # the change of lengths is not a motion
            self._direction = FrictionDirection()
            if not body.offsets.is_suspect:
                self.displaced = frozenset()
                self._steps.forget_jumps()
        self.displaced -= set(body.isolated)
        self.body = body

    def implausible(self, now: float) -> str:
        """Return why messages have been implausible for longer than a glitch, or ''."""
        return self._implausible.lasting(now)

    def take(self, message: Any, time: float, now: float | None = None) -> MuscleSample:
        """Check and convert a Float64MultiArray message.

        Args:
            message: The message.
            time: Time of reception by the caller's clock [s].
            now: Time of reception by a steady clock [s]; None if `time` is by a steady clock.

        Raises:
            RejectionError: If the message is invalid or implausible.
        """
        muscle_count = self._robot.muscle_count
        try:
            states = read_muscle_states(
                message,
                muscle_count,
                self.body.isolated,
                source=self._robot.tension_source,
            )
        except MessageError as error:
            raw = None
            if len(message.data) == len(QUANTITIES) * muscle_count:
                raw = np.reshape(np.array(message.data, dtype=float), (len(QUANTITIES), -1))
            pull = None if raw is None else self._pull(raw)
            raise RejectionError(error.reason, str(error).partition(': ')[2], raw, pull) from error
        return self.take_states(states, time, now)

    def take_states(self, states: Array, time: float, now: float | None = None) -> MuscleSample:
        """Check and convert values as measured: l [m], T_read [N] and temperature [°C], (3, M).

        `take` describes the times.

        Raises:
            RejectionError: If they are implausible.
        """
        now = time if now is None else now
        offsets = self.body.offsets
        states = states.copy()
        states[1] = self._robot.tension_source.known(states[1])
        newest = states.copy()
        newest[0] -= offsets.offset
        problem = self._problem(states, newest, now)
        self._implausible.note('' if problem is None else ': '.join(problem), now)
        if problem is not None:
            raise RejectionError(*problem, states, self._pull(states))
        self._all_readings.append(states)
        if not 0.0 <= time - self._time <= LIMITS.pause:
            self._direction.reset()
        self._time = time
        self._readings.append(states)
        read = states if len(self._readings) == 1 else median_of_rows(np.array(self._readings))
        length = read[0] - offsets.offset
        sliding = self._direction.step(length)
        newest[1] = self._transmission.motor(newest[1], sliding)
        end = self._transmission.end(read[1], sliding)
        return MuscleSample(
            time=time,
            length=length,
            length_read=read[0],
            tension_read=read[1],
            motor_tension=self._transmission.motor(read[1], sliding),
            bone_tension=self._robot.actuation.known_tension(end),
            sliding=sliding,
            temperature=self._temperatures.step(read[2], now),
            usable=self.body.used,
            newest=newest,
            jumped=self._steps.jumped,
            tension_spread=self._transmission.spread(read[1], sliding),
        )

    def _pull(self, states: Array) -> Array | None:
        """Record the raw values of a rejected message; return `RejectionError.pull`."""
        self._all_readings.append(states)
        if len(self._all_readings) < self._window:
            return None
        offset = self.body.offsets.offset
        each = [self._levels.plausible_pull(one, offset) for one in self._all_readings]
        return median_of_rows(np.array(each))

    def _problem(self, read: Array, states: Array, now: float) -> tuple[str, str] | None:
        known, steps = self.body.offsets.known, self._steps
        problem = self._levels.problem(states, self.body.used, known)
        if problem is not None:
            return problem
        problem = steps.problem(read[0], read[1], self.body.used, now)
        if steps.jumped:
            self.has_displaced_unseen = steps.jumped_in_pause
            self.displaced |= set(steps.jumped)
            self.jumps += 1
        return problem if known else None
