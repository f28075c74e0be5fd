# SPDX-License-Identifier: Apache-2.0
"""Detects a tension sensor that saturates below the tension limit.

    T_read = min(T + noise, T_sat),   T_sat < T_limit

The readings of a working sensor contain noise, even where a motor can pull no harder. Readings that
stay exactly the same, although this sensor's readings usually vary, are therefore clipped: by the
sensor, its amplifier or the driver. A muscle is reported in two cases:

- Its readings have been clipped twice at the same value, were lower in between, and have not been
  higher. Readings of a frozen sensor are not lower in between (`frozen_sensor.py`).
- Its reading stays the same although its module winds in. The sensor may then also be frozen.

A sensor is not checked if its readings often repeat. Messages that repeat the readings of most
muscles are skipped, such as those of a simulator without noise at rest. Values near T_bias are not
checked, because an ideal module may hold exactly T_bias.

Such a muscle is no longer safe: while its command demands more than T_sat, the module winds in
although its reading does not rise, and neither the limiter nor the watchdog notices. Emulated arms
whose sensors all saturated at 120 to 150 N reached 350 to 420 N, although T_limit was 200 N. A
sensor that saturates above T_limit is no fault, because the limiter keeps the readings below.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.finding import Detector, Finding, Observation
from musculoskeletal_ae.robot.robot import Robot

#: report a module that winds in if its tension reading has stayed the same for this long [s], and
#: the module has wound in by WOUND meanwhile
WINDING_TIME = 0.5
WOUND = 0.005  # length that the module must have wound in for such a report [m]
#: record that a reading has been clipped at a value (a visit) once it has stayed exactly there for
#: this long [s]
LASTING = 0.15
VISITS = 2  # report a muscle once its reading has been clipped this often at the same value
SAME = 2e-3  # treat two tension readings as the same value if they differ by less than this share
#: record that a reading has been clipped again only after it has fallen by this share in between
BELOW = 0.1
#: drop a suspected saturation value once readings have been higher for this long [s]; a spike is
#: shorter
BEYOND = 0.05
#: Check a sensor only if more than this share of its readings, below the highest ones, differ from
#: the reading before. Otherwise, a repeated reading is no sign of saturation.
VARYING = 0.5
MEMORY = 10.0  # average the share of differing readings over this time (time constant) [s]
#: check only readings above this multiple of T_bias: an ideal module may hold exactly T_bias, and
#: its constant reading would look saturated
LEAST = 1.5


class SaturatedSensor(Detector):
    """Reports a muscle whose tension readings are clipped at a value below T_limit."""

    def __init__(self, robot: Robot) -> None:
        self._robot, count = robot, robot.muscle_count
        self._limit = robot.description.tension.limit
        self._bias = robot.description.tension.bias
        self._highest: Array = np.zeros(count)  # highest value of two successive readings [N]
        #: share of the readings below the highest ones that differed from the reading before, (M,)
        self._varying: Array = np.zeros(count)
        self.reset()

    def reset(self) -> None:
        """Reset the detector: forget at which values readings were clipped."""
        count = self._robot.muscle_count
        self._before: Array = np.full(count, np.nan)  # reading of the previous message [N]
        self._unchanged: Array = np.zeros(count)  # time without a change of the reading [s]
        self._length: Array = np.zeros(count)  # length when the reading changed last [m]
        self._beyond: Array = np.zeros(count)  # time for which it has exceeded `_value` [s]
        self._value: Array = np.full(count, np.nan)  # value at which the reading was clipped [N]
        self._visits: Ints = np.zeros(count, dtype=np.int64)
        self._has_visits = False  # whether the reading of any muscle has been clipped
        self._has_left = np.ones(count, dtype=bool)  # whether readings were clearly below `_value`

    def step(self, observation: Observation) -> Finding | None:
        """Report a muscle whose tension reading is clipped, or return None.

        The reading must have been clipped twice at the same value, or while the module winds in.
        """
        sample, dt, value = observation.sample, observation.dt, self._value
        reading = sample.newest.tension
        is_same = reading == self._before
        same_count = np.count_nonzero(is_same)
        if 2 * same_count > len(is_same):  # a repeated message
            return None
        self._highest = np.fmax(self._highest, np.minimum(reading, self._before))
        self._before = reading
        is_below = ~(reading >= (1.0 - SAME) * self._highest)
        self._varying += dt / MEMORY * is_below * (~is_same - self._varying)
        if not same_count and not self._has_visits:  # the usual case: no reading is clipped
            self._unchanged, self._length = np.zeros(len(is_same)), sample.length
            return None
        self._unchanged = (self._unchanged + dt) * is_same
        self._length = np.where(is_same, self._length, sample.length)
        self._has_left |= reading < (1.0 - BELOW) * value
        self._beyond = (self._beyond + dt) * (reading > (1.0 + SAME) * value)
        is_clipped = (self._unchanged >= LASTING) & (self._varying > VARYING) & sample.usable
        is_clipped &= (reading > LEAST * self._bias) & (reading < self._limit)
        at_value = np.abs(reading - value) <= SAME * value
        again, new = is_clipped & at_value & self._has_left, is_clipped & ~at_value
        is_wrong = self._beyond > BEYOND
        self._visits = np.where(new, 1, self._visits + again) * ~is_wrong
        self._value = np.where(is_wrong, np.nan, np.where(new, reading, value))
        self._has_visits = bool(np.isfinite(self._value).any())
        self._has_left = (self._has_left & ~(again | new)) | is_wrong
        wound = is_clipped & (self._unchanged >= WINDING_TIME)
        wound &= self._length - sample.length > WOUND
        if wound.any():
            muscle = int(wound.argmax())
            text = f'its tension stays at exactly {reading[muscle]:.0f} N while its module winds in'
            evidence = f'{text}: the sensor saturates or is frozen'
            return Finding(muscle, ConditionKind.SENSOR_SATURATED, evidence)
        if self._visits.max() < VISITS:
            return None
        muscle = int(self._visits.argmax())
        evidence = f'its tension sensor saturates at {self._value[muscle]:.0f} N'
        return Finding(muscle, ConditionKind.SENSOR_SATURATED, evidence)
