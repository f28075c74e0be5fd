# SPDX-License-Identifier: Apache-2.0
"""The one follower: muscle lengths along a trajectory, and on where the last one has ended.

At each message, for the θ, θ̇, θ̈ that are desired then (`trajectory`),

    τ = M(θ) θ̈ + h(θ, θ̇)                                       rigid bodies (pinocchio's RNEA)
    T = argmin ‖T‖²   subject to  −Gᵀ T = τ,  T_low ≤ T ≤ T_limit,         T at the bones
    l = ①(θ + k_p e + c, T),   e = θ − θ_estimated,   dc/dt = k_i e,   |c|, |k_p e + c| ≤ CORRECTION
    l_target = l + l_comp(T e^{μ s}) + λ dl/dt

Tendon friction: the tension at the motor is T e^{μ s}, with s the direction in which the tendon
slides, and μ as the learner found it (`mae.touch`), else FRICTION. Winches: the motor of a module
that follows muscle stiffness control (MSC) turns at dl/dt = (T − T_MSC)/(K_stiff λ). So its command
has to lead by λ dl/dt, and a tendon that is pulled out at dl/dt resists with T_bias + K_stiff
λ dl/dt even if MSC demands no more than T_bias; that is T_low. λ is measured while the arm moves
(`winches`).

A trajectory that the winches cannot follow is slowed as a whole before it starts (`slowness`).
After its end G and T stay as they are, and the feedback at rest (`feedback.RestFeedback`) goes on
from c: holding a posture is following a trajectory that has ended.

Method `stiffness`: argmin ‖T − T_K‖² instead, with T_K of `methods.stiffness_command` for the θ and
τ of a moment later, and no feedback, under which a chosen stiffness would not last.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.activities import Inputs
from musculoskeletal_ae.control.command import LENGTH, Command, msc_compensation
from musculoskeletal_ae.control.feedback import RestFeedback, depends_on_limit
from musculoskeletal_ae.control.methods import Solution, stiffness_command
from musculoskeletal_ae.control.ramps import Ramp
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.control.trajectory import Setpoint, Trajectory
from musculoskeletal_ae.control.winches import Winches
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension
from musculoskeletal_ae.signals.friction import slid

PROPORTIONAL, INTEGRAL = 0.7, 4.0  # k_p; k_i [1/s]
FRICTION = 0.05  # μ where none was learned: the mean of what hands build
SHARE = 0.7  # of the winches' speed that lengths may use; the rest is for tensions and feedback
MOST_MOMENTS = 12_500  # that a network is asked about; every piece of 10 000 has one still
BLENDING = 0.3  # [s] in which what the command was before fades into the plan's
FALLEN, FALLING = 0.2, 2.0  # [rad] off, or times RACK, so long [s] after the end
SETTLING = 0.8  # [s] after the end, in which the feedback of the motion goes on
TURNING = 0.005  # [m/s] of a tendon beyond which its direction is sure
AHEAD = 0.2  # [s] to the moment of T_K, and between two of them


class Stiffening:
    """The tensions T_K near which method `stiffness` plans, a moment ahead."""

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self.use(robot, settings)
        self.reset()

    def use(self, robot: Robot, settings: Settings) -> None:
        """Plan with this robot and these settings."""
        self._robot, self._settings = robot, settings

    def reset(self) -> None:
        """Begin anew."""
        self.solution: Solution | None = None  # the last that T_K goes to
        self._near: Array = self._robot.tension.bias  # T_K [N], (M,)
        self._solved = 0.0  # how long ago [s]

    def step(
        self, mae: Mae, trajectory: Trajectory, time: float, effort: Array, limit: Array, dt: float
    ) -> Array:
        """Return T_K [N] (M,), as fast as it may change by what the plan leaves of the winches."""
        robot, settings, solution = self._robot, self._settings, self.solution
        self._solved += dt
        if solution is None or self._solved >= AHEAD:
            at, self._solved = trajectory.sample(time + AHEAD), 0.0
            torque = robot.kinematics.inverse_dynamics(*at) + effort
            desired = np.array(settings.desired_stiffness(robot.kinematics.radian))
            near = None if solution is None else self._near
            solution = stiffness_command(robot, mae, at.theta, torque, desired, limit, near)
            self._near = solution.tension if near is None else near
            self.solution = solution
        # Half, since the series elastic elements stretch as well.
        largest = 0.5 * (1.0 - SHARE) * settings.rate_limit * robot.stiffness * dt
        self._near = self._near + np.clip(solution.tension - self._near, -largest, largest)
        return self._near


class Follower:
    """Follows trajectories, and holds where the last one ended.

    Attributes:
        trajectory: What is followed, or was last; None before the first, and after a stop.
        next: A trajectory that replaces it later, and in how many seconds.
        effort: Torque beyond weight and motion [N·m], (D,).
        time: Since the trajectory began, whatever was planned anew meanwhile [s].
        over: Since it ended [s].
        desired: What is desired now.
        error: Desired − estimated θ [rad], (D,).
        missing_torque: What no tension within the limits gives [N·m], (D,).
        tension: Planned T at the bones [N], (M,).
    """

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self._robot, self._settings = robot, settings
        self.trajectory: Trajectory | None = None
        self.next: tuple[Trajectory, float] | None = None
        self.effort: Array = np.zeros(robot.joint_count)
        self.time = self.over = 0.0
        self.desired = Setpoint.resting(np.zeros(robot.joint_count))
        self.error: Array = np.zeros(robot.joint_count)
        self.missing_torque: Array = np.zeros(robot.joint_count)
        self.winches, self.feedback = Winches(robot), RestFeedback(robot)
        self.stiffening = Stiffening(robot, settings)
        self._friction: Array = np.full(robot.muscle_count, FRICTION)
        self._limit: Array = robot.tension.limit  # that was planned with [N], (M,)
        self._shift: Array = np.zeros(robot.joint_count)  # of θ by the feedback [rad]
        self._resting: tuple[Array, Array] | None = None  # l_target and G where it is held
        self._blend: Ramp | None = None
        # T at the bones and at the motors [N], and s of each tendon, (M,)
        self.tension: Array = robot.tension.bias.copy()
        self._motor: Array = self.tension
        self._sliding: Array = np.zeros(robot.muscle_count)

    def use(self, robot: Robot, settings: Settings) -> None:
        """Plan with this robot, whose isolated muscles pull nothing, and these settings."""
        self._robot, self._settings = robot, settings
        self.winches.use(robot)
        self.feedback.use(robot)
        self.stiffening.use(robot, settings)

    def use_network(self, mae: Mae) -> None:
        """Take a new network; the command goes over to it without a jump."""
        touch = getattr(mae, 'touch', None)
        known = np.full(self._robot.muscle_count, FRICTION) if touch is None else touch.friction
        self._friction = known
        self.plan_anew()

    # -- what is asked --------------------------------------------------------------------------

    def follow(self, trajectory: Trajectory, delay: float = 0.0) -> None:
        """Follow a trajectory from `delay` [s] on, in the place of all that was to come after."""
        if delay > 0.0:
            self.next = trajectory, delay
        else:
            self._begin(trajectory, 0.0)

    def exert(self, effort: Array) -> None:
        """Exert a torque [N·m] (D,) beyond weight and motion, by the trajectory and after it."""
        if (effort != self.effort).any():
            self.effort = effort
            self.plan_anew()

    def plan_anew(self) -> None:
        """Go over from the last command to another without a jump; at rest, settle again."""
        if self._resting is not None and self.trajectory is not None:
            self.time = min(self.time, self.trajectory.duration)
            self.feedback.relief = np.zeros(self._robot.muscle_count)
        self._resting = self._blend = None

    @property
    def is_moving(self) -> bool:
        """Whether a trajectory goes on or is to come."""
        going = self.trajectory is not None and self.time < self.trajectory.duration
        return going or self.next is not None

    @property
    def has_fallen(self) -> bool:
        """Whether the arm lacks a muscle and rests elsewhere than where a trajectory has led."""
        rested = self.trajectory is not None and self.over > FALLING
        rested = rested and self.next is None and not self._robot.used.all()
        return bool(rested and np.abs(self.error / self._robot.kinematics.radian).max() > FALLEN)

    @property
    def latest(self) -> Trajectory | None:
        """What was to be followed last, whether it has begun or is to come."""
        return self.next[0] if self.next is not None else self.trajectory

    @property
    def solution(self) -> Solution | None:
        """The last solution of method `stiffness`."""
        return self.stiffening.solution

    def ahead(self, delay: float) -> Setpoint:
        """Return what will be desired in `delay` [s], as far as is known now."""
        assert self.trajectory is not None
        return self.trajectory.sample(self.time + delay)

    # -- the activity ---------------------------------------------------------------------------

    def enter(self, _: Inputs) -> None:
        """Begin, or go on after a pause, from how the muscles pull now."""
        self._start()

    def leave(self) -> None:
        """Forget what was followed."""
        self.trajectory = self.next = None

    def step(self, inputs: Inputs) -> Command | None:
        """Return the command, or None without a trajectory."""
        trajectory, sent, dt = self.trajectory, inputs.length, inputs.dt
        if trajectory is None:
            return None
        if self.is_moving:
            self.winches.step(inputs.sample.length, inputs.pull.motor, sent, dt)
        else:  # noise alone says nothing of λ
            self.winches.forget()
        self.time += dt
        self.over += dt if self.time >= trajectory.duration else 0.0
        if self.next is not None:
            self.next = self.next[0], self.next[1] - dt
            if self.next[1] <= 0.0:
                trajectory = self.next[0]
                self._begin(trajectory, -self.next[1])
        if depends_on_limit(self._motor, self._limit, inputs.limit):
            self._limit = inputs.limit
            self.plan_anew()
        if self._resting is None:
            self.desired = trajectory.sample(self.time)
        self.error = self.desired.theta - inputs.theta
        if self.time < trajectory.duration + SETTLING:
            length = self._moving(trajectory, inputs)
        else:
            length = self._held(inputs)
        length = np.where(self._robot.used, length, sent)
        if self._blend is None:
            rate_limit = self._settings.rate_limit
            self._blend = Ramp(sent - length, np.zeros_like(length), BLENDING, rate_limit)
        return Command(LENGTH, length + self._blend.step(dt))

    def _start(self) -> None:
        self._resting = self._blend = None
        if self.trajectory is not None:  # held, or held anew: its tensions are planned again
            self.time = min(self.time, self.trajectory.duration)
        self.tension = self._robot.tension.bias.copy()
        self._motor = self.tension
        self._sliding = np.zeros(self._robot.muscle_count)
        self.stiffening.reset()
        self.feedback.reset()
        self.winches.forget()

    def _begin(self, trajectory: Trajectory, time: float) -> None:
        self.trajectory, self.time, self.next = trajectory, time, None
        self.over = 0.0
        if self._resting is not None:  # on the way, one goes over to the next by itself
            self.plan_anew()

    @property
    def _is_stiff(self) -> bool:
        return self._settings.method == 'stiffness'

    def _moving(self, trajectory: Trajectory, inputs: Inputs) -> Array:
        """Return l_target [m] (M,) on the way and while the arm settles."""
        feedback, largest = self.feedback, self.feedback.largest
        error = np.zeros_like(self.error) if self._is_stiff else self.error
        correction = feedback.correction + INTEGRAL * inputs.dt * error
        feedback.correction = np.clip(correction, -largest, largest)
        feedback.moving()
        # Bounded too: an estimate that is wrong at once must not take the arm along.
        shift = feedback.correction + PROPORTIONAL * error
        self._shift = np.clip(shift, -largest, largest)
        at = trajectory.sample(self.time + 0.5 * inputs.dt)
        return self._planned(trajectory, at, inputs)

    def _planned(self, trajectory: Trajectory, at: Setpoint, inputs: Inputs) -> Array:
        """Return l_target [m] (M,) for a moment."""
        robot, lag, mae, dt = self._robot, self.winches.lag, inputs.mae, inputs.dt
        jacobian = mae.muscle_jacobian(at.theta, self.tension)
        speed = jacobian @ at.velocity
        self._sliding = slid(self._sliding, -np.tanh(speed / TURNING), speed * dt)
        torque = robot.kinematics.inverse_dynamics(*at) + self.effort
        low = robot.tension.bias + robot.stiffness * lag * np.maximum(speed, 0.0)
        loss = np.exp(self._friction * self._sliding)
        near: Array | float = 0.0
        if self._is_stiff:
            near = self.stiffening.step(mae, trajectory, self.time, self.effort, inputs.limit, dt)
        self.tension, self.missing_torque = least_tension(
            jacobian, torque, np.minimum(low, inputs.limit) / loss, inputs.limit / loss, near
        )
        self._motor = self.tension * loss
        length = mae.lengths(at.theta + self._shift, self.tension)
        return length + msc_compensation(robot, self._motor) + lag * speed

    def _held(self, inputs: Inputs) -> Array:
        """Return l_target [m] (M,) at rest, for which nothing is solved that does not change."""
        feedback, mae = self.feedback, inputs.mae
        if self._resting is None:
            feedback.correction = self._shift
            theta = self.desired.theta
            length = mae.lengths(theta, self.tension) + msc_compensation(self._robot, self._motor)
            self._resting = length, mae.muscle_jacobian(theta, self.tension)
        length, jacobian = self._resting
        gain = 0.0 if self._is_stiff else self._settings.feedback_gain
        feedback.step(self.error, jacobian, inputs.pull, inputs.limit, gain, inputs.dt)
        self._shift = feedback.correction
        return length + feedback.shift(jacobian)


def slowness(robot: Robot, mae: Mae, trajectory: Trajectory, settings: Settings) -> float:
    """Return how many times longer a trajectory has to take, so that the winches can follow.

    One that starts in motion keeps that speed, and so needs more than that now and then. Looked at
    are lengths at T_bias. Tensions slow nothing: near postures that are hard to hold they change
    suddenly, however slowly the arm moves, and for them `SHARE` leaves winches time.
    """
    # Of very many points fewer moments between: no command may wait for a tenth of a second.
    time, theta = (part[:: 1 + len(part) // MOST_MOMENTS] for part in trajectory.path)
    length = mae.lengths(theta, np.tile(robot.tension.bias, (len(theta), 1)))
    speed = np.diff(length, axis=0) * robot.used / np.diff(time)[:, None]
    return float(max(1.0, np.abs(speed).max() / (SHARE * settings.rate_limit)))
