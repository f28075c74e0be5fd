# SPDX-License-Identifier: Apache-2.0
"""From a target posture to a smooth stream of muscle lengths: targets, methods, exploration.

A target becomes one or two goals (`second` runs `first` before it, as in the paper); a goal is
approached by a straight ramp in muscle length, never faster than the rate limit, and then held. A
new target or a new network starts a new ramp from the command of the moment, so that nothing jumps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tasks import control
from musculoskeletal_ae.tasks.exploration import RAMP_SHARE, Exploration
from musculoskeletal_ae.tasks.length_command import first_command, geometric_command

Array = NDArray[np.float64]

METHODS = ('geometric', 'first', 'second', 'proposed')


@dataclass
class Settings:
    """What a user may choose.

    Attributes:
        method: One of METHODS.
        preset: 'paper' or 'default', for `proposed`.
        first_duration: How long a goal of `first` (and of the other methods) takes [s].
        second_duration: How long one of `second` takes [s].
        rate_limit: Fastest change of a commanded length [m/s].
        constant_tension: T_const of `first` [N]; 0 stands for T_bias.
    """

    method: str = 'proposed'
    preset: str = 'default'
    first_duration: float = 5.0
    second_duration: float = 2.0
    rate_limit: float = 0.1
    constant_tension: float = 0.0


class PostureControl:
    """Commands muscle lengths towards target postures.

    Attributes:
        theta: θ_target [rad], shape (D,), or None before the first target.
        effort: Joint torque beyond holding the arm's weight [N·m], shape (D,).
        missing_torque: What the last goal cannot deliver [N·m], shape (D,).
    """

    def __init__(self, robot: Robot, settings: Settings) -> None:
        """Control `robot`; `settings` may be changed by the owner at any time."""
        self._robot = robot
        self.settings = settings
        self._mae: Mae | None = None
        self.theta: Array | None = None
        self.effort: Array = np.zeros(robot.joint_count)
        self.missing_torque: Array = np.zeros(robot.joint_count)
        self._pending: list[tuple[str, float]] = []
        self._tension: Array = np.full(robot.muscle_count, robot.tension.bias)
        self._exploration: Exploration | None = None
        self._command: Array | None = None
        self._goal: Array | None = None
        self._speed = 0.0
        self._remaining = 0.0
        self._last_method = ''

    def use(self, mae: Mae) -> None:
        """Take a new network; a goal that is being held is computed anew and ramped to."""
        self._mae = mae
        if self.theta is not None and self._exploration is None and not self._pending:
            self._pending = [(self._last_method, self.settings.second_duration)]
            self._remaining = 0.0

    @property
    def exploring(self) -> bool:
        """Whether random targets are being generated."""
        return self._exploration is not None

    def explore(self, seed: int | None) -> None:
        """Start exploring with a stream of random targets, or stop (None) and hold."""
        self._exploration = None if seed is None else Exploration(self._robot, seed)
        self._pending, self._remaining = [], 0.0

    def set_target(self, theta: Array, effort: Array) -> None:
        """Go to a posture [rad] (D,) and exert a torque there [N·m] (D,); ends exploration."""
        self.explore(None)
        self.theta, self.effort = theta, effort
        self._tension = np.full(self._robot.muscle_count, self._constant_tension())
        chosen = self.settings
        if chosen.method == 'second':
            self._pending = [('first', chosen.first_duration), ('second', chosen.second_duration)]
        else:
            self._pending = [(chosen.method, chosen.first_duration)]

    def hold(self) -> None:
        """Stay at the command of the moment, without a target, as after a stop."""
        self.explore(None)
        self.theta = self._goal = None

    def start_from(self, command: Array) -> None:
        """Continue from a command [m] (M,), after a stop or at the start."""
        self._command, self._goal = command.copy(), None
        self._remaining = 0.0

    def step(self, tension: Array, limit: Array, dt: float) -> Array | None:
        """Return the command [m] (M,) of this moment, or None while there is no target.

        Args:
            tension: Measured [N], shape (M,).
            limit: Highest tension planned for each muscle [N], shape (M,).
            dt: Time since the step before [s].
        """
        self._remaining -= dt
        if self._remaining <= 0.0:
            self._next_goal(tension, limit)
        if self._command is None or self._goal is None:
            return None
        left = self._goal - self._command
        fastest = np.abs(left).max()
        if fastest > 0.0:
            # All muscles arrive together; none is faster than the limit.
            self._command = self._command + left * min(1.0, self._speed * dt / fastest)
        return self._command.copy()

    def _constant_tension(self) -> float:
        return self.settings.constant_tension or self._robot.tension.bias

    def _next_goal(self, tension: Array, limit: Array) -> None:
        if self._exploration is not None and not self._pending:
            planned = self._exploration.next_step()
            self.theta, self._tension = planned.theta, planned.tension
            self._pending = [(planned.method, planned.duration)]
        if not self._pending or self._mae is None or self.theta is None:
            return
        method, duration = self._pending.pop(0)
        self._last_method, self._remaining = method, duration
        self._goal = self._solve(method, self.theta, tension, limit)
        assert self._command is not None  # noqa: S101 (start_from came first)
        farthest = float(np.abs(self._goal - self._command).max())
        self._speed = min(self.settings.rate_limit, farthest / (RAMP_SHARE * duration))

    def _solve(self, method: str, theta: Array, tension: Array, limit: Array) -> Array:
        robot, mae = self._robot, self._mae
        assert mae is not None  # noqa: S101 (asked by the caller)
        self.missing_torque = np.zeros(robot.joint_count)
        if method == 'geometric':
            return geometric_command(robot, theta)
        if method == 'first':
            return first_command(robot, mae, theta, self._tension)
        if method == 'second':
            return first_command(robot, mae, theta, tension)
        torque = robot.kinematics.holding_torque(theta) + self.effort
        if self.settings.preset == 'paper':
            solution = control.proposed_paper(robot, mae, theta, torque, tension)
        else:
            solution = control.proposed(robot, mae, theta, torque, tension, limit)
        self.missing_torque = solution.missing_torque
        return solution.length


