# SPDX-License-Identifier: Apache-2.0
"""The last thing that every command passes before it is published.

    desired ─► rate limit ─► tension limit ─► finite check ─► published

Muscle stiffness control pulls with T_bias + K (l − l_target), so that the tension limit of a muscle
is a limit of its commanded length:

    l_target ≥ l + l_comp(T_limit),   l_comp(T) = −(T − T_bias) / K_stiff

It may pay a muscle out faster than the rate limit, if the tension that is measured is above
`tension.limit`, and it never winds one in. The rate limit compares with the last command that was
published, whatever has happened in between.

The tension limit is what the heat of the motors allows for a moment (`watchdog.HeatLimit`), at most
`tension.max`. While the length offsets are unknown it is at most `calibrating.gentle_limit`.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.command import (
    LENGTH,
    TENSION,
    Command,
    msc_compensation,
    unchanging,
)
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

POSTURES = 200  # random postures that tell how long the muscles can get
#: [m] by which a real muscle, or its sensor, may be longer than the model's
LENGTH_MARGIN = 0.03


class CommandLimiter:
    """Limits commands; knows the last one that was published.

    Attributes:
        command: The last command that was published, or None.
        slack_length: Of every muscle [m], (M,): commanded this length, it is slack in any posture.
        offsets_known: Whether lengths can be relied on; otherwise no limit rests on them.
    """

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self.command: Command | None = None
        self.offsets_known = True
        postures = robot.random_postures(POSTURES, np.random.default_rng(0))
        longest = robot.routes.relative_lengths(postures).max(axis=0)
        self.slack_length: Array = longest + LENGTH_MARGIN
        self.use(robot, settings)

    def use(self, robot: Robot, settings: Settings) -> None:
        """Limit by this robot, whose isolated muscles pull nothing, and by these settings."""
        self._robot, self._settings = robot, settings

    @property
    def longest(self) -> Array:
        """The length [m] that no muscle exceeds, (M,); infinite while the offsets are unknown."""
        return self.slack_length if self.offsets_known else np.full_like(self.slack_length, np.inf)

    def shift(self, offset: Array) -> None:
        """Measure lengths from other offsets, by which they are less [m], (M,)."""
        if self.command is not None and self.command.kind == LENGTH:
            self.command = Command(LENGTH, self.command.value - offset)

    def last(self, kind: str, sample: MuscleSample) -> Command:
        """Return the last command, or one of this kind under which the muscles pull as now."""
        if self.command is not None and self.command.kind == kind:
            return self.command
        command = unchanging(self._robot, kind, sample)
        if kind == LENGTH:
            command = Command(kind, np.minimum(command.value, self.longest))
        return command

    def largest_change(self, kind: str, dt: float) -> Array | float:
        """Return by how much a command may change within dt [s]: [m], or [N] (M,)."""
        rate = self._settings.rate_limit * dt
        return rate if kind == LENGTH else rate * self._robot.stiffness

    def limit(
        self, desired: Command, sample: MuscleSample, tension_limit: Array, dt: float
    ) -> Command | None:
        """Return the command that may be published, and remember it as published.

        Args:
            desired: What is wanted.
            sample: The newest muscle states.
            tension_limit: Highest tension of every muscle [N], (M,).
            dt: Time since the last command [s].

        Returns:
            The limited command, or None if it is not finite; the last one stays then.
        """
        kind = desired.kind
        before = self.last(kind, sample).value
        change = self.largest_change(kind, dt)
        value = np.clip(desired.value, before - change, before + change)
        if kind == TENSION:
            value = np.clip(value, self._robot.tension.bias, tension_limit)
        else:
            value = np.maximum(value, self._shortest(before, change, sample, tension_limit))
        if not np.isfinite(value).all():
            return None
        self.command = Command(kind, value)
        return self.command

    def _shortest(
        self, before: Array, change: Array | float, sample: MuscleSample, tension_limit: Array
    ) -> Array:
        """Return the shortest length [m] (M,) that demands no tension above the limit."""
        length = np.minimum(sample.length, self.longest)
        shortest = length + msc_compensation(self._robot, tension_limit)
        # Only a muscle that is measured to pull too hard is paid out faster than the rate limit: a
        # length sensor alone may be wrong.
        too_tense = sample.motor_tension * sample.usable > self._robot.tension.limit
        return np.where(too_tense, shortest, np.minimum(shortest, before + change))
