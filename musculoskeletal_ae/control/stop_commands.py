# SPDX-License-Identifier: Apache-2.0
"""Commands of a stopped arm: hold, release, and winding in a suspect muscle.

The last command is held for `hold_time`, except after an overload. Then lengths are paid out at the
rate limit until muscle stiffness control demands only T_bias. Tension commands fall to T_bias at
K_stiff times the rate limit.

Position-controlled modules hold no tension of their own. Each tendon is therefore paid out only
while its measured tension is above T_bias. Unloaded tendons thus do not become slack, and muscles
that carry the arm lower it slowly. If the tension of a muscle is not known, the muscle is
paid out by `Actuation.release` [m], relative to its length at the start of the release.

After an anomaly, a suspect muscle is verified (`estimation/suspect_verification`). It is wound in
slowly once the other muscles are paid out. Winding ends when the measured tension of the suspect,
or the tension that muscle stiffness control demands, has risen by `LARGEST_RISE`. Whatever the
sensors read, winding also ends when the length command has decreased by `Actuation.winding_depth`.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.limiter import CommandLimiter
from musculoskeletal_ae.control.settings import Setup
from musculoskeletal_ae.motion.activities import LENGTH, TENSION, Command
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

PAYING_OUT = 1.5  # pay the muscles out for at least this time before a suspect is wound in [s]
LARGEST_RISE = 30.0  # stop winding a suspect in once its tension has risen by this [N]
SPEED = 0.02  # wind a suspect in at this speed [m/s]


class SafeStop:
    """Commands a stopped arm."""

    def __init__(self, setup: Setup, limiter: CommandLimiter) -> None:
        self._setup, self._limiter = setup, limiter
        self.leave()

    def leave(self) -> None:
        """End the stop, and forget its duration and the lengths at which its release began."""
        self._held = 0.0  # duration of the stop [s]; excludes the time of waiting to resume
        #: commands before the suspect was wound in [m], (M,)
        self._wound_from: Array | None = None
        self._released_from: Array | None = None  # lengths at the start of the release [m], (M,)

    def shift(self, offset: Array) -> None:
        """Shift stored lengths to new length offsets, which are larger by `offset` [m], (M,)."""
        if self._released_from is not None:
            self._released_from = self._released_from - offset
        if self._wound_from is not None:
            self._wound_from = self._wound_from - offset

    @property
    def is_releasing(self) -> bool:
        """Whether the hold time is over. If so, the muscles are paid out."""
        return self._held > self._setup.settings.hold_time

    def step(
        self,
        sample: MuscleSample,
        dt: float,
        is_fresh: bool,
        suspect: int | None,
        releases_at_once: bool = False,
    ) -> Command | None:
        """Return the desired command; None if no command was ever published.

        Args:
            sample: The newest muscle states.
            dt: Time since the last call [s]; 0 while the arm waits to resume.
            is_fresh: Whether the sample is still up to date. If it is not, no suspect is wound in.
            suspect: Index of the muscle that may be wound in; None if there is none.
            releases_at_once: Whether to release the arm without holding the last command.
        """
        last = self._limiter.command
        if last is None:
            return None
        self._held += dt
        if releases_at_once and not self.is_releasing:
            self._held = self._setup.settings.hold_time + dt
        if not self.is_releasing:
            return last
        winds = (
            suspect is not None
            and is_fresh
            and self._held > self._setup.settings.hold_time + PAYING_OUT
        )
        if winds:  # tensions are at T_bias now; a suspect is wound in by length commands
            last = self._limiter.last(LENGTH, sample)
        if last.kind == TENSION:
            change = self._limiter.largest_change(TENSION, dt)
            return Command(TENSION, np.maximum(self._setup.robot.tension.bias, last.value - change))
        change = self._limiter.largest_change(LENGTH, dt)
        if self._released_from is None:
            self._released_from = np.maximum(last.value, sample.length)
        # Wherever the arm is, a muscle is slack once it has been paid out by its whole range.
        slack = np.minimum(self._limiter.longest, self._released_from + self._limiter.span)
        end = self._setup.robot.actuation.released(
            last.value, self._released_from, sample.length, sample.motor_tension, slack, is_fresh
        )
        value = np.minimum(last.value + change, np.maximum(end, last.value))
        if winds and suspect is not None:
            value[suspect] = self._wound(suspect, last.value, sample, dt)
        return Command(LENGTH, value)

    def _wound(self, muscle: int, commands: Array, sample: MuscleSample, dt: float) -> float:
        """Return the next length command [m] of a suspect muscle, which is wound in slowly.

        If the suspect has been wound in far enough, the last command is returned unchanged.

        Args:
            muscle: Index of the suspect.
            commands: The last length commands of all muscles [m], (M,).
            sample: The newest muscle states.
            dt: Time since the last command [s].
        """
        if self._wound_from is None:
            self._wound_from = commands
        command = float(commands[muscle])
        length, tension = sample.newest.length[muscle], sample.newest.tension[muscle]
        actuation = self._setup.robot.actuation
        if actuation.rise(muscle, length, command, tension) > LARGEST_RISE:
            return command
        least = float(self._wound_from[muscle]) - actuation.winding_depth(muscle)
        return max(command - SPEED * dt, least)
