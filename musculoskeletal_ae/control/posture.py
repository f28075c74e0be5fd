# SPDX-License-Identifier: Apache-2.0
"""From a target posture to a smooth stream of muscle lengths.

A target becomes one or two goals (`second` runs `first` before it, as in the paper); a goal is
ramped to and then held. A new target, method or network starts a new ramp from the command of the
moment, so that nothing jumps. T_current is read once, when a method starts: read again and again,
`second` would raise the tension without end.

While the arm rests under `proposed`, `feedback` corrects what friction leaves, and sheds tension
that is not needed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control import proposed as control
from musculoskeletal_ae.control.exploration import RAMP_SHARE, Exploration
from musculoskeletal_ae.control.feedback import RestFeedback
from musculoskeletal_ae.control.length import first_command, geometric_command
from musculoskeletal_ae.control.proposed import Solution
from musculoskeletal_ae.control.ramp import Ramp
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.control.stiffness import StiffnessSolution, stiffness_command
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.presets import PRESETS
from musculoskeletal_ae.robot.robot import Robot

REPLAN = 5.0  # [N] change of a tension limit that makes a held goal worth solving anew


class Goal(NamedTuple):
    """A method, how long it may take [s], and whether it reads T_current anew."""

    method: str
    duration: float
    reads: bool = True


class PostureControl:
    """Commands muscle lengths towards target postures.

    Attributes:
        theta: θ_target [rad], shape (D,), or None before the first target.
        effort: Joint torque beyond holding the arm's weight [N·m], shape (D,).
        missing_torque: What the last goal cannot deliver [N·m], shape (D,).
        solution: Lengths and tensions of the last goal of `proposed` or `stiffness`, or None.
        stiffness: What the last goal of `stiffness` expects, or None.
        feedback: Corrections at rest.
    """

    def __init__(self, robot: Robot, settings: Settings) -> None:
        """Control `robot`; the owner may change `settings` at any time."""
        self._robot, self._settings = robot, settings
        self._mae: Mae | None = None
        self.theta: Array | None = None
        self.effort: Array = np.zeros(robot.joint_count)
        self.missing_torque: Array = np.zeros(robot.joint_count)
        self.stiffness: StiffnessSolution | None = None
        self._exploration: Exploration | None = None
        self._goals: list[Goal] = []
        self._method = ''
        self._remaining = 0.0
        self._constant: Array = np.full(robot.muscle_count, robot.tension.bias)
        self._current: Array = self._constant
        self._limit: Array = np.full(robot.muscle_count, robot.tension.limit)
        self._command: Array = np.zeros(robot.muscle_count)
        self._ramp: Ramp | None = None
        self.solution: Solution | None = None
        self.feedback = RestFeedback(robot)
        self._jacobian: Array | None = None

    @property
    def exploring(self) -> bool:
        """Whether random targets are being generated."""
        return self._exploration is not None

    def use(self, mae: Mae) -> None:
        """Take a new network; a goal that is being held is solved anew and ramped to."""
        self._mae = mae
        self._solve_again()

    def explore(self, exploration: Exploration | None) -> None:
        """Follow a stream of random targets, or end that (None) and hold."""
        self._exploration = exploration
        self._goals, self._remaining = [], 0.0

    def set_target(self, theta: Array, effort: Array) -> None:
        """Go to a posture [rad] (D,) and exert a torque there [N·m] (D,); ends exploration."""
        self.explore(None)
        self.theta, self.effort = theta, effort
        self.start()

    def start(self) -> None:
        """Go to the target by the method that is set now, from the command of the moment."""
        if self.theta is None or self._exploration is not None:
            return
        chosen = self._settings
        tension = self._robot.tension
        constant = np.clip(chosen.constant_tension, tension.bias, tension.limit)
        self._constant = np.full(self._robot.muscle_count, constant)
        self._remaining = 0.0
        self.feedback.reset()
        self._goals = [Goal(chosen.method, chosen.first_duration)]
        if chosen.method == 'second':
            self._goals = [
                Goal('first', chosen.first_duration),
                Goal('second', chosen.second_duration),
            ]

    def start_from(self, command: Array) -> None:
        """Continue from a command [m] (M,): at the start, after a stop or another method."""
        self._command, self._ramp = command.copy(), None
        self.start()

    def step(self, tension: Array, theta: Array, limit: Array, dt: float) -> Array | None:
        """Return the command [m] (M,) of this moment, or None while there is no target.

        Args:
            tension: Measured [N], shape (M,).
            theta: Estimated [rad], shape (D,).
            limit: Highest tension planned for each muscle [N], shape (M,).
            dt: Time since the step before [s].
        """
        self._remaining -= dt
        if np.abs(limit - self._limit).max() > REPLAN and self._remaining <= 0.0:
            self._limit = limit
            self._solve_again()
        if self._remaining <= 0.0:
            self._next_goal(tension, limit)
        if self._ramp is None:
            return None
        if not self._ramp.done:
            self._command = self._ramp.step(dt)
        else:
            self._correct(tension, theta, dt)
        return self._command.copy()

    def _solve_again(self) -> None:
        if self._ramp is not None and not self._goals and self._exploration is None:
            self._goals = [Goal(self._method, self._settings.second_duration, reads=False)]
            if self._ramp.done:
                self._remaining = 0.0

    def _next_goal(self, tension: Array, limit: Array) -> None:
        if self._exploration is not None and not self._goals:
            planned = self._exploration.next_step()
            self.theta, self._constant = planned.theta, planned.tension
            self._goals = [Goal(planned.method, planned.duration)]
        if not self._goals or self._mae is None or self.theta is None:
            return
        self._method, duration, reads = self._goals.pop(0)
        if reads:
            self._current = tension
        self._limit = limit
        goal = self._solve(self._mae, self.theta, self._current, limit)
        if self.solution is not None:
            goal = goal + self.feedback.shift(self._mae, self.theta, self.solution.tension)
        self._ramp = Ramp(self._command, goal, RAMP_SHARE * duration, self._settings.rate_limit)
        self._remaining = max(duration, self._ramp.duration)
        self.feedback.moving()

    def _solve(self, mae: Mae, theta: Array, current: Array, limit: Array) -> Array:
        robot, method = self._robot, self._method
        self.missing_torque = np.zeros(robot.joint_count)
        self.solution = self.stiffness = self._jacobian = None
        if method == 'geometric':
            return geometric_command(robot, theta)
        if method in ('first', 'second'):
            return first_command(
                robot, mae, theta, self._constant if method == 'first' else current
            )
        torque = robot.kinematics.holding_torque(theta) + self.effort
        if method == 'stiffness':
            wish = np.zeros(robot.joint_count)
            wish[: len(self._settings.joint_stiffness)] = self._settings.joint_stiffness
            self.stiffness = stiffness_command(robot, mae, theta, torque, wish, limit)
            self.solution = self.stiffness.command
        elif PRESETS[self._settings.preset].equilibrium:
            self.solution = control.proposed(robot, mae, theta, torque, current, limit)
        else:
            self.solution = control.proposed_paper(robot, mae, theta, torque, current)
        self.missing_torque = self.solution.missing_torque
        return self.solution.length

    def _correct(self, tension: Array, theta: Array, dt: float) -> None:
        """Shift the commanded lengths: the estimate nearer to the target, T nearer to the least."""
        chosen, solution = self._settings, self.solution
        # A chosen stiffness must not fade under a push, and preset `paper` is as printed.
        by_balance = self._method == 'proposed' and PRESETS[chosen.preset].equilibrium
        if not by_balance or solution is None:
            return
        assert self._mae is not None and self.theta is not None  # they gave the solution
        if self._jacobian is None:
            self._jacobian = self._mae.muscle_jacobian(self.theta, solution.tension)
        error, gain = self.theta - theta, chosen.feedback_gain
        if self.feedback.step(error, self._jacobian, tension, self._limit, gain, dt):
            shift = self.feedback.shift(self._mae, self.theta, solution.tension)
            self._command = solution.length + shift
