# SPDX-License-Identifier: Apache-2.0
"""What messages of this arm can say at all, beyond their format: levels and steps of every value.

A message beyond these is not used, whoever reads it; `Doubt` tells a glitch from a state of things.
Limits leave room to what five healthy arms showed in a minute of exploring each, with and without
3.6 kg never carried before, by the initial network of preset default: steps of l 0.9 mm in 10 ms,
θ_est up to 0.13 of a joint's range beyond it, T above tension.limit for up to 8.3 s, at most 343 N.
"""

import math

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.robot.robot import Robot

OUTSIDE = 0.1  # of a joint's range: a sensor beyond it errs
ESTIMATE_OUTSIDE = 0.5  # the same of an estimate
TOO_TENSE, TOO_SLACK = 1.1, -0.1  # of tension.max
TEMPERATURES = -40.0, 200.0  # [°C]
SLACK = 0.2  # of T_bias, or of a demanded tension: a wire that pulls less is slack, or cut
WOUND = 1.0  # [m] that such a wire may be wound in further than any joint allows
POSTURES = 500  # that tell how long the muscles get
LENGTH_MARGIN = 0.1  # [m], for wires that wrap, wind slack, or were tied elsewhere
#: a length changes by no more than SLIP + SPEED·dt from message to message [m], [m/s], dt at most
#: HOLE [s]; a new level that lasts is taken after SETTLED [s]
SLIP, SPEED, HOLE, SETTLED = 0.02, 1.0, 0.05, 1.0
MOMENT = 0.1  # [s] that a doubt may last

TENSION = 'tension beyond the maximum'
LENGTH = 'length beyond what the joints allow'
TEMPERATURE = 'temperature of no module'


def length_range(robot: Robot, outside: float = 0.0) -> tuple[Array, Array]:
    """Return least and greatest l [m] (M,) in the joints' ranges and a share of them beyond."""
    theta = robot.random_postures(POSTURES, np.random.default_rng(0), outside)
    slack = np.zeros((POSTURES, robot.muscle_count))
    length = [robot.muscle_lengths(theta, slack + pull) for pull in (0.0, robot.tension.max)]
    return np.min(length, axis=(0, 1)), np.max(length, axis=(0, 1))


def longest_lengths(robot: Robot) -> Array:
    """Return |l| of every muscle that no posture passes [m], shape (M,)."""
    low, high = length_range(robot, OUTSIDE)
    longest: Array = np.maximum(-low, high) + LENGTH_MARGIN
    return longest


def outside_limits(robot: Robot, theta: Array) -> Array:
    """Return how far each joint is beyond its limits, as a share of its range, (D,)."""
    low, high = robot.lower, robot.upper
    share: Array = np.maximum(theta - high, low - theta) / (high - low)
    return share


class Doubt:
    """Since when a kind of message cannot be believed. Times are of one steady clock [s]."""

    def __init__(self) -> None:
        self._why, self._since = '', math.inf

    def note(self, error: MessageError | None, now: float) -> None:
        """Take what is wrong with the newest message, if anything, and raise it."""
        self._since = math.inf if error is None else min(self._since, now)
        self._why = str(error or '')
        if error:
            raise error

    def lasting(self, now: float) -> str:
        """Return what has been wrong for longer than a moment, or ''."""
        return self._why if now - self._since > MOMENT else ''


class Plausibility:
    """Judges the messages of one arm's muscle modules, and its estimates."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        most, longest = robot.description.tension.max, longest_lengths(robot)
        cold, hot, self._unknown = (np.full_like(longest, t) for t in (*TEMPERATURES, np.nan))
        #: possible T, l and temperatures, (3, M)
        self._low = np.array([TOO_SLACK * most, -longest, cold])
        self._high = np.array([TOO_TENSE * most, longest, hot])
        self.muscles, self.estimates = Doubt(), Doubt()
        self._before: Array | None = None  # the last lengths that were believed
        self._came: Array = np.zeros(robot.muscle_count)  # the last ones, whatever they were
        self._came_at, self._settled_since = -math.inf, math.inf
        #: the one muscle whose jump of l was taken; whose jump is not taken yet
        self.jumped: int | None = None
        self._jumps: int | None = None

    def check_muscles(
        self, tension: Array, length: Array | None, temperature: Array, now: float
    ) -> None:
        """Take T [N], l [m] and temperatures [°C] (M,) as they came; no l while zeros are unknown.

        A MessageError says that no muscle of this arm can say that; isolated ones may say anything.
        """
        wound = np.where(tension < SLACK * self._robot.tension.bias, WOUND, 0.0)
        error = self.levels(tension, length, temperature, wound)
        if error is None and length is not None:
            error = self._step(length, now)
        self.muscles.note(error, now)

    def check_estimate(self, theta: Array, now: float) -> None:
        """Take estimated θ [rad] (D,); a MessageError says that no joint can be there."""
        self.estimates.note(self.outside(theta, ESTIMATE_OUTSIDE), now)

    def outside(self, theta: Array, share: float = OUTSIDE) -> MessageError | None:
        """Return what is wrong with a joint further beyond its limits than a share of its range."""
        low, high = self._robot.lower, self._robot.upper
        beyond = outside_limits(self._robot, theta)
        j = int(beyond.argmax())
        if not beyond[j] > share:
            return None
        told = f'{self._robot.joints[j]} {theta[j]:.3g} {self._robot.units[j].theta}'
        limits = f'limits {low[j]:.2f} to {high[j]:.2f}'
        return MessageError('θ far outside the joint limits', f'{told}, {limits}')

    def levels(
        self,
        tension: Array,
        length: Array | None,
        temperature: Array | None = None,
        wound: Array | float = 0.0,
    ) -> MessageError | None:
        """Return what is wrong with a value that no sensor of a used muscle measures, or None.

        wound: By how much a wire may be wound in beyond what the joints allow [m].
        """
        given = (self._unknown if part is None else part for part in (tension, length, temperature))
        values = np.where(self._robot.used, np.array([*given]), np.nan)
        low = self._low.copy()
        low[1] -= wound
        beyond = (values < low) | (values > self._high)
        if not np.count_nonzero(beyond):
            return None
        q, m = np.argwhere(beyond)[0]
        reason, unit = ((TENSION, 'N'), (LENGTH, 'm'), (TEMPERATURE, '°C'))[q]
        told = f'{self._robot.muscles[m]} {values[q, m]:.3g} {unit}'
        ends = f'possible {low[q, m]:.3g} to {self._high[q, m]:.3g}'
        return MessageError(reason, f'{told}, {ends}')

    def _step(self, length: Array, now: float) -> MessageError | None:
        allowed = SLIP + SPEED * min(max(now - self._came_at, 0.0), HOLE)
        before, came = self._before, self._came
        self._came, self._came_at = length, now
        used = self._robot.used
        if before is None or (step := np.abs(length - before) * used)[step.argmax()] <= allowed:
            self._before, self._settled_since = length, math.inf
            return None
        if self._settled_since == math.inf:  # later others may have moved as far
            (far,) = np.nonzero(step > allowed)
            self._jumps = int(far[0]) if len(far) == 1 else None
        if (np.abs(length - came) * used).max() > allowed:
            self._settled_since = now
        self._settled_since = min(self._settled_since, now)
        if now - self._settled_since > SETTLED:
            self.jumped = self._jumps
            self._before, self._settled_since = length, math.inf
            return None
        m = int(step.argmax())
        told = f'{self._robot.muscles[m]} by {1e3 * (length - before)[m]:.0f} mm'
        return MessageError('length jumped', told)
