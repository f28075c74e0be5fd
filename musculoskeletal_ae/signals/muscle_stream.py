# SPDX-License-Identifier: Apache-2.0
"""Converts raw `muscle_states` messages to checked samples.

    message ─► shape, finite ─► plausible level ─► plausible step ─► median ─► length offset
            ─► tendon friction, plausible temperature ─► MuscleSample

A message with an illegal shape, an implausible level or a jump raises a `RejectionError`, which
names the reason and the value; for a level also the legal range. A temperature that changes
implausibly fast does not reject a message: the sample has the last accepted temperature. Nodes,
bags and experiments all use `MuscleStream`; `signals/reading_limits.py` has the limits. Values of
isolated muscles are not checked. A rejected message may contain valid tensions, for example if only
a length jumped. `RejectionError.plausible` contains these tensions for the limiter. After a jump,
messages are rejected until the new level has lasted (`length_jumps`). While the length offsets are
unknown, no message is rejected because of a jump or the level of a length.
"""

from __future__ import annotations

import math
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.messages.arrival import longer_pause
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import BodyState
from musculoskeletal_ae.signals.friction import FrictionDirection, Transmission
from musculoskeletal_ae.signals.length_jumps import LengthJumps
from musculoskeletal_ae.signals.muscle_states import (
    MuscleReadings,
    raw_muscle_states,
    read_muscle_states,
)
from musculoskeletal_ae.signals.plausibility import LevelCheck, TemperatureCheck
from musculoskeletal_ae.signals.reading_limits import LIMITS, Persistence


class RejectionError(MessageError):
    """A message of the muscle modules is rejected because it is invalid or implausible.

    Attributes:
        reason: Short text for users under which rejected messages are counted.
        readings: The raw readings; None if the message had another shape.
        plausible: The medians of the last messages, including rejected ones, with the length offset
            removed; −∞ where they are implausible. None if there are not enough messages.
    """

    def __init__(
        self,
        reason: str,
        detail: str,
        readings: MuscleReadings | None = None,
        plausible: MuscleReadings | None = None,
    ) -> None:
        super().__init__(reason, detail)
        self.readings, self.plausible = readings, plausible


