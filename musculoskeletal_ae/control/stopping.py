# SPDX-License-Identifier: Apache-2.0
"""What a stopped arm does: it holds, is released, and a suspect muscle may be wound in a little.

The last command is held for `hold_time`, except after an overload. Then lengths are paid out at the
rate limit until muscle stiffness control holds only T_bias, and tensions fall to T_bias at K_stiff
times that rate.

While a suspect is verified after an anomaly (`estimation/verification`), it is wound in once the
others are paid out: slowly, until its tension, or what muscle stiffness control demands of it, has
risen by `LARGEST_RISE`, or its command has fallen by `DEPTH`, whatever its sensors read.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.control.command import LENGTH, TENSION, Command
from musculoskeletal_ae.control.limiter import CommandLimiter
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

PAYING_OUT = 1.5  # [s] of releasing the arm before a suspect is wound in
LARGEST_RISE, DEPTH, SPEED = 30.0, 0.015, 0.02  # [N], [m], [m/s] of a suspect that is wound in


class SafeStop:
    """Commands a stopped arm.

    Attributes:
        suspect: Position of the muscle that may be wound in, or None.
        is_entered: Whether a stop goes on.
    """

    def __init__(self, robot: Robot, settings: Settings, limiter: CommandLimiter) -> None:
        self._limiter = limiter
        self.suspect: int | None = None
        self.is_entered = False
        self.use(robot, settings)
        self.leave()

    def use(self, robot: Robot, settings: Settings) -> None:
        """Release this robot, whose isolated muscles do not count, by these settings."""
        self._robot, self._settings = robot, settings

    def enter(self) -> None:
        """Begin a stop."""
        self.leave()
        self.is_entered = True

    def leave(self) -> None:
        """End a stop."""
        self.is_entered = False
        self._held = 0.0  # [s]
        self._wound_from: float | None = None  # the suspect's command before it is wound in [m]

    @property
    def is_releasing(self) -> bool:
        """Whether the last command is no longer held."""
        return self._held > self._settings.hold_time

    def step(
        self,
        sample: MuscleSample,
        dt: float,
        is_fresh: bool,
        may_wind: bool,
        releases_at_once: bool = False,
    ) -> Command | None:
        """Return the desired command, dt [s] after the last one; None before the first.

        Args:
            sample: The newest muscle states.
            dt: How long the stop has gone on since the last call [s].
            is_fresh: Whether the sample still tells where the muscles are.
            may_wind: Whether the suspect may be wound in.
            releases_at_once: Whether the last command is not to be held.
        """
        last = self._limiter.command
        if last is None:
            return None
        self._held += dt
        if releases_at_once and not self.is_releasing:
            self._held = self._settings.hold_time + dt
        if not self.is_releasing:
            return last
        winds = (
            self.suspect is not None
            and may_wind
            and is_fresh
            and self._held > self._settings.hold_time + PAYING_OUT
        )
        if winds:  # tensions are released by now; a suspect is wound in by its length
            last = self._limiter.last(LENGTH, sample)
        if last.kind == TENSION:
            change = self._limiter.largest_change(TENSION, dt)
            return Command(TENSION, np.maximum(self._robot.tension.bias, last.value - change))
        change = self._limiter.largest_change(LENGTH, dt)
        longest = self._limiter.longest
        # At the measured length muscle stiffness control pulls with T_bias only. Where the length
        # is not known, the muscle is paid out to the longest it can be.
        end = sample.length if is_fresh else np.maximum(sample.length, longest)
        # What an isolated muscle reads may be anything.
        end = np.where(self._robot.used, end, np.minimum(end, longest))
        value = np.minimum(last.value + change, np.maximum(end, last.value))
        if winds and self.suspect is not None:
            value[self.suspect] = self._wound(
                self.suspect, float(last.value[self.suspect]), sample, dt
            )
        return Command(LENGTH, value)

    def _wound(self, muscle: int, command: float, sample: MuscleSample, dt: float) -> float:
        """Return the next command of the suspect [m], after `command`."""
        if self._wound_from is None:
            self._wound_from = command
        length, tension, _ = sample.newest[:, muscle]
        rise = tension - self._robot.description.tension.bias[muscle]
        demand = self._robot.stiffness[muscle] * (length - command)
        if max(rise, demand) > LARGEST_RISE:
            return command
        return max(command - SPEED * dt, self._wound_from - DEPTH)
