# SPDX-License-Identifier: Apache-2.0
"""From a target posture to a smooth stream of muscle lengths.

A target becomes one or two goals (`second` runs `first` before it, as in the paper); a goal is
ramped to and then held. A new target, method or network starts a new ramp from the command of the
moment, so that nothing jumps:

    c(t) = c₀ + (3u² − 2u³)(c₁ − c₀),   u = t / duration

starts and ends at rest, and all muscles arrive together. T_current is read once, when a method
starts: read again and again, `second` would raise the tension without end. While the arm rests
under `proposed`, `RestFeedback` corrects what friction leaves, and sheds needless tension.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control import methods
from musculoskeletal_ae.control.methods import Solution, stiffness_command
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.presets import PRESETS
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension

# Share of a movement in which the command moves; the arm settles and is sampled in the rest.
RAMP_SHARE = 0.6
PEAK = 1.5  # fastest over mean speed of a ramp
REPLAN = 5.0  # [N] change of a tension limit that a plan hangs on, for which it is made anew
CORRECTION = 0.3  # [rad] at most, or times RACK [m]
#: [m] at most: by what lengths can be off, and by what friction keeps of a wire that was wound in
RELIEF = 0.01
#: of estimated error that is left alone [rad], or times RACK [m]: about the estimate's own, after
#: which an arm with friction would creep for ever
DEADBAND = 0.03
BETWEEN = 0.1  # [s] between two programmes of what tension is needless
SETTLING = 0.5  # [s] after a movement until the arm is taken for resting


class Ramp:
    """A smooth way from one command to another, both of shape (M,)."""

    def __init__(self, start: Array, goal: Array, duration: float, rate_limit: float) -> None:
        """Plan to take `duration` [s], or longer so that no entry exceeds its rate limit [1/s]."""
        self._start, self._goal, self._elapsed = start.copy(), goal, 0.0
        farthest = float(np.abs(goal - start).max())
        self.duration = max(duration, PEAK * farthest / rate_limit)

    @property
    def done(self) -> bool:
        """Whether the goal is reached."""
        return self._elapsed >= self.duration

    def step(self, dt: float) -> Array:
        """Return the command dt seconds on."""
        self._elapsed += dt
        u = 1.0 if self.done else self._elapsed / self.duration
        return self._start + (3.0 - 2.0 * u) * u * u * (self._goal - self._start)


def another_plan(tension: Array, before: Array, limit: Array) -> bool:
    """Whether T [N] (M,), planned within one limit (M,), would be another within the other.

    The limit of a warm muscle falls all the time; few pull as much, and what each rest has found
    out would be lost.
    """
    hangs_on_it = tension > np.minimum(before, limit) - REPLAN
    return bool(np.count_nonzero(hangs_on_it & (np.abs(limit - before) > REPLAN)))


class Pull(NamedTuple):
    """How the muscles pull [N], (M,) each."""

    motor: Array  # T, as measured
    end: Array  # T_end, what friction along the wires leaves of it


class RestFeedback:
    """Two slow integrals while the arm rests: of the estimated error, and of needless tension.

        dc/dt = gain (θ_target − θ_estimated),   |c| ≤ CORRECTION
        dr/dt = gain (T − T*)/K_stiff,           |r| ≤ RELIEF        where T > T*
              = gain min(T_end − T*, 0)/K_stiff                      elsewhere
        (T and T_end no further than T_bias to T_limit)
        T*    = argmin ‖T*‖²   subject to   Gᵀ T* = Gᵀ T_end,   T_bias ≤ T* ≤ T_limit
        l_target = ①(θ_target, T_planned) + G c + l_comp(T_planned) + r

    Friction and errors of the body image leave the arm beside its target; the estimate sees most of
    that (arXiv 2405.11808). They also leave muscles that pull against each other: a
    tension commanded as a length is off by K_stiff times what l is off. T* exerts the torque of T
    without friction, so that the relief moves no joint. A wire that was wound in is paid out until
    friction keeps nothing of its tension; one that was paid out stays so, as the arm hangs on it by
    friction already. `correction` is c [rad] (D,), `relief` r [m] (M,).
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._deadband: Array = DEADBAND * robot.kinematics.radian
        self.most: Array = CORRECTION * robot.kinematics.radian  # of the correction [rad], (D,)
        self.reset()
        self.moving()

    def reset(self) -> None:
        """Forget the corrections: a new target."""
        self.correction: Array = np.zeros(self._robot.joint_count)
        self.relief: Array = np.zeros(self._robot.muscle_count)

    def moving(self) -> None:
        """Freeze the corrections until the arm has settled again."""
        self._rested = self._unsolved = 0.0

    def step(
        self, error: Array, jacobian: Array, pull: Pull, limit: Array, gain: float, dt: float
    ) -> bool:
        """Integrate over dt [s] if the arm rests; return whether it does.

        Of θ_target − θ_estimated [rad] (D,), G at the target (M, D), how the muscles pull, and the
        highest tension planned [N] (M,); a gain [1/s] of 0 is no feedback.
        """
        self._rested += dt
        if self._rested <= SETTLING or gain == 0.0:
            return False
        beyond = np.where(np.abs(error) < self._deadband, 0.0, error)
        self.correction = np.clip(self.correction + gain * dt * beyond, -self.most, self.most)
        self._unsolved += dt
        if self._unsolved >= BETWEEN:
            bias, share = self._robot.tension.bias, gain * self._unsolved / self._robot.stiffness
            end, self._unsolved = np.clip(pull.end, bias, limit), 0.0
            least = least_tension(jacobian, -jacobian.T @ end, bias, limit).tension
            motor = np.clip(pull.motor, bias, limit)
            needless = np.where(motor > least, motor - least, np.minimum(end - least, 0.0))
            self.relief = np.clip(self.relief + share * needless, -RELIEF, RELIEF)
        return True

    def shift(self, jacobian: Array) -> Array:
        """Return what the corrections add to the lengths [m] (M,), by G (M, D) at the target."""
        return jacobian @ self.correction + self.relief


