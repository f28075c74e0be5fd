# SPDX-License-Identifier: Apache-2.0
"""The watchdog: detects stop causes from load, temperature, and the age of data.

`now` is the time of a steady clock [s], by which ages are measured. `time` is the time of the
messages' clock [s], by whose steps commands advance.

In a slow simulator, the messages' clock runs at a fraction of real time. The allowed age is then
divided by this fraction, but by no less than `SLOWEST`. A fast clock does not shorten the allowed
age (`arrival`). Pauses of the controller itself do not count as age.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.awake_clock import PAUSE, AwakeClock
from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.control.settings import Setup
from musculoskeletal_ae.messages.arrival import LONGEST_STEP, Arrival
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.heat import Heat, soon
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

#: extend age limits no further if the messages' clock is slower than this share of real time; the
#: steps of a stopped arm then follow the steady clock
SLOWEST = 0.05
PACE_SPAN = 1.0  # average the pace of the messages' clock with this time constant [s]
#: stop the arm if a winding is hotter than the parameter temperature_limit by this [°C]
OVERHEATED = 20.0
#: stop the arm if a tension exceeds this multiple of tension.limit for OVERLOAD_TIME; meanwhile,
#: the limiter pays out the muscle
OVERLOAD = 1.1
OVERLOAD_TIME = 0.2  # stop the arm after an overload of this duration [s]


class ControlStep(NamedTuple):
    """Time between two steps of control; each duration is at most LONGEST_STEP."""

    #: duration on the messages' clock [s]; of a stopped arm, it is that on the steady clock if the
    #: pace of the messages' clock is below SLOWEST
    dt: float
    elapsed: float  # duration on the steady clock [s]
    has_paused: bool  # whether control paused before the step, so that the arm may have moved


class ControlSteps:
    """Measures the time between steps of control, and the pace of the messages' clock.

    Attributes:
        stepped_at: Time of the last step on the steady clock [s].
        pace: Pace of the messages' clock relative to the steady clock.
    """

    def __init__(self, clock: AwakeClock) -> None:
        """Begin to measure steps with `clock`, which each step ticks."""
        self._clock = clock
        self._time = math.nan  # time of the messages' clock at the last step [s]
        self.stepped_at = -math.inf
        self.pace = 1.0

    def allowed_age(self, max_age: float) -> float:
        """Return `max_age` [s], divided by the pace of the messages' clock while this is slow."""
        return max_age / min(max(self.pace, SLOWEST), 1.0)

    def clock_jumped_back(self) -> None:
        """Restart the comparison of the clocks, because the messages' clock has jumped back."""
        self._time, self.pace = math.nan, 1.0

    def step(self, now: float, time: float, is_stopped: bool) -> ControlStep:
        """Begin a step of control, and return the time since the previous step.

        Args:
            now: Time of the steady clock [s].
            time: Time of the messages' clock [s].
            is_stopped: Whether the arm is stopped.
        """
        elapsed, passed = max(now - self.stepped_at, 0.0), time - self._time
        if self.stepped_at == -math.inf or math.isnan(passed):
            elapsed = passed = 0.0
        self.stepped_at, self._time = now, time
        self._clock.tick(now)
        counted = min(elapsed, PAUSE)
        has_jumped = not 0.0 <= passed < LONGEST_STEP + 10.0 * counted
        if counted > 0.0 and not has_jumped:
            share = 1.0 - math.exp(-counted / PACE_SPAN)
            self.pace += share * (passed / counted - self.pace)
        # A stop has to release the arm even if the messages' clock stands still.
        if self.pace < SLOWEST and is_stopped:
            passed = elapsed
        dt = min(max(passed, 0.0), LONGEST_STEP)
        return ControlStep(dt, min(elapsed, LONGEST_STEP), elapsed > PAUSE)


