# SPDX-License-Identifier: Apache-2.0
"""Commands of a stopped arm: hold, release, and winding in a suspect muscle.

The last command is held for `hold_time`, except after an overload. Then lengths are paid out at the
rate limit until muscle stiffness control demands only T_bias. Tension commands fall to T_bias at
K_stiff times the rate limit.

Modules that follow positions hold no tension of their own. Each is paid out until its measured
tension is T_bias, and then stays: a tendon that no weight loads is not paid out further, and an arm
that its muscles carry is let down slowly. A muscle whose tension is not known is paid out by
`Robot.release`, counted from the start of the release.

After an anomaly, a suspect muscle is verified (`estimation/verification`). It is wound in slowly
once the other muscles are paid out. Winding ends when its measured tension, or the tension that
muscle stiffness control demands, has risen by `LARGEST_RISE`. It also ends when its command has
fallen by `DEPTH`, independently of its sensors.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.command import LENGTH, TENSION, Command
from musculoskeletal_ae.control.limiter import CommandLimiter
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

PAYING_OUT = 1.5  # duration of the release before a suspect is wound in [s]
LARGEST_RISE = 30.0  # rise of a suspect's tension at which winding in ends [N]
#: largest distance by which a suspect is wound in [m]; `Robot.release` for modules that follow
#: positions
DEPTH = 0.015
SPEED = 0.02  # speed at which a suspect is wound in [m/s]


class SafeStop:
    """Commands a stopped arm.

    Attributes:
        suspect: Index of the muscle that may be wound in, or None.
        is_entered: Whether the arm is in a stop.
    """

    def __init__(self, robot: Robot, settings: Settings, limiter: CommandLimiter) -> None:
        self._limiter = limiter
        self.suspect: int | None = None
        self.is_entered = False
        self.use(robot, settings)
        self.leave()

    def use(self, robot: Robot, settings: Settings) -> None:
        """Use another robot description and other settings."""
        self._robot, self._settings = robot, settings

    def enter(self) -> None:
        """Start a stop."""
        self.leave()
        self.is_entered = True

    def leave(self) -> None:
        """End a stop."""
        self.is_entered = False
        self._held = 0.0  # time since the start of the stop [s]
        self._wound_from: float | None = None  # suspect's command before it was wound in [m]
        self._released_from: Array | None = None  # lengths at the start of the release [m], (M,)

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
        """Return the desired command; None if no command was ever published.

        Args:
            sample: The newest muscle states.
            dt: Time since the last call that counts towards the stop [s].
            is_fresh: Whether the sample is still up to date.
            may_wind: Whether the suspect may be wound in.
            releases_at_once: Whether to release the arm without holding the last command.
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
        if winds:  # tensions are at T_bias now; a suspect is wound in by length commands
            last = self._limiter.last(LENGTH, sample)
        if last.kind == TENSION:
            change = self._limiter.largest_change(TENSION, dt)
            return Command(TENSION, np.maximum(self._robot.tension.bias, last.value - change))
        change = self._limiter.largest_change(LENGTH, dt)
        longest = self._limiter.longest
        if self._robot.follows_position:
            value = self._paid_out(last.value, change, sample, is_fresh)
            if winds and self.suspect is not None:
                m = self.suspect
                value[m] = self._wound(m, float(last.value[m]), sample, dt)
            return Command(LENGTH, value)
        # With l_target at the measured length, muscle stiffness control demands only T_bias. If the
        # length is out of date, the muscle is paid out to its largest possible length.
        end = sample.length if is_fresh else np.maximum(sample.length, longest)
        # The length sensor of an isolated muscle may be faulty.
        end = np.where(self._robot.used, end, np.minimum(end, longest))
        value = np.minimum(last.value + change, np.maximum(end, last.value))
        if winds and self.suspect is not None:
            value[self.suspect] = self._wound(
                self.suspect, float(last.value[self.suspect]), sample, dt
            )
        return Command(LENGTH, value)

    def _paid_out(self, last: Array, change: Array, sample: MuscleSample, is_fresh: bool) -> Array:
        """Return the next lengths of modules that follow positions [m], (M,)."""
        robot, whole = self._robot, self._robot.description.tension
        if self._released_from is None:
            self._released_from = np.maximum(last, sample.length)
        end = self._released_from + robot.release
        tension = sample.motor_tension
        if is_fresh:
            # The tension sensor of an isolated muscle may be faulty.
            is_known = np.isfinite(tension) & robot.used
            excess = robot.elongation(tension) - robot.elongation(whole.bias)
            measured = sample.length + np.maximum(excess, 0.0)
            # Where the tension is low enough, the module stays where it is commanded to be.
            measured = np.where(tension > whole.bias, np.maximum(measured, last), last)
            end = np.where(is_known, measured, end)
        end = np.minimum(end, self._limiter.longest)
        return np.minimum(last + change, np.maximum(end, last))

    def _wound(self, muscle: int, command: float, sample: MuscleSample, dt: float) -> float:
        """Return the suspect's next length command [m]; `command` is its last one."""
        if self._wound_from is None:
            self._wound_from = command
        length, tension, _ = sample.newest[:, muscle]
        rise = tension - self._robot.description.tension.bias[muscle]
        if not self._robot.follows_position:
            rise = max(rise, self._robot.stiffness[muscle] * (length - command))
        if rise > LARGEST_RISE:
            return command
        # A module that follows positions may have to take up slack first. `Robot.release` stretches
        # its tendon from T_bias to T_limit, whatever the tension sensor reads.
        depth = DEPTH
        if self._robot.follows_position:
            depth = float(self._robot.release[muscle])
        return max(command - SPEED * dt, self._wound_from - depth)
