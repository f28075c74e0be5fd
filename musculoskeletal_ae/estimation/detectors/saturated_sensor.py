# SPDX-License-Identifier: Apache-2.0
"""Detects a tension sensor that saturates: its readings pile up at one highest value.

    T_read = min(T + noise, T_sat)

The readings of a working sensor contain noise, also where a motor can pull no harder. Readings that
stay exactly the same, although this sensor's readings usually vary, are therefore clipped: by the
sensor, its amplifier or the driver. A muscle is reported if its readings have been clipped several
times at the same value, were lower in between, and have not been higher. A frozen sensor is not
lower in between (`frozen_sensor.py`). Drivers whose readings often repeat are not checked.

A saturated sensor is a warning, not a finding that stops the arm: readings below T_sat are right,
and muscle stiffness control turns a module only until it has reached the length that belongs to the
commanded tension. Above T_sat, however, no reading shows a tension above `tension.limit`.
"""

from collections.abc import Iterable

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.estimation.finding import Detector, Observation
from musculoskeletal_ae.robot.robot import Robot

LASTING = 0.2  # count a visit to a value after the reading has stayed exactly there this long [s]
VISITS = 3  # report a muscle after this number of visits at the same value
SAME = 2e-3  # two visits are at the same value if they differ by less than this share of it
BELOW = 0.1  # count another visit only after the reading was lower by this share of the value
#: forget a value after the reading has been higher for this long [s]; a spike is shorter
BEYOND = 0.05
#: share of the messages in which a reading below the value has to differ from the previous one
VARYING = 0.7
MEMORY = 10.0  # time constant of this share [s]


class SaturatedSensor(Detector):
    """Names the muscles whose tension sensor saturates, with the highest value that it reads.

    Attributes:
        saturated: T_sat [N] of each muscle whose sensor saturates, by index.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot, count = robot, robot.muscle_count
        self.saturated: dict[int, float] = {}
        self._before: Array = np.full(count, np.nan)  # reading of the previous message [N]
        self._unchanged: Array = np.zeros(count)  # time without a change of the reading [s]
        self._varying: Array = np.zeros(count)  # share of the messages with another reading
        self._value: Array = np.full(count, np.nan)  # value of the last visit [N]
        self._visits: Ints = np.zeros(count, dtype=np.int64)
        self._beyond: Array = np.zeros(count)  # time for which the reading has been higher [s]
        self._has_left = np.ones(count, dtype=bool)  # whether it was lower since the last visit

    @property
    def text(self) -> str:
        """A sentence for users; '' without a saturated sensor."""
        if not self.saturated:
            return ''
        each = (f'{self._robot.muscles[m]} ({top:.0f} N)' for m, top in self.saturated.items())
        return (
            f'a tension sensor saturates: it reads at most the value in brackets: '
            f'{", ".join(each)}; higher tensions are neither measured nor limited; set '
            'tension.limit below this value, or replace the sensor'
        )

    def reset(self) -> None:
        """Restart the measurement of how long readings have been the same."""
        self._before[:] = np.nan
        self._unchanged[:] = self._beyond[:] = 0.0

    def accept(self, muscles: Iterable[int]) -> None:
        """Consider these muscles (indices) healthy in their present state."""
        which = list(muscles)
        self._visits[which], self._value[which], self._has_left[which] = 0, np.nan, True
        self._name()

    def step(self, observation: Observation) -> None:
        """Count the visits of all muscles; the result is always None."""
        reading, dt = observation.sample.newest[1], observation.dt
        is_same, value = reading == self._before, self._value
        self._before = reading
        self._unchanged = (self._unchanged + dt) * is_same
        self._has_left |= reading < (1.0 - BELOW) * value
        self._beyond = (self._beyond + dt) * (reading > (1.0 + SAME) * value)
        is_below = ~(reading >= (1.0 - SAME) * value)
        share = dt / MEMORY * is_below
        self._varying = self._varying + share * (~is_same - self._varying)
        arrived = (self._unchanged >= LASTING) & (self._varying > VARYING)
        at_value = np.abs(reading - value) <= SAME * value
        again, new = arrived & at_value & self._has_left, arrived & ~at_value
        self._visits = np.where(new, 1, self._visits + again)
        self._value = np.where(new, reading, value)
        self._has_left &= ~(again | new)
        if (self._beyond > BEYOND).any():
            self.accept(np.flatnonzero(self._beyond > BEYOND).tolist())
            self._beyond[self._beyond > BEYOND] = 0.0
        self._name()

    def _name(self) -> None:
        named = np.flatnonzero(self._visits >= VISITS) if self._visits.max() >= VISITS else ()
        self.saturated = {int(m): float(self._value[m]) for m in named}