@dataclass(frozen=True)
class MuscleSample:
    """A checked message of the muscle modules. Arrays have the shape (M,).

    If the robot does not measure tensions, all three tensions are the one that models assume
    (`Actuation.assumed_tension`). Lengths and tensions of isolated muscles are 0 where the sensor
    reads NaN, so that none of them is NaN.

    Attributes:
        time: Time of reception by the caller's clock [s].
        length: l, with the length offset removed [m].
        length_read: l as the sensor measured it [m].
        tension_read: T_read [N], the reading of the tension sensor, or the motor current converted
            to newtons.
        motor_tension: Motor-side tension T [N]. It equals T_read for tension sensors. For motor
            currents, it is max(0, T_read) until the friction of the drives has been learned.
        bone_tension: Bone-side tension T_end, with tendon friction removed [N].
        sliding: Direction in which each tendon slid last: 1 when wound in, −1 when paid out.
        temperature: Plausible temperature of the module's housing [°C]; NaN where it is unknown.
        usable: Which muscles are not isolated.
        newest: The readings of the last message alone, without the median filter, with the length
            offset removed and motor-side tensions.
        jumped: Indices of the muscles whose new length after a jump is accepted with this message;
            usually none.
        missing: Indices of the isolated muscles whose length or tension is NaN in this message.
        tension_spread: Standard deviation σ_T of T [N]; 0 for tension sensors and assumed tensions.
        delay: How late the message is, compared with the fastest one (`Arrival.delay`) [s].
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
    newest: MuscleReadings
    jumped: tuple[int, ...] = ()
    missing: tuple[int, ...] = ()
    tension_spread: Array | float = 0.0
    delay: float = 0.0

    @property
    def sent_at(self) -> float:
        """Time of sending by the caller's clock, except for a constant [s].

        Rates are computed from differences of this time, because messages that have waited arrive
        together.
        """
        return self.time - self.delay

    def shifted(self, offset: Array) -> MuscleSample:
        """Return the same sample with lengths reduced by `offset` [m], (M,)."""
        newest = self.newest.replace(length=self.newest.length - offset)
        return replace(self, length=self.length - offset, newest=newest)

    def without_isolated(self) -> MuscleSample:
        """Return the same sample with 0 for what is learned of isolated muscles."""
        return replace(
            self,
            length=np.where(self.usable, self.length, 0.0),
            tension_read=np.where(self.usable, self.tension_read, 0.0),
            sliding=np.where(self.usable, self.sliding, 0.0),
        )


class MuscleStream:
    """Turns the messages of one arm's muscle modules into samples.

    Attributes:
        body: Length offsets and isolated muscles.
        jumps: The jumps of lengths.
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
        self._temperatures = TemperatureCheck(robot.muscle_count)
        #: readings of the last accepted messages, and of the last messages, accepted or not
        self._accepted: deque[MuscleReadings] = deque(maxlen=window)
        self._received: deque[MuscleReadings] = deque(maxlen=window)
        self._implausible = Persistence()
        self.jumps = LengthJumps(robot)
        self.reset()

    def reset(self) -> None:
        """Discard earlier messages, for example after a jump of the clock."""
        self.jumps.reset()
        self._direction = FrictionDirection()
        self._accepted.clear()
        self._received.clear()
        self._time = math.inf  # reception of the last sample [s]
        self._sample_delay = 0.0  # delay of the last sample [s]
        self._delay = 0.0  # delay of the newest message, accepted or not [s]

    def use_transmission(self, transmission: Transmission) -> None:
        """Use a transmission to compute motor-side and bone-side tensions from now on."""
        if self._robot.tension_source.is_current and transmission.drive is None:
            unknown = Transmission.unknown(self._robot.description.tension.limit)
            transmission = replace(unknown, friction=transmission.friction)
        self._transmission = transmission

    def use_body(self, body: BodyState) -> None:
        """Use the length offsets and isolated muscles of another body state from now on."""
        if body.offsets != self.body.offsets:  # the change of lengths is not a motion
            self._direction = FrictionDirection()
        self.body = body

    @property
    def jumping(self) -> tuple[int, ...]:
        """Indices of the muscles whose lengths have jumped to a level not yet accepted."""
        return self.jumps.jumping(self.body.used)

    def implausible(self, now: float) -> str:
        """Return why messages have been implausible for longer than a glitch, or ''."""
        return self._implausible.lasting(now - self._delay)

    def take(
        self, message: Any, time: float, now: float | None = None, delay: float = 0.0
    ) -> MuscleSample:
        """Check and convert a message, or readings from another source.

        Args:
            message: The message of `muscle_states`, or `MuscleReadings`.
            time: Time of reception by the caller's clock [s].
            now: Time of reception by a steady clock [s]; None if `time` is by a steady clock.
            delay: How late the message is, compared with the fastest one (`Arrival.delay`) [s].

        Raises:
            RejectionError: If the message is invalid or implausible.
        """
        try:
            received = read_muscle_states(message, self._robot, self.body.isolated)
        except MessageError as error:
            raw = plausible = None
            with suppress(MessageError):  # a message of another shape has no readings
                raw = raw_muscle_states(message, self._robot)
                self._follow(raw, time if now is None else now, delay)
                self._received.append(raw)
                plausible = self._plausible()
            detail = str(error).partition(': ')[2]
            raise RejectionError(error.reason, detail, raw, plausible) from error
        now = time if now is None else now
        self._delay = delay
        missing = self._fill_in(received) if self.body.isolated else ()
        offsets = self.body.offsets
        newest = received.replace(length=received.length - offsets.offset)
        self._received.append(received)
        problem = self._problem(received, newest, now)
        self._implausible.note('' if problem is None else ': '.join(problem), now - delay)
        if problem is not None:
            raise RejectionError(*problem, received, self._plausible())
        pause = longer_pause(time - self._time, self._sample_delay, delay)
        if time < self._time or pause > LIMITS.pause:
            self._direction.reset()
        self._time, self._sample_delay = time, delay
        self._accepted.append(received)
        read = MuscleReadings.median(self._accepted)
        length, tension = read.length - offsets.offset, read.tension
        sliding = self._direction.step(length)
        newest.tension = self._transmission.motor(newest.tension, sliding)
        known = self._robot.actuation.known_tension
        return MuscleSample(
            time=time,
            length=length,
            length_read=read.length,
            tension_read=known(tension),
            motor_tension=known(self._transmission.motor(tension, sliding)),
            bone_tension=known(self._transmission.end(tension, sliding)),
            sliding=sliding,
            temperature=self._temperatures.step(read.temperature, now - delay),
            usable=self.body.used,
            newest=newest,
            jumped=self.jumps.newest,
            missing=missing,
            tension_spread=self._transmission.spread(tension, sliding),
            delay=delay,
        )

    def _fill_in(self, readings: MuscleReadings) -> tuple[int, ...]:
        """Replace NaN in lengths and tensions of isolated muscles by 0; return these muscles."""
        has_no_length = np.isnan(readings.length)
        has_no_tension = np.isnan(readings.tension) & self._robot.tension_source.is_known
        readings.length[has_no_length] = 0.0
        readings.tension[has_no_tension] = 0.0
        return tuple(np.flatnonzero(has_no_length | has_no_tension).tolist())

    def _plausible(self) -> MuscleReadings | None:
        """Return the medians of plausible readings, as in `RejectionError.plausible`."""
        if len(self._received) < (self._received.maxlen or 0):
            return None
        offset, plausible = self.body.offsets.offset, self._levels.plausible
        return MuscleReadings.median([plausible(each, offset) for each in self._received])

    def _problem(
        self, read: MuscleReadings, corrected: MuscleReadings, now: float
    ) -> tuple[str, str] | None:
        """Return why a message is rejected: a value with an impossible level, or a jump; or None.

        Args:
            read: The readings.
            corrected: The same readings with the length offset removed from the lengths.
            now: Time of reception by a steady clock [s].
        """
        known, used = self.body.offsets.known, self.body.used
        problem = self._levels.problem(corrected, used, known)
        if problem is not None:
            self._follow(read, now, self._delay)
            return problem
        problem = self.jumps.step(read.length, used, now, self._delay)
        # While the length offsets are unknown, lengths are unreliable in any case, so that a jump
        # is no reason to reject the message.
        return problem if known else None

    def _follow(self, read: MuscleReadings, now: float, delay: float) -> None:
        """Note the plausible lengths of a message that is rejected because of other values.

        Args:
            read: The readings.
            now: Time of reception by a steady clock [s].
            delay: How late the message is (`Arrival.delay`) [s].
        """
        length, offsets = read.length, self.body.offsets
        if offsets.known:
            is_possible = np.isfinite(self._levels.plausible(read, offsets.offset).length)
            length = np.where(is_possible, length, np.nan)
        self.jumps.follow(length, self.body.used, now, delay)
