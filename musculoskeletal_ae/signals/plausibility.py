# SPDX-License-Identifier: Apache-2.0
"""Checks single values of `muscle_states` for plausibility. Jumps are checked in `length_jumps`."""

from __future__ import annotations

import math

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.limits import LIMITS, slack_tension
from musculoskeletal_ae.signals.muscle_readings import QUANTITIES, Row, possible_readings


class LevelCheck:
    """Checks every value of a message against the limits of plausible sensor values."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        #: lowest and highest possible value of each quantity, (Q, M)
        self._low, self._high = possible_readings(robot)
        self._slack = slack_tension(robot.description.tension.bias)

    def plausible_pull(self, states: Array, offset: Array) -> Array:
        """Return the plausible lengths [m] and tensions [N] of a message, together (2, M).

        The length offsets `offset` [m], (M,), are subtracted. Implausible values become −∞.

        A length may exceed its range by `slack_length_margin`, because the module may have lost its
        length offset.
        """
        pull = states[:2].copy()
        pull[0] -= offset
        margin = np.array([[LIMITS.slack_length_margin], [0.0]])
        legal = (pull >= self._low[:2] - margin) & (pull <= self._high[:2] + margin)
        plausible: Array = np.where(legal, pull, -np.inf)
        return plausible

    def problem(self, states: Array, used: Bools, lengths_known: bool) -> tuple[str, str] | None:
        """Return reason and detail of the first implausible value, for users; None without one.

        Args:
            states: Readings, (Q, M), with the length offset removed; NaN is ignored.
            used: Which muscles to check, (M,).
            lengths_known: Whether to check l, which requires known length offsets.
        """
        beyond = (states < self._low) | (states > self._high)
        if not np.count_nonzero(beyond):
            return None
        low = self._low.copy()
        # A slack tendon, such as that of a ruptured muscle, can be wound in beyond any posture.
        low[Row.LENGTH] -= np.where(
            states[Row.TENSION] < self._slack, LIMITS.slack_length_margin, 0.0
        )
        beyond = ((states < low) | (states > self._high)) & used
        beyond[Row.LENGTH] &= lengths_known
        if not np.count_nonzero(beyond):
            return None
        row, muscle = np.argwhere(beyond)[0]
        quantity = QUANTITIES[row]
        place = row, muscle
        value, least, most = distinct(states[place], low[place], self._high[place])
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
