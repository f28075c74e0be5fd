# SPDX-License-Identifier: Apache-2.0
"""The last thing that every command passes before it is published.

    desired ─► rate limit ─► tension limit ─► finite check ─► published

Muscle stiffness control pulls with T_bias + K (l − l_target), so that the tension limit of a muscle
is a limit of its commanded length:

    l_target ≥ l + l_comp(T_limit) + r,   l_comp(T) = −(T − T_bias) / K_stiff
    dr/dt = RELIEF (T − T_limit)/K_stiff,   0 ≤ r ≤ −l_comp(T_limit)

Whatever a plan, a feedback, a wrong network or a push from outside asks for, no module is told to
pull harder than T_limit. The feedback r pays a muscle out further whose measured tension exceeds
the limit all the same, as where K_stiff or a sensor of the module is not what it should be. A
muscle whose measured tension is above `tension.limit` is paid out faster than the rate limit; none
is ever wound in faster.

T_limit is the least of `tension.limit`, of what the heat of the motors allows for a moment
(`watchdog.HeatLimit`) and, while the length offsets are unknown, of `calibrating.gentle_limit`.

The rate limit compares with the last command that was published, in whatever mode. Between length
and tension commands that is a comparison of the tension that they demand of a module:

    T_target = T_bias + max(0, K_stiff (l − l_target))

Of the lengths that demand T_bias, all that are beyond l, the one nearest to the last published
length is taken. Before the first command the muscles go on to pull as they do: a controller that
was restarted does not know what was commanded before.
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
RELIEF = 5.0  # [1/s] of the feedback from measured tension; slow beside the modules (30 ms)


class CommandLimiter:
    """Limits commands; knows the last one that was published.

    Attributes:
        command: The last command that was published, or None.
        slack_length: Of every muscle [m], (M,): commanded this length, it is slack in any posture.
        offsets_known: Whether lengths can be relied on; otherwise no limit rests on them.
    """

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self.command: Command | None = None
        #: the last length command that was published [m], (M,), and how long ago [s]
        self._last_length: tuple[Array, float] | None = None
        self._relief: Array = np.zeros(robot.muscle_count)  # r [m]
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
        if self._last_length is not None:
            self._last_length = self._last_length[0] - offset, self._last_length[1]
        if self.command is not None and self.command.kind == LENGTH:
            self.command = Command(LENGTH, self.command.value - offset)

    def last(self, kind: str, sample: MuscleSample) -> Command:
        """Return the last command, or one of this kind that demands the same of the modules.

        Before the first command: one under which the muscles go on to pull as they do.
        """
        if self.command is None:
            command = unchanging(self._robot, kind, sample)
            if kind == LENGTH:
                command = Command(kind, np.minimum(command.value, self.longest))
            return command
        if self.command.kind == kind:
            return self.command
        if kind == TENSION:
            return Command(TENSION, self._robot.demanded(sample.length, self.command.value))
        return Command(LENGTH, self._length_demanding(self.command.value, sample))

    def _length_demanding(self, tension: Array, sample: MuscleSample) -> Array:
        """Return lengths [m] (M,) that demand tensions [N] (M,), near the last ones published."""
        robot = self._robot
        demand = np.maximum(tension, robot.tension.bias)
        length = np.minimum(sample.length, self.longest) + msc_compensation(robot, demand)
        if self._last_length is None:
            return length
        before, age = self._last_length
        length = np.where(demand > robot.tension.bias, length, np.maximum(length, before))
        change = self.largest_change(LENGTH, age)
        return np.clip(length, before - change, before + change)

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
            tension_limit: Highest tension of every muscle for other reasons than its
                `tension.limit` [N], (M,).
            dt: Time since the last command [s].

        Returns:
            The limited command, or None if it is not finite; the last one stays then.
        """
        kind = desired.kind
        before = self.last(kind, sample).value
        change = self.largest_change(kind, dt)
        value = np.clip(desired.value, before - change, before + change)
        # An isolated muscle has no limit of its own; a suspect is wound in to verify it.
        limit = np.minimum(tension_limit, self._robot.description.tension.limit)
        if kind == TENSION:
            value = np.clip(value, self._robot.tension.bias, limit)
        else:
            value = np.maximum(value, self._shortest(before, change, sample, limit, dt))
        if not np.isfinite(value).all():
            return None
        self.command = Command(kind, value)
        if kind == LENGTH:
            self._last_length = value, 0.0
        elif self._last_length is not None:
            self._last_length = self._last_length[0], self._last_length[1] + dt
        return self.command

    def _shortest(
        self, before: Array, change: Array | float, sample: MuscleSample, limit: Array, dt: float
    ) -> Array:
        """Return the shortest length [m] (M,) that demands no tension above the limit."""
        robot = self._robot
        tension = sample.motor_tension * sample.usable
        depth = -msc_compensation(robot, limit)
        relief = self._relief + RELIEF * dt * (tension - limit) / robot.stiffness
        self._relief = np.clip(relief, 0.0, depth)
        length = np.minimum(sample.length, self.longest)
        shortest = length - depth + self._relief
        # Only a muscle that is measured to pull too hard is paid out faster than the rate limit: a
        # length sensor alone may be wrong.
        too_tense = tension > robot.description.tension.limit
        return np.where(too_tense, shortest, np.minimum(shortest, before + change))
