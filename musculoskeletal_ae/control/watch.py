# SPDX-License-Identifier: Apache-2.0
"""Why the arm must not move now: what its sensors say, how old that is, and what others found.

The arm must not move without a checked network, during an anomaly, on muscle_states or estimates
that were implausible for more than a moment, while somebody else sends muscle_states as well, on
data older than `max_age`, after overload, and while overheated. The first of these is the cause.
A cause ends with what it says; that a stop for it latches is the controller's doing.

`now` is a steady clock [s], on which ages run; `time` is that of the messages, by which commands
change. Where the messages' clock is slow, as of a slow simulator, ages may be larger by as much, up
to SLOWEST; a fast one makes no age shorter. The controller's own pauses make nothing old.
"""

import math
from collections import deque

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, median_of_rows
from musculoskeletal_ae.control.safety import Muscles
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.heat import Heat
from musculoskeletal_ae.plausibility import TEMPERATURES, Plausibility
from musculoskeletal_ae.robot.robot import Robot

LONGEST_STEP = 0.1  # [s]; after a pause control goes on instead of catching up
OWN_PAUSE = 0.3  # [s] between two steps; what is longer counts for no age
SLOWEST = 0.05  # of real time
PACE_SPAN = 1.0  # [s] over which the messages' clock is compared
OVERHEATED = 20.0  # [°C] above temperature_limit
OVERLOAD_MOMENT = 1.0  # [s] of a tension nearer to tension.max than to tension.limit


