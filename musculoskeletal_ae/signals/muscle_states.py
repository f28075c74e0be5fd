# SPDX-License-Identifier: Apache-2.0
"""The readings of muscle modules: all quantities of one or more messages in one object.

`MuscleReadings` is also the table of the quantities: each of its entries declares the name, unit
and possible values of one quantity, in the order of the rows of `muscle_states`. Only this file
knows that order. All other code takes a quantity by its name, such as `readings.length`.

    message ─► read_muscle_states ─► MuscleReadings ─► to_message ─► message

`read_muscle_states` checks the form of one message; `muscle_stream` judges the readings.

To add a quantity, add its entry to `MuscleReadings`. Messages may then have its row; its values are
checked, emulated faults and recordings keep them, and `MuscleSample.newest` contains them.
doc/explanation/architecture.md ("How to add …") lists the further steps for a quantity that the
emulator measures.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from enum import Enum
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from musculoskeletal_ae.arrays import Array, Bools, Ints, median_of_rows
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.messages.message_reading import read_rows
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension_source import TensionSource
from musculoskeletal_ae.signals.reading_limits import LIMITS, longest_lengths, reading_range

#: replace larger values of isolated muscles by NaN, because they could overflow when squared
MOST_ISOLATED = 1e6


class Presence(Enum):
    """Whether a message must have a quantity for all muscles, for some of them, or not at all."""

    REQUIRED = 'each value is a finite number'
    MEASURED_OR_NAN = 'a value that is not measured is NaN'
    OPTIONAL = 'a value that is not measured is NaN, and messages may lack the row'


class Quantity:
    """An entry of `MuscleReadings`: a quantity that muscle modules report.

    Attributes:
        name: Its name in texts for users, and as an attribute of `MuscleReadings`.
        unit: Its unit in texts for users, such as 'N'.
        reason: Reason, for users, under which messages with impossible values are counted.
        possible: Function of the robot that returns the lowest and the highest possible value of
            each muscle; each is a number, or an array (M,).
        presence: Which values a message may lack. Optional quantities come last.
    """

    name: str

    def __init__(
        self,
        unit: str,
        reason: str,
        possible: Callable[[Robot], tuple[ArrayLike, ArrayLike]],
        presence: Presence = Presence.REQUIRED,
    ) -> None:
        self.unit, self.reason, self.possible, self.presence = unit, reason, possible, presence

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name
        names = [each for each, value in vars(owner).items() if isinstance(value, Quantity)]
        self._row = names.index(name)

    @overload
    def __get__(self, readings: None, owner: type) -> Quantity: ...
    @overload
    def __get__(self, readings: MuscleReadings, owner: type | None = None) -> Array: ...
    def __get__(
        self, readings: MuscleReadings | None, owner: type | None = None
    ) -> Quantity | Array:
        return self if readings is None else readings.rows[..., self._row, :]

    def __set__(self, readings: MuscleReadings, value: ArrayLike) -> None:
        readings.rows[..., self._row, :] = value

    def of(self, readings: MuscleReadings) -> Array:
        """Return this quantity of some readings, (..., M)."""
        return self.__get__(readings)


def _possible_lengths(robot: Robot) -> tuple[Array, Array]:
    longest = longest_lengths(robot)
    return -longest, longest


def _possible_temperatures(_: Robot) -> tuple[float, float]:
    return LIMITS.lowest_temperature, LIMITS.highest_temperature


class MuscleReadings:
    """Readings of the muscle modules in one or more messages; NaN where a value is unknown.

    Each quantity is an array (M,), or (N, M) for the readings of N messages. Tensions are in N,
    also of robots that measure motor currents.

    Attributes:
        rows: All quantities in one array (..., Q, M), for operations that treat them alike.
    """

    __slots__ = ('rows',)

    length = Quantity('m', 'length beyond what the joints allow', _possible_lengths)
    tension = Quantity('N', 'tension beyond the maximum', reading_range)
    temperature = Quantity(
        '°C', 'impossible temperature', _possible_temperatures, Presence.MEASURED_OR_NAN
    )

    def __init__(self, **values: Array) -> None:
        """Copy the values of some quantities, by name, (..., M); all other quantities are NaN."""
        *first, muscles = next(iter(values.values())).shape
        self.rows: Array = np.full((*first, len(QUANTITIES), muscles), np.nan)
        for name, value in values.items():
            setattr(self, name, value)

    @classmethod
    def of_rows(cls, rows: Array) -> MuscleReadings:
        """Return the readings in an array (..., Q, M), which is not copied."""
        readings = cls.__new__(cls)
        readings.rows = rows
        return readings

    @classmethod
    def stack(cls, readings: Iterable[MuscleReadings]) -> MuscleReadings:
        """Return the readings of several messages as one value, whose arrays are (N, M)."""
        return cls.of_rows(np.array([each.rows for each in readings]))

    @classmethod
    def median(cls, readings: Collection[MuscleReadings]) -> MuscleReadings:
        """Return the median of some messages; NaN where any of them is NaN."""
        if len(readings) == 1:
            return next(iter(readings))
        return cls.of_rows(median_of_rows(np.array([each.rows for each in readings])))

    def at(self, messages: Any) -> MuscleReadings:
        """Return the readings of the messages that an index, a mask or a slice selects."""
        return MuscleReadings.of_rows(self.rows[messages])

    def copy(self) -> MuscleReadings:
        """Return a copy whose quantities can be changed without an effect on this object."""
        return MuscleReadings.of_rows(self.rows.copy())

    def replace(self, **values: ArrayLike) -> MuscleReadings:
        """Return a copy with other values of some quantities, by their names."""
        readings = self.copy()
        for name, value in values.items():
            setattr(readings, name, value)
        return readings

    def to_message(self, source: TensionSource) -> Array:
        """Return the rows of a message of `muscle_states`, (Q, M)."""
        return self.replace(tension=source.to_message(self.tension)).rows


#: the quantities of muscle modules, in the order of the rows of a message
QUANTITIES = tuple(each for each in vars(MuscleReadings).values() if isinstance(each, Quantity))


def first(which: Bools) -> tuple[Quantity, int]:
    """Return the quantity and the muscle of the first true element of `which`, (Q, M)."""
    row, muscle = np.argwhere(which)[0].tolist()
    return QUANTITIES[row], muscle


def possible_readings(robot: Robot) -> tuple[MuscleReadings, MuscleReadings]:
    """Return the lowest and the highest possible readings."""
    low = MuscleReadings.of_rows(np.empty((len(QUANTITIES), robot.muscle_count)))
    high = low.copy()
    for quantity in QUANTITIES:
        lowest, highest = quantity.possible(robot)
        setattr(low, quantity.name, lowest)
        setattr(high, quantity.name, highest)
    return low, high


def raw_muscle_states(message: Any, robot: Robot) -> MuscleReadings:
    """Return the readings in a message of `muscle_states` without a check of their values.

    Motor currents are converted to T_read [N]. Optional rows that the message lacks are NaN. A
    `message` may also be `MuscleReadings`, which are copied.
    """
    if isinstance(message, MuscleReadings):
        return message.copy()
    muscles, count = robot.muscle_count, len(QUANTITIES)
    while QUANTITIES[count - 1].presence is Presence.OPTIONAL:
        if len(message.data) >= count * muscles:
            break
        count -= 1
    rows = np.full((len(QUANTITIES), muscles), np.nan)
    rows[:count] = read_rows(message, count, muscles)
    readings = MuscleReadings.of_rows(rows)
    readings.tension = robot.tension_source.to_newtons(readings.tension)
    return readings


def read_muscle_states(
    message: Any, robot: Robot, isolated: Sequence[int] | Ints = ()
) -> MuscleReadings:
    """Return the readings in a message of `muscle_states` after checking that they are finite.

    Values that are not measured are NaN, where this is legal. Values of isolated muscles are not
    checked: values that are not finite or beyond ±MOST_ISOLATED are replaced by NaN. If the modules
    have no source of tension, tensions are not checked either, and are returned as NaN. Otherwise,
    the conversions are those of `raw_muscle_states`.
    """
    readings = raw_muscle_states(message, robot)
    source, values = robot.tension_source, readings.rows
    if not source.is_known:
        readings.tension = np.nan
    is_legal = np.isfinite(values)
    if not is_legal.all():  # as in each message that lacks an optional row
        may_be_nan = [
            [quantity.presence is not Presence.REQUIRED]
            if quantity is not MuscleReadings.tension
            else [not source.is_known]
            for quantity in QUANTITIES
        ]
        is_legal |= np.isnan(values) & may_be_nan
    if len(isolated) == 0 and is_legal.all():
        return readings
    is_isolated = np.isin(np.arange(robot.muscle_count), isolated)
    values[~(np.abs(values) < MOST_ISOLATED) & is_isolated] = np.nan
    is_legal |= is_isolated
    if not is_legal.all():
        quantity, muscle = first(~is_legal)
        stated = f'{quantity.name} of {robot.muscles[muscle]} is {quantity.of(readings)[muscle]}'
        raise MessageError('not finite', f'{stated}; expected a finite number')
    return readings
