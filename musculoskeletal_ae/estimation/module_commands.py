# SPDX-License-Identifier: Apache-2.0
"""Stores the newest commands to the muscle modules, to compare readings with them.

On a busy computer, readings and commands are late, and a module still obeys an earlier command when
it sends a reading. It is not known which command that was. If no command was later than the
reading, whose delay is d, it was one of those that the estimator received in the last 2 d. A
reading is therefore compared with the nearest value between the values of these commands. On an
idle computer, d is 0, and only the newest command remains.
"""

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

#: Ignore a command that is older than this [s]: modules without commands for this time enter their
#: safe state (doc/howto/your_driver.md). The age is measured on the steady clock, because the
#: modules do not wait for pauses of this process.
COMMAND_AGE = 0.5
#: store commands for this time [s]; if a reading is late by more than half of this time, the
#: command that its module obeyed is unknown
STORED = 1.0


class _Command(NamedTuple):
    """A command to the muscle modules: target lengths or target tensions."""

    time: float  # when the estimator received it [s]
    length: Array | None  # target lengths [m], (M,); None if it commands tensions
    tension: Array | None  # target tensions [N], (M,); None if it commands lengths


class ModuleCommands:
    """Stores the newest commands to the muscle modules.

    A command that is older than 0.5 s (COMMAND_AGE) counts as no command.
    """

    def __init__(self) -> None:
        self._commands: deque[_Command] = deque()

    def note(self, now: float, length: Array | None = None, tension: Array | None = None) -> None:
        """Note target lengths [m] (M,) or target tensions [N] (M,) that were sent at `now` [s]."""
        while self._commands and self._commands[0].time < now - STORED:
            self._commands.popleft()
        self._commands.append(_Command(now, length, tension))

    def newest_length(self, now: float) -> Array | None:
        """Return the newest target lengths [m], (M,), or None without an up-to-date command."""
        return self._commands[-1].length if self._is_up_to_date(now) else None

    def length(self, sample: MuscleSample, now: float) -> Array | None:
        """Return the target lengths that the modules obeyed when they sent the readings [m], (M,).

        The result is None if these are not known, or if modules were to follow tensions.

        Args:
            sample: The readings.
            now: The present time on the same clock as in `note` [s].
        """
        return self._nearest(sample.length, sample.delay, now, lambda command: command.length)

    def demand(self, robot: Robot, sample: MuscleSample, now: float) -> Array | None:
        """Return the tensions that were demanded of the modules at their readings [N], (M,).

        The tensions that a length command demands depend on the measured lengths. The result is
        None if the demand is not known, or if the modules follow positions.

        Args:
            robot: The robot.
            sample: The readings.
            now: The present time on the same clock as in `note` [s].
        """

        def demanded(command: _Command) -> Array | None:
            if command.length is not None:
                return robot.actuation.demanded(sample.length, command.length)
            return command.tension if robot.actuation.follows_tensions else None

        return self._nearest(sample.motor_tension, sample.delay, now, demanded)

    def _is_up_to_date(self, now: float) -> bool:
        return bool(self._commands) and now - self._commands[-1].time <= COMMAND_AGE

    def _nearest(
        self,
        reading: Array,
        delay: float,
        now: float,
        wanted: Callable[[_Command], Array | None],
    ) -> Array | None:
        """Return the wanted value that is nearest to the reading of each module, (M,).

        Between two commands, any value between theirs may have been in force.
        """
        if not self._is_up_to_date(now) or 2.0 * delay > STORED:
            return None
        values = []
        for command in reversed(self._commands):
            value = wanted(command)
            if value is None:
                break
            values.append(value)
            if command.time <= now - 2.0 * delay:  # no earlier command was in force
                break
        if len(values) < 2:
            return values[0] if values else None
        nearest: Array = np.clip(reading, np.min(values, axis=0), np.max(values, axis=0))
        return np.where(np.isfinite(nearest), nearest, values[0])
