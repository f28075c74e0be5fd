# SPDX-License-Identifier: Apache-2.0
"""The follower: computes muscle lengths along a trajectory, and holds its end.

At each message, for the desired θ, θ̇, θ̈ (`trajectory`),

    τ = M(θ) θ̈ + h(θ, θ̇)                                       rigid bodies (pinocchio's RNEA)
    T = argmin ‖T‖²   subject to  −Gᵀ T = τ,  T_low ≤ T ≤ T_limit,         bone-side tension
    l = ①(θ + k_p e + c, T),   e = θ − θ_estimated,   dc/dt = k_i e,   |c|, |k_p e + c| ≤ CORRECTION
    l_target = l + l_comp(T e^{μ s}) + λ dl/dt

Tendon friction: the motor-side tension is T e^{μ s}. Here s is the direction in which the tendon
slides, and μ is learned or a typical value (`control/friction.py`).

Lag of the muscle modules: a motor under muscle stiffness control (MSC) turns at
dl/dt = (T − T_MSC)/(K_stiff λ). Therefore the command has to lead by λ dl/dt. A tendon that is
drawn out at dl/dt resists with T_bias + K_stiff λ dl/dt, even if MSC demands only T_bias. This is
T_low. λ is measured while the arm moves (`winches`).

Position-controlled modules resist no motion beyond their lag λ; l_comp and K_stiff λ dl/dt are 0.

A trajectory that is too fast for the muscle modules is slowed as a whole before it starts
(`slowness`). The follower also holds the end of the trajectory. G and T then stay constant, and the
rest feedback (`feedback.RestFeedback`) continues from c.

Where no tension is known, T is `Actuation.assumed_tension` in every posture, as in the samples from
which the network was learned (doc/explanation/method.md).

Method `stiffness` minimises ‖T − T_K‖² instead, where `methods.stiffness_command` computes T_K for
a setpoint that is AHEAD seconds ahead. It uses no feedback, which would change the chosen
stiffness.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.activities import ActivityControl, Inputs
from musculoskeletal_ae.control.command import LENGTH, Command, msc_compensation
from musculoskeletal_ae.control.feedback import RestFeedback, depends_on_limit
from musculoskeletal_ae.control.friction import FRICTION, tendon_friction
from musculoskeletal_ae.control.methods import Solution, stiffness_command
from musculoskeletal_ae.control.ramps import Ramp
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.control.trajectory import Setpoint, Trajectory
from musculoskeletal_ae.control.winches import Winches
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension
from musculoskeletal_ae.signals.friction import slid

PROPORTIONAL = 0.7  # proportional gain k_p of the posture error
INTEGRAL = 4.0  # integral gain k_i of the posture error [1/s]
#: fraction of the rate limit for a trajectory's lengths; the rest is for tensions and feedback
SHARE = 0.7
#: largest number of moments of a trajectory at which the network is evaluated; even with 10 000
#: points, each piece of the trajectory has at least one
MOST_MOMENTS = 12_500
BLENDING = 0.3  # time in which the previous command is blended into the new plan [s]
#: error above which an arm with isolated muscles has fallen [rad]; for prismatic joints, the error
#: divided by RACK counts
FALLEN = 0.2
FALLING = 2.0  # time after the end of a trajectory from which on the arm can count as fallen [s]
#: error on the way above which, for the time FALLING, an arm with isolated muscles no longer
#: follows its trajectory [rad]; for prismatic joints, the error divided by RACK counts
LOST = 0.4
SETTLING = 0.8  # time after the end for which the feedback of the motion continues [s]
TURNING = 0.005  # speed of a tendon above which its sliding direction is certain [m/s]
AHEAD = 0.2  # T_K is computed for this time ahead, and at this interval [s]


class Stiffening:
    """Computes the tensions T_K that method `stiffness` approaches, AHEAD seconds in advance."""

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self.use(robot, settings)
        self.reset()

    def use(self, robot: Robot, settings: Settings) -> None:
        """Use another robot description and other settings."""
        self._robot, self._settings = robot, settings

    def reset(self) -> None:
        """Discard the present solution."""
        self.solution: Solution | None = None  # the solution that T_K approaches
        self._near: Array = self._robot.tension.bias  # T_K [N], (M,)
        self._solved = 0.0  # age of the solution [s]

    def step(
        self, mae: Mae, trajectory: Trajectory, time: float, effort: Array, limit: Array, dt: float
    ) -> Array:
        """Return T_K [N], (M,).

        Its change per step is limited: the lengths of trajectories may use the fraction SHARE of
        the rate limit, so only the rest is left for T_K.
        """
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
        # Use half of that rest, because the series elastic elements stretch as well.
        actuation = robot.actuation
        rates = actuation.fastest(settings.rate_limit) * actuation.tension_per_length(self._near)
        largest = 0.5 * (1.0 - SHARE) * rates * dt
        self._near = self._near + np.clip(solution.tension - self._near, -largest, largest)
        return self._near


class Follower(ActivityControl):
    """Follows trajectories, and holds where the last one ended.

    Attributes:
        trajectory: The present or last trajectory; None before the first and after a stop.
        next: The trajectory that will replace it, and the time until then [s]; None if there is
            none.
        effort: Torque in addition to inverse dynamics [N·m], (D,).
        time: Time since the start of the trajectory [s].
        over: Time since the end of the trajectory [s].
        lost_time: Time for which the error has exceeded LOST [s].
        desired: The present setpoint.
        error: Desired − estimated θ [rad], (D,).
        tension: Planned bone-side tension [N], (M,).
    """

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self._robot, self._settings = robot, settings
        self.trajectory: Trajectory | None = None
        self.next: tuple[Trajectory, float] | None = None
        self.effort: Array = np.zeros(robot.joint_count)
        self.time = self.over = self.lost_time = 0.0
        self.desired = Setpoint.resting(np.zeros(robot.joint_count))
        self.error: Array = np.zeros(robot.joint_count)
        self._missing_torque: Array = np.zeros(robot.joint_count)
        self.winches, self.feedback = Winches(robot), RestFeedback(robot)
        self.stiffening = Stiffening(robot, settings)
        self._friction: Array = np.full(robot.muscle_count, FRICTION)
        self._limit: Array = robot.tension.limit  # tension limit of the present plan [N], (M,)
        self._shift: Array = np.zeros(robot.joint_count)  # shift of θ by the feedback [rad]
        self._resting: tuple[Array, Array] | None = None  # l_target and G while holding
        self._blend: Ramp | None = None
        self.tension: Array = robot.tension.bias.copy()
        self._motor: Array = self.tension  # planned motor-side tension [N], (M,)
        #: sliding direction s of each tendon, (M,)
        self._sliding: Array = np.zeros(robot.muscle_count)

    def use(self, robot: Robot, settings: Settings) -> None:
        """Use another robot description and other settings.

        `robot` must already describe isolated muscles as muscles without tension.
        """
        self._robot, self._settings = robot, settings
        self.winches.use(robot)
        self.feedback.use(robot)
        self.stiffening.use(robot, settings)

    def use_network(self, mae: Mae) -> None:
        """Use another network; the command changes without a jump."""
        self._friction = tendon_friction(self._robot, mae)
        self.plan_anew()

    # -- requests -------------------------------------------------------------------------------

    def follow(self, trajectory: Trajectory, delay: float = 0.0) -> None:
        """Follow a trajectory that starts in `delay` [s] and replaces everything after that."""
        if delay > 0.0:
            self.next = trajectory, delay
        else:
            self._begin(trajectory, 0.0)

    def exert(self, effort: Array) -> None:
        """Exert a torque in addition to inverse dynamics [N·m] (D,), until it is changed."""
        if (effort != self.effort).any():
            self.effort = effort
            self.plan_anew()

    def plan_anew(self) -> None:
        """Plan again and blend the last command into the new plan; at rest, settle again."""
        if self._resting is not None and self.trajectory is not None:
            self.time = min(self.time, self.trajectory.duration)
            self.feedback.relief = np.zeros(self._robot.muscle_count)
        self._resting = self._blend = None

    @property
    def is_moving(self) -> bool:
        """Whether a trajectory is being followed or is due to start."""
        is_under_way = self.trajectory is not None and self.time < self.trajectory.duration
        return is_under_way or self.next is not None

    @property
    def has_fallen(self) -> bool:
        """Whether an arm with isolated muscles rests far from the end of its trajectory."""
        is_at_rest = self.trajectory is not None and self.next is None and self.over > FALLING
        if not is_at_rest or self._robot.used.all():
            return False
        return bool(np.abs(self.error / self._robot.kinematics.radian).max() > FALLEN)

    @property
    def has_lost_path(self) -> bool:
        """Whether an arm with isolated muscles has fallen, at the end or on the way."""
        is_lost = self.lost_time > FALLING and not self._robot.used.all()
        return self.has_fallen or (is_lost and self.next is None)

    @property
    def needs_trajectory(self) -> bool:
        """Whether it has no trajectory, as after a stop, or the arm has fallen."""
        return self.trajectory is None or self.has_lost_path

    @property
    def has_arrived(self) -> bool:
        """Whether the last trajectory has ended."""
        return not self.is_moving

    @property
    def missing_torque(self) -> Array | None:
        """Torque that no tensions within their limits provide [N·m], (D,)."""
        return None if self.trajectory is None else self._missing_torque

    @property
    def latest(self) -> Trajectory | None:
        """The most recently requested trajectory, even if it has not started yet."""
        return self.next[0] if self.next is not None else self.trajectory

    @property
    def solution(self) -> Solution | None:
        """The last solution of method `stiffness`."""
        return self.stiffening.solution

    def ahead(self, delay: float) -> Setpoint:
        """Return the setpoint of the present trajectory in `delay` [s]."""
        assert self.trajectory is not None
        return self.trajectory.sample(self.time + delay)

    # -- the activity ---------------------------------------------------------------------------

    def enter(self, _: Inputs) -> None:
        """Start, or continue after a pause, from the present tensions."""
        self._start()

    def leave(self) -> None:
        """Discard the trajectories."""
        self.trajectory = self.next = None

    def step(self, inputs: Inputs) -> Command | None:
        """Return the command, or None without a trajectory."""
        trajectory, sent, dt = self.trajectory, inputs.length, inputs.dt
        if trajectory is None:
            return None
        if self.is_moving:
            self.winches.step(inputs.sample.length, inputs.pull.motor, sent, dt)
        else:  # at rest, the measurements contain only noise and do not determine λ
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
        is_far = np.abs(self.error / self._robot.kinematics.radian).max() > LOST
        self.lost_time = self.lost_time + dt if is_far else 0.0
        if self.time < trajectory.duration + SETTLING:
            length = self._moving(trajectory, inputs)
        else:
            length = self._held(inputs)
        length = np.where(self._robot.used, length, sent)
        if self._blend is None:
            rate_limit = float(self._robot.actuation.fastest(self._settings.rate_limit).min())
            self._blend = Ramp(sent - length, np.zeros_like(length), BLENDING, rate_limit)
        return Command(LENGTH, length + self._blend.step(dt))

    def _start(self) -> None:
        self._resting = self._blend = None
        if self.trajectory is not None:  # plan the tensions of the held posture again
            self.time = min(self.time, self.trajectory.duration)
        self.tension = self._robot.tension.bias.copy()
        self._motor = self.tension
        self._sliding = np.zeros(self._robot.muscle_count)
        self.stiffening.reset()
        self.feedback.reset()
        self.winches.forget()

    def _begin(self, trajectory: Trajectory, time: float) -> None:
        self.trajectory, self.time, self.next = trajectory, time, None
        self.over = self.lost_time = 0.0
        if self._resting is not None:  # in motion, the trajectories join without a new plan
            self.plan_anew()

    @property
    def _is_stiff(self) -> bool:
        return self._settings.method == 'stiffness'

    def _moving(self, trajectory: Trajectory, inputs: Inputs) -> Array:
        """Return l_target [m] (M,) during the motion and while the arm settles."""
        feedback, largest = self.feedback, self.feedback.largest
        error = np.zeros_like(self.error) if self._is_stiff else self.error
        correction = feedback.correction + INTEGRAL * inputs.dt * error
        feedback.correction = np.clip(correction, -largest, largest)
        feedback.moving()
        # Bound the shift as well, so that a suddenly wrong estimate cannot move the arm far.
        shift = feedback.correction + PROPORTIONAL * error
        self._shift = np.clip(shift, -largest, largest)
        at = trajectory.sample(self.time + 0.5 * inputs.dt)
        return self._planned(trajectory, at, inputs)

    def _planned(self, trajectory: Trajectory, at: Setpoint, inputs: Inputs) -> Array:
        """Return l_target [m] (M,) for one setpoint."""
        robot, lag, mae, dt = self._robot, self.winches.lag, inputs.mae, inputs.dt
        jacobian = mae.muscle_jacobian(at.theta, self.tension)
        speed = jacobian @ at.velocity
        self._sliding = slid(self._sliding, -np.tanh(speed / TURNING), speed * dt)
        torque = robot.kinematics.inverse_dynamics(*at) + self.effort
        actuation, low = robot.actuation, robot.tension.bias
        low = low + actuation.tension_of_lag(lag, np.maximum(speed, 0.0))
        loss = np.exp(self._friction * self._sliding)
        near: Array | float = 0.0
        if self._is_stiff:
            near = self.stiffening.step(mae, trajectory, self.time, self.effort, inputs.limit, dt)
        if actuation.knows_tension:
            self.tension, self._missing_torque = least_tension(
                jacobian, torque, np.minimum(low, inputs.limit) / loss, inputs.limit / loss, near
            )
            self._motor = self.tension * loss
        else:
            self.tension = self._motor = actuation.assumed_tension
        length = mae.lengths(at.theta + self._shift, self.tension)
        return length + msc_compensation(robot, self._motor) + lag * speed

    def _held(self, inputs: Inputs) -> Array:
        """Return l_target [m] (M,) at rest, with the plan computed only once."""
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
    """Return the factor by which a trajectory has to be slowed for the muscle modules.

    Only the lengths at T_bias count. Tensions are ignored, because near postures that are hard to
    hold they change suddenly at any speed; `SHARE` reserves speed for them. A trajectory that
    starts in motion keeps its initial speed, so it can need more than this factor.
    """
    # Evaluate fewer moments of very long trajectories, so that no command is delayed by 0.1 s.
    time, theta = (part[:: 1 + len(part) // MOST_MOMENTS] for part in trajectory.path)
    length = mae.lengths(theta, np.tile(robot.tension.bias, (len(theta), 1)))
    speed = np.diff(length, axis=0) * robot.used / np.diff(time)[:, None]
    fastest = SHARE * robot.actuation.fastest(settings.rate_limit)
    return float(max(1.0, (np.abs(speed) / fastest).max()))
