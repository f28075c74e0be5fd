# SPDX-License-Identifier: Apache-2.0
"""What every command passes before it leaves: rate limit, saturation, finite check, safe stop.

Order: model → rate limit → saturate → finite check last. MSC pulls with T_bias + K (l − l_target),
so the tension limit of a muscle is a length limit,

    l_target ≥ l + l_comp(T_limit),   l_comp(T) = −(T − T_bias)/K_stiff,

which may pay a muscle out faster than the rate limit, if its tension is measured above
tension.limit, and never winds it in. Readings are medians of the last three messages, so that a
glitch of a sensor moves nothing. The limit of a muscle whose motor runs hot (`heat.py`) falls from
tension.max to T_bias, no faster than the rate limit pays out.

While a suspect is verified after an anomaly (`estimation/verification`), it is wound in a little
once the others are paid out: slowly, until its tension or what MSC demands of it has risen by WIND,
or the command has fallen by DEPTH, whatever its sensors say.

A stop latches. The last command is held for `hold_time`; then lengths are paid out at the rate
limit until MSC holds only T_bias, and tensions fall to T_bias at K_stiff times that rate. A stop
that may pass by itself (data that is late) latches when that paying out begins.
"""

from collections import deque
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, median_of_rows
from musculoskeletal_ae.control.methods import msc_compensation
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.robot.robot import Robot

LENGTH, TENSION = 'length', 'tension'

PAYING_OUT = 1.5  # [s] of a stop before a suspect is wound in
WIND, DEPTH, WIND_SPEED = 30.0, 0.015, 0.02  # [N], [m], [m/s]
#: [m] by which a true muscle, or its sensor, may be longer than the model's
LENGTH_MARGIN = 0.03


class Command(NamedTuple):
    """What the modules are to follow: LENGTH [m] or TENSION [N], values of shape (M,)."""

    kind: str
    value: Array


class Muscles(NamedTuple):
    """The last muscle_states: l [m], T [N], temperature [°C], each of shape (M,)."""

    length: Array
    tension: Array
    temperature: Array


def unchanging(robot: Robot, kind: str, muscles: Muscles) -> Command:
    """Return the command of a kind under which the muscles pull as they do now."""
    tension = np.maximum(muscles.tension, robot.tension.bias)
    if kind == TENSION:
        return Command(TENSION, tension)
    return Command(LENGTH, muscles.length + msc_compensation(robot, tension))