class Overload:
    """Detects muscles with tensions above OVERLOAD times `tension.limit`.

    An overload lasts from the time at which its first message was sent to the time at which its
    last message was sent. The time since the last message was received is added, but at most
    LONGEST_STEP. Hence neither a late message nor a pause of the controller turns a short peak into
    an overload.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._level: Array = OVERLOAD * robot.tension.limit
        #: time of sending of the message with which each muscle's overload began [s]; ∞ without an
        #: overload
        self._since: Array = np.full(robot.muscle_count, math.inf)
        #: times of reception and of sending of the newest message [s]
        self._received_at = self._sent_at = -math.inf

    def take(self, tension: Array, now: float, delay: float) -> None:
        """Record which filtered tensions of a message exceed the permitted level.

        Args:
            tension: Tensions T [N], (M,). Where it is not finite, nothing changes.
            now: Time of reception by the steady clock [s].
            delay: How late the message is (`Arrival.delay`) [s].
        """
        self._received_at, self._sent_at = now, now - delay
        earliest = np.minimum(self._since, self._sent_at)
        since = np.where(tension > self._level, earliest, math.inf)
        self._since = np.where(np.isfinite(tension), since, self._since)

    def conditions(self, now: float) -> list[Condition]:
        """Return the stop condition of an overload that has lasted longer than OVERLOAD_TIME.

        The list is empty if there is no such overload.
        """
        age = min(now - self._received_at, LONGEST_STEP)
        tense = np.flatnonzero(self._sent_at + age - self._since > OVERLOAD_TIME)
        if not tense.size:
            return []
        muscles = [self._robot.muscles[m] for m in tense]
        levels = (f'{self._robot.muscles[m]} above {self._level[m]:.0f} N' for m in tense)
        detail = f'tension of {" and ".join(levels)} for {OVERLOAD_TIME:g} s'
        return [ConditionKind.OVERLOAD.condition(detail, muscles)]


class HeatLimit:
    """Tension limits from the temperatures of the windings.

    Attributes:
        heat: The thermal model of all muscle modules.
        planned: Highest tension that may be planned for each muscle [N], (M,).
        momentary: Highest tension that each muscle may be commanded to exert [N], (M,).
    """

    def __init__(self, setup: Setup) -> None:
        self._setup, robot = setup, setup.robot
        self.heat = Heat(robot)
        self._is_overheated = False
        self.planned: Array = np.full(robot.muscle_count, robot.tension.max)
        self.momentary = self.planned

    def take(self, sample: MuscleSample, elapsed: float) -> None:
        """Update the thermal model from muscle states, `elapsed` [s] after the previous ones."""
        # The tension sensor of an isolated muscle may be faulty. Assume T_bias instead, because its
        # module is commanded to exert no more, except briefly during a verification.
        robot = self._setup.robot
        bias = robot.description.tension.bias
        tension = np.where(robot.used, sample.newest.tension, bias)
        tension = np.where(np.isnan(tension), sample.motor_tension, tension)
        self.heat.step(tension, sample.temperature, elapsed)

    def lower(self, fall: Array | float) -> None:
        """Lower the tension limits by at most `fall`, or raise them, as the temperatures require.

        Then decide whether the arm is overheated. This begins when a winding is more than 20 °C
        (constant OVERHEATED) above the temperature limit, or when `planned` permits no muscle more
        than T_bias. It ends when no winding is above the limit and `planned` permits at least one
        muscle more than T_bias.

        Args:
            fall: Largest decrease of the tension limits [N], scalar or (M,).
        """
        robot, highest = self._setup.robot, self._setup.settings.temperature_limit
        planned, momentary = self.heat.limits(highest)
        self.planned = np.maximum(planned, self.planned - fall)
        self.momentary = np.maximum(momentary, self.momentary - fall)
        is_hot = self._winding.max() > highest + (0.0 if self._is_overheated else OVERHEATED)
        can_pull = robot.used & (self.planned > robot.tension.bias)
        self._is_overheated = bool(is_hot or (robot.used.any() and not can_pull.any()))

    @property
    def _winding(self) -> Array:
        """Temperature of each winding [°C], (M,); −∞ where it is unknown."""
        return np.fmax(self.heat.core, -np.inf)

    def conditions(self) -> list[Condition]:
        """Return a list with the stop condition of overheating; [] if the arm is not overheated."""
        if not self._is_overheated:
            return []
        robot, highest = self._setup.robot, self._setup.settings.temperature_limit
        winding = self._winding
        m = int(winding.argmax())
        warm, most = distinct(winding[m], highest)
        rest = self.heat.rest_needed(highest, robot.tension.bias)[robot.used & self.heat.is_known]
        detail = (
            f'{robot.muscles[m]} {warm} °C, limit {most} °C; if the arm rests, all motors '
            f'will have cooled {soon(float(rest.max(initial=0.0)))}'
        )
        return [ConditionKind.OVERHEATED.condition(detail, [robot.muscles[m]])]


class Watchdog:
    """Collects the stop causes that are present.

    Attributes:
        steps: The time between steps of control.
        muscle_states: Arrival of the plausible muscle states.
        estimate: Arrival of the new and plausible estimates.
        overload: Detects tensions that are too high.
        heat: Limits tensions by temperature.
        second_publisher: Description of an additional publisher of a topic, or ''.
    """

    def __init__(self, setup: Setup, clock: AwakeClock | None = None) -> None:
        """Start without data; `clock` excludes pauses of the process from the ages of data."""
        self._setup, clock = setup, clock or AwakeClock()
        self.steps = ControlSteps(clock)
        self.muscle_states, self.estimate = Arrival(clock), Arrival(clock)
        self.overload, self.heat = Overload(setup.robot), HeatLimit(setup)
        self.second_publisher = ''

    def take_sample(self, sample: MuscleSample, now: float) -> None:
        """Record that plausible muscle states were received; check them for overload and heat."""
        states = self.muscle_states
        elapsed = states.age(now) if states.was_used else 0.0
        states.use(now)
        self.heat.take(sample, elapsed)
        self.overload.take(sample.motor_tension * sample.usable, now, sample.delay)

    def take_rejected(self, tension: Array, used: Bools, now: float, delay: float) -> None:
        """Check the filtered tensions [N], (M,), of a rejected message for overload.

        Args:
            tension: T; −∞ where it is implausible.
            used: Which muscles are not isolated, (M,).
            now: Time of reception by the steady clock [s].
            delay: How late the message is (`Arrival.delay`) [s].
        """
        self.overload.take(np.where(used, tension, 0.0), now, delay)

    def conditions(self, now: float) -> list[Condition]:
        """Return the stop causes that are present."""
        present = []
        if self.second_publisher:
            present.append(ConditionKind.SECOND_PUBLISHER.condition(self.second_publisher))
        settings = self._setup.settings
        present += self.overload.conditions(now)
        present += self.heat.conditions()
        allowed = self.steps.allowed_age(settings.max_age)
        for kind, arrival in (
            (ConditionKind.STALE_MUSCLE_STATES, self.muscle_states),
            (ConditionKind.STALE_ESTIMATE, self.estimate),
        ):
            if arrival.age(now) > allowed:
                present.append(kind.condition(f'for {allowed:.3g} s'))
        return present
