# SPDX-License-Identifier: Apache-2.0
"""Stores the newest command to the muscle modules, until it is out of date."""

import math

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot

#: Ignore a command that is older than this [s]: modules without commands for this time enter their
#: safe state (doc/howto/your_driver.md). The age is measured on the steady clock, because the
#: modules do not wait for pauses of this process.
COMMAND_AGE = 0.5


class ModuleCommands:
    """Stores the newest command to the muscle modules: target lengths or target tensions.

    A command older than 0.5 s (COMMAND_AGE) is ignored.
    """

    def __init__(self) -> None:
        self._length: Array | None = None  # l_target [m], (M,)
        self._tension: Array | None = None  # T_target [N], (M,)
        self._time = -math.inf  # time of the newest command [s]

    def note(self, now: float, length: Array | None = None, tension: Array | None = None) -> None:
        """Note target lengths [m] (M,) or target tensions [N] (M,) that were sent at `now` [s]."""
        self._length, self._tension, self._time = length, tension, now

    def length(self, now: float) -> Array | None:
        """Return the target lengths [m], (M,), or None without an up-to-date length command."""
        return self._length if now - self._time <= COMMAND_AGE else None

    def demand(self, robot: Robot, length: Array, now: float) -> Array | None:
        """Return the tensions that the newest command demands of the modules [N], (M,).

        The tensions that a length command demands depend on the measured lengths. The result is
        None if the command is out of date, or if the modules follow positions.

        Args:
            robot: The robot.
            length: Measured lengths [m], (M,).
            now: The present time on the same clock as in `note` [s].
        """
        if now - self._time > COMMAND_AGE:
            return None
        if self._length is None:
            return self._tension if robot.actuation.follows_tensions else None
        return robot.actuation.demanded(length, self._length)