class SafetyFilter:
    """Latched stop and limits of the commands."""

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self._robot, self.settings = robot, settings
        self.cause = ''  # why the arm was stopped; '' ends it
        self.passing = False  # whether the stop may end by itself
        self.command: Command | None = None  # the last one that left
        self._held = 0.0
        self._readings: deque[Array] = deque(maxlen=3)  # (3, M) each
        #: medians of the last three messages
        self.now: Muscles | None = None
        postures = robot.random_postures(200, np.random.default_rng(0))
        self.zeroed = True  # else no limit of tension rests on how long muscles are at most
        #: of every muscle [m], (M,): commanded that, it is slack in any posture
        self.longest = robot.routes.relative_lengths(postures).max(axis=0) + LENGTH_MARGIN
        self.suspect: int | None = None  # muscle to be wound in while the arm is stopped
        self._wound_from: float | None = None  # its command before [m]

    @property
    def _longest(self) -> Array:
        return self.longest if self.zeroed else np.full_like(self.longest, np.inf)

    def shift(self, less: Array) -> None:
        """Take lengths that are less [m] (M,) from now on: the same muscles, another zero."""
        self._readings = deque((np.array([m[0] - less, *m[1:]]) for m in self._readings), 3)
        if self.now is not None:
            self.now = self.now._replace(length=self.now.length - less)
        if self.command is not None and self.command.kind == LENGTH:
            self.command = Command(LENGTH, self.command.value - less)

    def muscles(self, muscles: Muscles) -> Muscles:
        """Take new muscle_states; return the medians of the last three, isolated ones without T."""
        self._readings.append(np.array(muscles))
        median = Muscles(*median_of_rows(np.array(self._readings)))
        self.now = median._replace(tension=median.tension * self._robot.used)
        return self.now

    def stop(self, cause: str, passing: bool = False) -> None:
        """Latch a stop, or one that may pass; the first cause is kept, if it latched."""
        if not self.cause:
            self._held = 0.0
            self._wound_from = None
        if not self.cause or (self.passing and not passing):
            self.cause, self.passing = cause, passing

    def step(
        self, desired: Command | None, limit: Array, dt: float, fresh: bool = True
    ) -> Command | None:
        """Return the command that may leave, or None if nothing was ever commanded.

        It follows the desired one, or keeps the last (None), within the tension limits [N] (M,),
        dt [s] after the last one; fresh muscle_states still say where the muscles are.
        """
        muscles, desired = self.now, desired or self.command
        if muscles is None or desired is None:
            return None
        if not self.cause:
            limited = self._limited(desired, muscles, limit, dt)
            if np.count_nonzero(np.isfinite(limited.value)) == len(limited.value):
                self.command = limited
                return limited
            self.stop('the computed command is not finite')
        if self.command is not None:
            self.command = self._released(self.command, muscles, dt, fresh)
        return self.command

    def last(self, kind: str) -> Command:
        """Return the last command, or one of this kind under which the muscles pull as now."""
        assert self.now is not None  # nothing is commanded before
        if self.command is None or self.command.kind != kind:
            return unchanging(self._robot, kind, self.now)
        return self.command

    def most_change(self, kind: str, dt: float) -> Array | float:
        """Return by how much a command may change in dt [s]."""
        rate = self.settings.rate_limit
        return (rate if kind == LENGTH else rate * self._robot.stiffness) * dt

    def _limited(self, desired: Command, muscles: Muscles, limit: Array, dt: float) -> Command:
        (kind, value), robot, before = desired, self._robot, self.command
        if before is None or before.kind != kind:
            before = unchanging(robot, kind, muscles)
            if kind == LENGTH:
                before = Command(kind, np.minimum(before.value, self._longest))
        change = self.most_change(kind, dt)
        value = np.maximum(np.minimum(value, before.value + change), before.value - change)
        if kind == TENSION:
            return Command(kind, np.clip(value, robot.tension.bias, limit))
        least = np.minimum(muscles.length, self._longest) + msc_compensation(robot, limit)
        # Only a muscle that does pull too hard is let go faster: lengths alone may lie.
        tense = muscles.tension > robot.tension.limit
        least = np.where(tense, least, np.minimum(least, before.value + change))
        return Command(kind, np.maximum(value, least))

    def _released(self, command: Command, muscles: Muscles, dt: float, fresh: bool) -> Command:
        self._held += dt
        if self._held <= self.settings.hold_time:
            return command
        self.passing = False
        winding = self.suspect is not None and fresh
        winding &= self._held > self.settings.hold_time + PAYING_OUT
        kind, value = self.last(LENGTH) if winding else command
        change = self.most_change(kind, dt)
        if kind == TENSION:
            return Command(kind, np.maximum(self._robot.tension.bias, value - change))
        # At the measured length MSC pulls with T_bias only; where that is not known, out to the
        # longest the muscle can be.
        end = muscles.length if fresh else np.maximum(muscles.length, self._longest)
        # What is read of an isolated one may be anything.
        end = np.where(self._robot.used, end, np.minimum(end, self._longest))
        after = np.minimum(value + change, np.maximum(end, value))
        if winding and self.suspect is not None:
            after[self.suspect] = self._wound(self.suspect, float(value[self.suspect]), dt)
        return Command(kind, after)

    def _wound(self, muscle: int, value: float, dt: float) -> float:
        """Return the next command [m] of the suspect, after `value`."""
        if self._wound_from is None:
            self._wound_from = value
        # With the tensions of isolated muscles.
        length, tension, _ = self._readings[-1][:, muscle]
        rise = tension - self._robot.description.tension.bias[muscle]
        if max(rise, self._robot.stiffness[muscle] * (length - value)) > WIND:
            return value
        return max(value - WIND_SPEED * dt, self._wound_from - DEPTH)
