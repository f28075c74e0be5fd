# SPDX-License-Identifier: Apache-2.0
"""Ramps of muscle lengths, by which exploration and some control methods reach a posture.

These methods have one length command for each posture; the preset lists them
(`Preset.length_methods`). A target becomes one goal. With the method `second`, it becomes two goals
at the same posture: the first one is reached by the method `first`. Each goal is approached by a
ramp and then held. A ramp starts from the present command, so that the command does not jump:

    c(t) = c₀ + (3u² − 2u³)(c₁ − c₀),   u = t / duration

A ramp starts and ends at rest, and all muscles arrive together. The present tension T_current, on
which the command of `second` depends, is measured only at the start of the goal: with repeated
measurements, `second` would raise the tension without bound.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Setup
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.activities import LENGTH, ActivityControl, Command, Inputs
from musculoskeletal_ae.motion.feedback import depends_on_limit
from musculoskeletal_ae.motion.methods import FIRST, SECOND, Goal, Solution

# Ramp the command during this fraction of a movement's duration. In the remaining time, the arm
# comes to rest and provides a rest sample.
RAMP_SHARE = 0.6
PEAK = 1.5  # peak speed of a ramp, as a multiple of its mean speed


class Ramp:
    """A smooth transition from one command to another, both of shape (M,)."""

    def __init__(self, start: Array, goal: Array, duration: float, rate_limit: float) -> None:
        """Plan a ramp of `duration` [s], or longer if the rate limit requires it.

        The unit of `rate_limit` is the unit of the commands per second.
        """
        self._start, self._goal, self._elapsed = start.copy(), goal, 0.0
        farthest = float(np.abs(goal - start).max())
        self.duration = max(duration, PEAK * farthest / rate_limit)

    @property
    def done(self) -> bool:
        """Whether the ramp has ended."""
        return self._elapsed >= self.duration

    def step(self, dt: float) -> Array:
        """Advance by dt [s] and return the command."""
        self._elapsed += dt
        u = 1.0 if self.done else self._elapsed / self.duration
        return self._start + (3.0 - 2.0 * u) * u * u * (self._goal - self._start)


class LengthRamps:
    """Moves the arm by ramps to one goal after the other, and holds the last goal.

    Attributes:
        solution: Solution of the present goal, or None.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup, robot = setup, setup.robot
        self._goals: list[Goal] = []
        #: present goal, which is approached or held, with the tension that it uses
        self._goal: Goal | None = None
        self._remaining = 0.0  # time until the next goal begins [s]
        self._ramp: Ramp | None = None
        self._command: Array = np.zeros(robot.muscle_count)
        self._limit: Array = robot.tension.limit  # tension limit of the present plan [N], (M,)
        self.solution: Solution | None = None

    @property
    def missing_torque(self) -> Array | None:
        """Torque [N·m], (D,), that the muscles cannot exert at the present goal."""
        return None if self.solution is None else self.solution.missing_torque

    def is_over_after(self, dt: float) -> bool:
        """Return whether the time for approaching the last goal will have passed in dt [s]."""
        return self._remaining - dt <= 0.0 and not self._goals

    @property
    def is_over(self) -> bool:
        """Whether the last goal has been approached for its whole duration, and is now held."""
        return self._goal is not None and self.is_over_after(0.0)

    def start_from(self, command: Array) -> None:
        """Continue from a command [m], (M,), and discard all goals."""
        self._command, self._ramp, self._goal = command.copy(), None, None
        self._goals, self._remaining = [], 0.0
        self.solution = None

    def pursue(self, goals: list[Goal]) -> None:
        """Replace the pending goals; the first new one begins in the next step."""
        self._goals, self._remaining = list(goals), 0.0

    def solve_again(self) -> None:
        """Solve the present goal again, for example with another network, and ramp to it."""
        if self._goal is None or self._ramp is None or self._goals:
            return
        duration = self._setup.settings.second_duration
        self._goals = [self._goal._replace(duration=duration)]
        if self._ramp.done:
            self._remaining = 0.0

    def step(self, inputs: Inputs) -> Command | None:
        """Return the next command, or None while there is no goal."""
        self._remaining -= inputs.dt
        if (
            self.solution is not None
            and self._remaining <= 0.0
            and depends_on_limit(self.solution.tension, self._limit, inputs.limit)
        ):
            self._limit = inputs.limit
            self.solve_again()
        if self._remaining <= 0.0 and self._goals:
            self._begin(self._goals.pop(0), inputs)
        if self._ramp is None:
            return None
        if not self._ramp.done:
            self._command = self._ramp.step(inputs.dt)
        return Command(LENGTH, self._command.copy())

    def _begin(self, goal: Goal, inputs: Inputs) -> None:
        if goal.tension is None:
            goal = goal._replace(tension=inputs.motor_tension)
        if goal.method == SECOND and not self._setup.robot.tension_source.is_known:
            goal = goal._replace(method=FIRST)
        self._goal, self._limit = goal, inputs.limit
        self.solution = None  # there is no solution if the next line raises an exception
        self.solution = self._solve(goal, inputs.mae)
        length = np.where(self._setup.robot.used, self.solution.length, self._command)
        rate_limit = float(
            self._setup.robot.actuation.fastest(self._setup.settings.rate_limit).min()
        )
        self._ramp = Ramp(self._command, length, RAMP_SHARE * goal.duration, rate_limit)
        self._remaining = max(goal.duration, self._ramp.duration)

    def _solve(self, goal: Goal, mae: Mae) -> Solution:
        robot, method = self._setup.robot, self._setup.settings.length_methods[goal.method]
        tension = goal.tension
        assert tension is not None
        if method.takes_tension:
            tension = np.minimum(tension, self._limit)
        torque = robot.kinematics.holding_torque(goal.theta) + goal.effort
        return method.command(robot, mae, goal.theta, torque, tension)


class RampedTarget(ActivityControl):
    """The activity of moving to a target and holding it by a length method."""

    def __init__(self, ramps: LengthRamps, setup: Setup) -> None:
        self.ramps, self._setup = ramps, setup

    def enter(self, inputs: Inputs) -> None:
        """Enter the activity, starting from the present tensions."""
        self.ramps.start_from(inputs.length)
        self.ramps.pursue(self._goals(inputs))

    def step(self, inputs: Inputs) -> Command | None:
        """Advance by one control step and return the next length command."""
        return self.ramps.step(inputs)

    def leave(self) -> None:
        """Leave the activity."""

    @property
    def has_arrived(self) -> bool:
        """Whether the movement to the target has ended."""
        return self.ramps.is_over

    @property
    def missing_torque(self) -> Array | None:
        """Torque [N·m], (D,), that the muscles cannot exert at the present goal."""
        return self.ramps.missing_torque

    def _goals(self, inputs: Inputs) -> list[Goal]:
        chosen, theta, effort = self._setup.settings, inputs.target, inputs.effort
        method = chosen.length_methods.get(chosen.method)
        if theta is None or method is None:
            return []
        # T_const of method `first` is T_bias.
        bias = self._setup.robot.tension.bias
        first = Goal(FIRST, theta, effort, chosen.first_duration, bias)
        if chosen.method == FIRST:
            return [first]
        if method.follows_first:
            return [first, Goal(chosen.method, theta, effort, chosen.second_duration)]
        return [Goal(chosen.method, theta, effort, chosen.first_duration)]
