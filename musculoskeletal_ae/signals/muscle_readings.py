# SPDX-License-Identifier: Apache-2.0
"""What a muscle module reports: one row for each quantity, in the order of `QUANTITIES`.

A message of `muscle_states` has these rows, with one column for each muscle. Readings that did not
arrive as a message are passed on as an array of these rows (`muscle_reading`).

To add a quantity, add its entry to `QUANTITIES`. Messages may then have its row; its values are
checked, and `MuscleSample.newest` contains them. What else a quantity needs if the emulator reports
it, or if a part of the package uses it, is in doc/explanation/architecture.md ("How to add …").
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, IntEnum
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.limits import LIMITS, longest_lengths, reading_range


class Presence(Enum):
    """Whether a message must have a quantity for all muscles, for some of them, or not at all."""

    REQUIRED = 'each value is a finite number'
    MEASURED_OR_NAN = 'a value that is not measured is NaN'
    OPTIONAL = 'a value that is not measured is NaN, and messages may lack the row'


class Quantity(NamedTuple):
    """A quantity that muscle modules report.

    Attributes:
        name: Its name in texts for users, and as an argument of `muscle_reading`.
        unit: Its unit in texts for users, such as 'N'.
        reason: Reason, for users, under which messages with impossible values are counted.
        possible: Function of the robot that returns the lowest and the highest possible value of
            each muscle; each is a number, or an array (M,).
        presence: Which values a message may lack. Optional quantities come last.
    """

    name: str
    unit: str
    reason: str
    possible: Callable[[Robot], tuple[Array | float, Array | float]]
    presence: Presence = Presence.REQUIRED


def _possible_lengths(robot: Robot) -> tuple[Array, Array]:
    longest = longest_lengths(robot)
    return -longest, longest


def _possible_temperatures(_: Robot) -> tuple[float, float]:
    return LIMITS.lowest_temperature, LIMITS.highest_temperature


#: the rows of a message of `muscle_states`, in this order
QUANTITIES: tuple[Quantity, ...] = (
    Quantity('length', 'm', 'length beyond what the joints allow', _possible_lengths),
    Quantity('tension', 'N', 'tension beyond the maximum', reading_range),
    Quantity(
        'temperature', '°C', 'impossible temperature', _possible_temperatures,
        Presence.MEASURED_OR_NAN,
    ),
)  # fmt: skip


class Row(IntEnum):
    """Index of each quantity's row in a message of `muscle_states`."""

    LENGTH = 0
    TENSION = 1
    TEMPERATURE = 2


def possible_readings(robot: Robot) -> tuple[Array, Array]:
    """Return the lowest and the highest possible value of each quantity, (Q, M) each."""
    possible = np.empty((2, len(QUANTITIES), robot.muscle_count))
    for row, quantity in enumerate(QUANTITIES):
        possible[0, row], possible[1, row] = quantity.possible(robot)
    return possible[0], possible[1]


def muscle_reading(robot: Robot, **values: Array) -> Array:
    """Return a reading of all muscle modules: the rows of a message of `muscle_states`, (Q, M).

    Args:
        robot: The robot; if its modules report motor currents, tensions are converted to currents.
        values: The values of each quantity by its name, (M,), with tensions in N. Quantities that
            are not given are NaN.
    """
    rows = np.full((len(QUANTITIES), robot.muscle_count), np.nan)
    for row, quantity in enumerate(QUANTITIES):
        if quantity.name in values:
            rows[row] = values[quantity.name]
    rows[Row.TENSION] = robot.tension_source.to_message(rows[Row.TENSION])
    return rows
