# SPDX-License-Identifier: Apache-2.0
"""Which causes to stop the arm are present now, by the age of data, load and heat.

`now` is a steady clock [s], on which ages run; `time` is that of the messages, by which commands
change. Where the messages' clock is slow, as of a slow simulator, data may be older by as much, up
to `SLOWEST`; a fast clock makes no age limit shorter. The controller's own pauses make no data old.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.control.stops import Condition, StopCause
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.heat import Heat
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

LONGEST_STEP = 0.1  # [s]; after a pause control goes on instead of catching up
OWN_PAUSE = 0.3  # [s] between two steps; what is longer counts for no age
SLOWEST = 0.05  # pace of the messages' clock, of real time, below which ages grow no further
PACE_SPAN = 1.0  # [s] over which the two clocks are compared
OVERHEATED = 20.0  # [°C] above temperature_limit
#: times tension.limit, and for how long [s] a tension may be higher: the limiter pays such a muscle
#: out at once; where that does not help, the whole arm is paid out
OVERLOAD, OVERLOAD_TIME = 1.1, 0.2

MUSCLE_STATES, ESTIMATE = StopCause.STALE_MUSCLE_STATES, StopCause.STALE_ESTIMATE


class Step(NamedTuple):
    """How much time one step of control stands for."""

    dt: float  # on the messages' clock [s]
    elapsed: float  # on the steady clock [s]
    has_paused: bool  # whether control itself paused before: the arm may be elsewhere


class DataAge:
    """How old the data is, and how fast the messages' clock runs."""

    def __init__(self) -> None:
        self.stepped_at = -math.inf
        self._came_at = {MUSCLE_STATES: -math.inf, ESTIMATE: -math.inf}
        self._time = math.nan  # of the messages at the last step [s]
        self._asleep = 0.0  # [s] of own pauses so far
        self.pace = 1.0  # of the messages' clock beside the steady one

    def awake(self, now: float) -> float:
        """Return the time [s] without the pauses of the controller itself."""
        return now - self._asleep

    def received(self, what: StopCause, now: float) -> float:
        """Note that data came whose age `what` is about; return the time since the last [s]."""
        awake, before = self.awake(now), self._came_at[what]
        self._came_at[what] = awake
        return awake - before if before > -math.inf else 0.0

    def stale(self, now: float, max_age: float) -> list[Condition]:
        """Return which data is older than `max_age` [s]."""
        allowed = max_age / min(max(self.pace, SLOWEST), 1.0)
        return [
            Condition(cause, f'older than {allowed:.3g} s')
            for cause, came_at in self._came_at.items()
            if self.awake(now) - came_at > allowed
        ]

    def clock_jumped_back(self) -> None:
        """Count the messages' time from here."""
        self._time, self.pace = math.nan, 1.0

    def step(self, now: float, time: float, is_stopped: bool) -> Step:
        """Return how much time has passed since the last step."""
        elapsed, passed = max(now - self.stepped_at, 0.0), time - self._time
        if self.stepped_at == -math.inf or math.isnan(passed):
            elapsed = passed = 0.0
        self.stepped_at, self._time = now, time
        counted = min(elapsed, OWN_PAUSE)
        self._asleep += elapsed - counted
        has_jumped = not 0.0 <= passed < LONGEST_STEP + 10.0 * counted
        if counted > 0.0 and not has_jumped:
            share = 1.0 - math.exp(-counted / PACE_SPAN)
            self.pace += share * (passed / counted - self.pace)
        # Where the messages' clock stands still for good, a stop must release the arm all the same.
        if self.pace < SLOWEST and is_stopped:
            passed = elapsed
        dt = min(max(passed, 0.0), LONGEST_STEP)
        return Step(dt, min(elapsed, LONGEST_STEP), elapsed > OWN_PAUSE)


