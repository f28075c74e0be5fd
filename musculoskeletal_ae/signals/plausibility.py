# SPDX-License-Identifier: Apache-2.0
"""Checks single values of `muscle_states` for plausibility. Jumps are checked in `length_jumps`."""

from __future__ import annotations

import math

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_states import MuscleReadings, first, possible_readings
from musculoskeletal_ae.signals.reading_limits import LIMITS, slack_tension


class LevelCheck:
    """Checks every value of a message against the limits of plausible sensor values."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        #: lowest and highest possible readings
        self._low, self._high = possible_readings(robot)
        self._slack = slack_tension(robot.description.tension.bias)

    def plausible(self, readings: MuscleReadings, offset: Array) -> MuscleReadings:
        """Return the plausible values of a message; implausible values become −∞.

        The length offsets `offset` [m], (M,), are subtracted. A length may exceed its range by
        `slack_length_margin`, because the module may have lost its length offset.
        """
        margin = LIMITS.slack_length_margin
        low = self._low.replace(length=self._low.length - margin)
        high = self._high.replace(length=self._high.length + margin)
        values = readings.replace(length=readings.length - offset).rows
        is_possible = (values >= low.rows) & (values <= high.rows)
        return MuscleReadings.of_rows(np.where(is_possible, values, -np.inf))

    def problem(
        self, readings: MuscleReadings, used: Bools, lengths_known: bool
    ) -> tuple[str, str] | None:
        """Return reason and detail of the first implausible value, for users; None without one.

        Args:
            readings: Readings with the length offset removed; NaN is ignored.
            used: Which muscles to check, (M,).
            lengths_known: Whether to check l, which requires known length offsets.
        """
        values, low, high = readings.rows, self._low, self._high
        if not np.count_nonzero((values < low.rows) | (values > high.rows)):
            return None
        # A slack tendon, such as that of a ruptured muscle, can be wound in beyond any posture.
        margin = np.where(readings.tension < self._slack, LIMITS.slack_length_margin, 0.0)
        low = low.replace(length=low.length - margin)
        if not lengths_known:
            low, high = low.replace(length=-np.inf), high.replace(length=np.inf)
        beyond = ((values < low.rows) | (values > high.rows)) & used
        if not np.count_nonzero(beyond):
            return None
        quantity, muscle = first(beyond)
        value, least, most = distinct(
            *(quantity.of(each)[muscle] for each in (readings, low, high))
        )
        stated = f'{self._robot.muscles[muscle]} {value} {quantity.unit}'
        return quantity.reason, f'{stated}, legal: {least} to {most} {quantity.unit}'


class TemperatureCheck:
    """Accepts a temperature that the housing can have reached since the last accepted temperature.

    A glitch of a few messages, such as 199 °C, therefore has no effect. If a sensor continues to
    read 199 °C, the reading is accepted some seconds later, because a hot module must stop the arm.
    """

    def __init__(self, muscle_count: int) -> None:
        #: last accepted temperature [°C], (M,); NaN before the first
        self._believed: Array = np.full(muscle_count, math.nan)
        self._age: Array = np.zeros(muscle_count)  # age of the last accepted temperature [s]
        self._first: Array = self._believed.copy()  # candidate for the first temperature [°C]
        #: time for which readings have agreed with `_first` [s]
        self._first_age: Array = np.zeros(muscle_count)
        self._last_at = math.nan

    def step(self, read: Array, now: float) -> Array:
        """Check the readings [°C] of all modules at `now` [s]; return accepted temperatures, (M,).

        A temperature is NaN if its reading is impossible, or if none has been accepted yet.
        """
        elapsed = max(now - self._last_at, 0.0) if math.isfinite(self._last_at) else 0.0
        self._last_at = now
        possible = (read >= LIMITS.lowest_temperature) & (read <= LIMITS.highest_temperature)
        self._age += elapsed
        change = LIMITS.temperature_step + LIMITS.temperature_rate * self._age
        accepted = possible & (np.abs(read - self._believed) <= change)
        if np.count_nonzero(np.isnan(self._believed)):
            accepted |= self._begins(np.where(possible, read, math.nan), elapsed)
        self._believed = np.where(accepted, read, self._believed)
        self._age = np.where(accepted, 0.0, self._age)
        return np.where(possible, self._believed, math.nan)

    def _begins(self, read: Array, elapsed: float) -> Bools:
        """Return which muscles receive their first accepted temperature now, (M,).

        Their readings must have agreed for longer than `LIMITS.glitch`.
        """
        agrees = np.abs(read - self._first) <= LIMITS.temperature_step
        self._first_age = np.where(agrees, self._first_age + elapsed, 0.0)
        self._first = np.where(agrees, self._first, read)
        begins: Bools = np.isnan(self._believed) & (self._first_age > LIMITS.glitch)
        return begins