class Watch:
    """Finds why the arm must not move, and what heat lets the muscles pull."""

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self._robot, self.settings = robot, settings
        self.checkpoint = self.anomaly = False  # whether there is one
        self.intruder = ''  # who else sends muscle_states
        self._plausibility = Plausibility(robot)
        self.stepped_at = -math.inf
        self._came_at = dict.fromkeys(('muscle_states', 'estimated_joint_states'), -math.inf)
        self._time, self._asleep = math.nan, 0.0  # [s] of own pauses
        self.pace = 1.0  # of the messages' clock beside the steady one
        self.heat = Heat(robot)
        self._temperatures: deque[Array] = deque(maxlen=5)
        self._overheated = False
        #: tensions that heat allows each muscle for long, and for a moment [N], (M,)
        self.limit: Array = np.full(robot.muscle_count, robot.tension.max)
        self.most = self.limit
        limits = robot.tension
        #: tensions [N] that are too high for long, and for more than a moment
        self._overloads = np.array([limits.limit, 0.5 * (limits.limit + limits.max)])
        #: since when each muscle pulls above each of them
        self._tense_since: Array = np.full((2, robot.muscle_count), math.inf)

    def muscles(self, muscles: Muscles, zeroed: bool, now: float) -> None:
        """Take muscle_states; a MessageError says that no muscles of this arm can be so."""
        length, tension, temperature = muscles
        # While zeros are unknown a guess may make any length of them, and any posture.
        self._plausibility.check_muscles(tension, length if zeroed else None, temperature, now)
        awake = now - self._asleep
        before, self._came_at['muscle_states'] = self._came_at['muscle_states'], awake
        since = awake - before if before > -math.inf else 0.0
        # NaN is not known, and no reason for anything; so is what an isolated module cannot be.
        # One that can be hot burns whoever uses it, but its tension may be anything: it is told to
        # pull T_bias at most.
        low, high = TEMPERATURES
        possible = (temperature >= low) & (temperature <= high)
        self._temperatures.append(np.where(possible, temperature, -np.inf))
        pull = np.where(self._robot.used, tension, self._robot.description.tension.bias)
        self.heat.step(pull, median_of_rows(np.array(self._temperatures)), since)

    def pulled(self, tension: Array, now: float) -> None:
        """Take T [N] (M,) of the same muscle_states, without glitches."""
        since = np.minimum(self._tense_since, now - self._asleep)
        self._tense_since = np.where(tension > self._overloads, since, math.inf)

    def estimated(self, theta: Array, now: float) -> None:
        """Take estimated θ [rad] (D,); a MessageError says that no joints can be there."""
        self._plausibility.check_estimate(theta, now)
        self._came_at['estimated_joint_states'] = now - self._asleep

    def forget(self) -> None:
        """Judge messages anew, as where lengths have another zero."""
        self._plausibility = Plausibility(self._robot)

    def clock_jumped_back(self) -> None:
        """Count the messages' time from here."""
        self._time, self.pace = math.nan, 1.0
        self.forget()

    def step(self, now: float, time: float, stopped: bool) -> tuple[float, float, bool]:
        """Return how long this step is on the messages' clock, and on the steady one [s].

        And whether control paused before it: the arm may be elsewhere by now.
        """
        since, passed = max(now - self.stepped_at, 0.0), time - self._time
        if self.stepped_at == -math.inf or math.isnan(passed):
            since = passed = 0.0
        self.stepped_at, self._time = now, time
        counted = min(since, OWN_PAUSE)
        self._asleep += since - counted
        if counted > 0.0 and 0.0 <= passed < LONGEST_STEP + 10.0 * counted:  # no jump
            share = 1.0 - math.exp(-counted / PACE_SPAN)
            self.pace += share * (passed / counted - self.pace)
        # Where the messages' clock stands still for good, a stop must still let go.
        passed = since if self.pace < SLOWEST and stopped else passed
        awake = min(since, LONGEST_STEP)
        return min(max(passed, 0.0), LONGEST_STEP), awake, since > OWN_PAUSE

    def limit_by_heat(self, fall: Array | float) -> None:
        """Let no limit fall by more than so much [N]: what the rate limit pays out."""
        held, most = self.heat.limits(self.settings.temperature_limit)
        self.limit = np.maximum(held, self.limit - fall)
        self.most = np.maximum(most, self.most - fall)

    def present_cause(self, now: float) -> str:
        """Return why the arm must not move now, or ''."""
        if not self.checkpoint:
            return 'no checkpoint'
        if self.anomaly:
            return 'anomaly_detected; call estimator/reset when it is mended'
        doubts = self._plausibility
        for what, doubt in (('muscle_states', doubts.muscles), ('estimate', doubts.estimates)):
            if why := doubt.lasting(now):
                return f'{what}: {why}'
        return self.intruder or self.late(now) or self._overload(now) or self._overheat()

    def late(self, now: float) -> str:
        """Return which data is too old, or ''."""
        allowed = self.settings.max_age / min(max(self.pace, SLOWEST), 1.0)
        for what, at in self._came_at.items():
            if now - self._asleep - at > allowed:
                return f'{what} older than {allowed:.3g} s'
        return ''

    @property
    def strained(self) -> Bools:
        """Which muscles have pulled above tension.limit for half the time that stops them, (M,)."""
        since = self.stepped_at - self._asleep - self._tense_since[0]
        strained: Bools = since > 0.5 * self.settings.overload_time
        return strained

    @property
    def tense(self) -> list[str]:
        """Muscles that pull above tension.limit."""
        return [n for n, t in zip(self._robot.muscles, self._tense_since[0]) if t < math.inf]

    def _overload(self, now: float) -> str:
        longest = self.settings.overload_time, OVERLOAD_MOMENT
        for since, allowed, most in zip(self._tense_since, longest, self._overloads):
            m = int(since.argmin())
            if now - self._asleep - since[m] > allowed:
                name = self._robot.muscles[m]
                return f'{name}: tension above {most[m]:g} N for {allowed:g} s'
        return ''

    def _overheat(self) -> str:
        now, robot = np.fmax(self.heat.core, -np.inf), self._robot  # NaN is not known
        highest, m = self.settings.temperature_limit, int(now.argmax())
        hot = now[m] > highest + (0.0 if self._overheated else OVERHEATED)
        able = np.count_nonzero(robot.used & (self.limit > robot.tension.bias))
        self._overheated = bool(hot or (not able and robot.used.any()))
        if not self._overheated:
            return ''
        return f'overheated: {robot.muscles[m]} {now[m]:.0f} °C, limit {highest:g} °C'