class Goal(NamedTuple):
    """A method, how long it may take [s], and its tension [N] (M,); None to read T_current."""

    method: str
    duration: float
    tension: Array | None = None


class Step(NamedTuple):
    """One step of the exploration."""

    method: str  # 'first' or 'second'
    theta: Array  # θ_target [rad], (D,)
    # T_const [N] of `first`, (M,); of `second`, which takes the tension of the moment, what the
    # geometric model expects that to be
    tension: Array
    duration: float  # [s]


class PostureControl:
    """Commands muscle lengths towards target postures."""

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self._robot = robot
        self.settings = settings  # used from the next goal on
        self.theta: Array | None = None  # θ_target [rad], (D,); None before the first target
        self.effort: Array = np.zeros(robot.joint_count)  # torque beyond holding the weight [N·m]
        self.solution: Solution | None = None  # of the last goal
        self.feedback = RestFeedback(robot)
        self._mae: Mae | None = None
        self._exploration: Iterator[Step] | None = None
        self._goals: list[Goal] = []
        self._method, self._remaining = '', 0.0
        self._tension: Array = np.full(robot.muscle_count, robot.tension.bias)
        self._limit: Array = np.full(robot.muscle_count, robot.tension.limit)
        self._command: Array = np.zeros(robot.muscle_count)
        self._ramp: Ramp | None = None
        self._jacobian: Array | None = None  # G at the solution, where it is needed

    @property
    def exploring(self) -> bool:
        """Whether random targets are being generated."""
        return self._exploration is not None

    def use(self, mae: Mae) -> None:
        """Take a new network; a goal that is being held is solved anew and ramped to."""
        self._mae = mae
        self._solve_again()

    def explore(self, exploration: Iterator[Step] | None) -> None:
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
        if self.theta is None or self.exploring:
            return
        chosen, limits = self.settings, self._robot.tension
        constant = np.clip(chosen.constant_tension, limits.bias, limits.limit)
        first = Goal('first', chosen.first_duration, np.full(self._robot.muscle_count, constant))
        self._goals = {
            'first': [first],
            'second': [first, Goal('second', chosen.second_duration)],
        }.get(chosen.method, [Goal(chosen.method, chosen.first_duration)])
        self._remaining = 0.0
        self.feedback.reset()

    def start_from(self, command: Array) -> None:
        """Continue from a command [m] (M,): at the start, after a stop or another method."""
        self._command, self._ramp = command.copy(), None
        self.start()

    def step(self, pull: Pull, theta: Array, limit: Array, dt: float) -> Array | None:
        """Return the command [m] (M,), dt [s] after the last, or None while there is no target.

        θ is estimated, and `limit` the highest tension planned for each muscle [N].
        """
        self._remaining -= dt
        held = self.solution if self._remaining <= 0.0 else None
        if held is not None and another_plan(held.tension, self._limit, limit):
            self._limit = limit
            self._solve_again()
        if self._remaining <= 0.0:
            self._next_goal(pull.motor, limit)
        if self._ramp is None:
            return None
        if not self._ramp.done:
            self._command = self._ramp.step(dt)
        elif self._corrects:
            self._correct(pull, theta, dt)
        return self._command.copy()

    @property
    def _corrects(self) -> bool:
        # A chosen stiffness must not fade under a push, and preset `paper` is as printed.
        return self._method == 'proposed' and PRESETS[self.settings.preset].equilibrium

    def _solve_again(self) -> None:
        if self._ramp is not None and not self._goals and not self.exploring:
            self._goals = [Goal(self._method, self.settings.second_duration, self._tension)]
            if self._ramp.done:
                self._remaining = 0.0

    def _next_goal(self, tension: Array, limit: Array) -> None:
        if self._exploration is not None and not self._goals:
            step = next(self._exploration)
            self.theta = step.theta
            constant = step.tension if step.method == 'first' else None
            self._goals = [Goal(step.method, step.duration, constant)]
        if not self._goals or self._mae is None or self.theta is None:
            return
        self._method, duration, constant = self._goals.pop(0)
        self._tension = tension if constant is None else constant
        self._limit = limit
        self.solution = None
        self.solution = self._solve(self._mae, self.theta)
        goal = self.solution.length
        if self._corrects:
            self._jacobian = self._mae.muscle_jacobian(self.theta, self.solution.tension)
            goal = goal + self.feedback.shift(self._jacobian)
        goal = np.where(self._robot.used, goal, self._command)
        self._ramp = Ramp(self._command, goal, RAMP_SHARE * duration, self.settings.rate_limit)
        self._remaining = max(duration, self._ramp.duration)
        self.feedback.moving()

    def _solve(self, mae: Mae, theta: Array) -> Solution:
        robot, tension, nothing = self._robot, self._tension, np.zeros(self._robot.joint_count)
        if self._method == 'geometric':
            bias = np.full(robot.muscle_count, robot.tension.bias)
            return Solution(methods.geometric_command(robot, theta), bias, nothing)
        if self._method in ('first', 'second'):
            tension = np.minimum(tension, self._limit)
            return Solution(methods.first_command(robot, mae, theta, tension), tension, nothing)
        torque = robot.kinematics.holding_torque(theta) + self.effort
        if self._method == 'stiffness':
            desired = np.array(self.settings.desired_stiffness(robot.kinematics.radian))
            return stiffness_command(robot, mae, theta, torque, desired, self._limit)
        if PRESETS[self.settings.preset].equilibrium:
            return methods.proposed(robot, mae, theta, torque, tension, self._limit)
        return methods.proposed_paper(robot, mae, theta, torque, tension)

    def _correct(self, pull: Pull, theta: Array, dt: float) -> None:
        """Shift the commanded lengths: the estimate nearer to the target, T nearer to the least."""
        target, solution, jacobian = self.theta, self.solution, self._jacobian
        # They gave the goal that is held.
        assert target is not None and solution is not None and jacobian is not None
        error, gain = target - theta, self.settings.feedback_gain
        if self.feedback.step(error, jacobian, pull, self._limit, gain, dt):
            self._command = solution.length + self.feedback.shift(jacobian)