class Overload:
    """Which muscles pull above OVERLOAD times `tension.limit`, and for how long."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._level: Array = OVERLOAD * robot.tension.limit
        self._since: Array = np.full(robot.muscle_count, math.inf)  # above it, since when [s]

    def take(self, tension: Array, awake: float) -> None:
        """Take T [N] (M,), without glitches."""
        self._since = np.where(tension > self._level, np.minimum(self._since, awake), math.inf)

    @property
    def tense(self) -> list[str]:
        """Names of the muscles that pull too hard, and how hard is too hard."""
        each = zip(self._robot.muscles, self._level, self._since, strict=True)
        return [f'{name} (above {level:.0f} N)' for name, level, at in each if at < math.inf]

    def conditions(self, awake: float) -> list[Condition]:
        """Return the overload, if there is one."""
        m = int(self._since.argmin())
        if awake - self._since[m] <= OVERLOAD_TIME:
            return []
        level = f'{self._level[m]:.0f} N for {OVERLOAD_TIME:g} s'
        detail = f'{self._robot.muscles[m]}: tension above {level}'
        return [Condition(StopCause.OVERLOAD, detail)]


class HeatLimit:
    """What the temperature of the windings lets the muscles pull.

    Attributes:
        heat: The thermal model of all modules.
        planned: Highest tension that may be planned for each muscle [N], (M,).
        momentary: Highest tension that is never exceeded [N], (M,).
    """

    def __init__(self, robot: Robot) -> None:
        self.heat = Heat(robot)
        self._is_overheated = False
        self.planned: Array = np.full(robot.muscle_count, robot.tension.max)
        self.momentary = self.planned

    def take(self, robot: Robot, sample: MuscleSample, elapsed: float) -> None:
        """Take muscle states, `elapsed` [s] after the last ones."""
        tension = sample.newest[1]
        # The tension that an isolated muscle reads may be anything; it is told to pull T_bias.
        pull = np.where(robot.used, tension, robot.description.tension.bias)
        self.heat.step(pull, sample.temperature, elapsed)

    def lower(self, highest: float, fall: Array | float) -> None:
        """Let the limits follow the temperatures, and fall by at most so much [N]."""
        planned, momentary = self.heat.limits(highest)
        self.planned = np.maximum(planned, self.planned - fall)
        self.momentary = np.maximum(momentary, self.momentary - fall)

    def conditions(self, robot: Robot, highest: float) -> list[Condition]:
        """Return the overheating, if there is one; it lasts until all are below `highest` [°C]."""
        winding = np.fmax(self.heat.core, -np.inf)  # NaN is unknown
        m = int(winding.argmax())
        is_hot = bool(winding[m] > highest + (0.0 if self._is_overheated else OVERHEATED))
        can_pull = robot.used & (self.planned > robot.tension.bias)
        self._is_overheated = is_hot or bool(robot.used.any() and not can_pull.any())
        if not self._is_overheated:
            return []
        warm, most = distinct(winding[m], highest)
        detail = f'{robot.muscles[m]} {warm} °C, limit {most} °C'
        return [Condition(StopCause.OVERHEATED, detail)]


class Watchdog:
    """Collects the causes that are present."""

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self.age, self.overload, self.heat = DataAge(), Overload(robot), HeatLimit(robot)
        self.has_checkpoint = self.has_anomaly = False
        self.second_publisher = ''  # who publishes beside the rightful publishers
        self.use(robot, settings)

    def use(self, robot: Robot, settings: Settings) -> None:
        """Watch this robot, whose isolated muscles do not count, by these settings."""
        self._robot, self._settings = robot, settings

    def take_sample(self, sample: MuscleSample, now: float) -> None:
        """Take plausible muscle states."""
        self.heat.take(self._robot, sample, self.age.received(MUSCLE_STATES, now))
        self.overload.take(sample.motor_tension * sample.usable, self.age.awake(now))

    def take_estimate(self, now: float) -> None:
        """Take that a plausible estimate came."""
        self.age.received(ESTIMATE, now)

    def conditions(self, now: float) -> list[Condition]:
        """Return the causes that are present now, the most severe first."""
        present = []
        if not self.has_checkpoint:
            present.append(Condition(StopCause.NO_CHECKPOINT))
        if self.has_anomaly:
            present.append(Condition(StopCause.ANOMALY))
        if self.second_publisher:
            present.append(Condition(StopCause.SECOND_PUBLISHER, self.second_publisher))
        settings = self._settings
        present += self.overload.conditions(self.age.awake(now))
        present += self.heat.conditions(self._robot, settings.temperature_limit)
        present += self.age.stale(now, settings.max_age)
        return present
