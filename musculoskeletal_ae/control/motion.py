# SPDX-License-Identifier: Apache-2.0
"""Motion at speed: muscle lengths along a trajectory, by inverse dynamics and learned lengths.

At each message, for the θ, θ̇, θ̈ that are desired then (`trajectory`),

    τ = M(θ) θ̈ + h(θ, θ̇)                                       rigid bodies (pinocchio's RNEA)
    T = argmin ‖T‖²   subject to  −Gᵀ T = τ,  T_low ≤ T ≤ T_limit,   T at the far ends of the wires
    l = ①(θ + k_p e + c, T),   e = θ − θ_estimated,   dc/dt = k_i e,   |c|, |k_p e + c| ≤ CORRECTION
    l_target = l + l_comp(T e^{μ s}) + λ dl/dt

Friction: the tension at the motor is T e^{μ s}, with s the direction in which the wire slides along
the path, and μ as the learner found it (`mae.touch`), else FRICTION. Winches: the motor of a
module that follows muscle stiffness control (MSC) turns at dl/dt = (T − T_MSC)/(K_stiff λ). So its
command has to lead by λ dl/dt, and a wire that is pulled out at dl/dt resists with T_bias + K_stiff
λ dl/dt even if MSC demands no more than T_bias; that is T_low. λ is measured while the arm moves.

A trajectory that winches cannot follow is slowed as a whole before it starts (`slowness`). After
its end G and T stay as they are, and the feedback at rest (`posture.RestFeedback`) goes on from c.

Method `stiffness`: argmin ‖T − T_K‖² instead, with T_K of `methods.stiffness_command` for the θ and
τ of a moment later, and no feedback, under which a chosen stiffness would not last.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.methods import Solution, msc_compensation, stiffness_command
from musculoskeletal_ae.control.posture import Pull, Ramp, RestFeedback, another_plan
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.control.trajectory import Setpoint, Trajectory
from musculoskeletal_ae.friction import slid
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension

PROPORTIONAL, INTEGRAL = 0.7, 4.0  # k_p; k_i [1/s]
FRICTION = 0.05  # μ where none was learned: the mean of what hands build
SHARE = 0.7  # of the winches' speed that lengths may use; the rest is for tensions and feedback
MOST_MOMENTS = 12_500  # that a network is asked about; every piece of 10 000 has one still
BLENDING = 0.3  # [s] in which what the command was before fades into the plan's
FALLEN, FALLING = 0.2, 2.0  # [rad] off, or times RACK, so long [s] after the end
SETTLING = 0.8  # [s] after the end, in which the feedback of the motion goes on
TURNING = 0.005  # [m/s] of a wire beyond which its direction is sure
WINDING = 0.03  # [m/s] from which a winch tells its lag
LAGS = 2.0e-3  # [m²/s²] of winding that the first guess of λ, none, counts for
LARGEST_LAG, SPAN = 0.1, 0.0095  # [s]; over which l tells how fast it winds, above its noise
AHEAD = 0.2  # [s] to the moment of T_K, and between two of them


class Winches:
    """λ [s] of the modules: how far they lag behind what MSC demands.

        l − l_target − (T − T_bias)/K_stiff = −λ dl/dt     wherever MSC demands more than T_bias

    by least squares over all muscles that wind fast enough to tell.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._products, self._squares = 0.0, LAGS
        self._since = self._last = 0.0
        self._length: Array | None = None

    @property
    def lag(self) -> float:
        """λ as far as it is known [s]."""
        return min(max(self._products / self._squares, 0.0), LARGEST_LAG)

    def step(self, length: Array, tension: Array, command: Array, dt: float) -> None:
        """Take l [m], T [N] (M,), `dt` [s] after the ones before, and what was commanded then."""
        # Medians of three messages tell how it was one message ago.
        self._since, self._last = self._since + self._last, dt
        if self._length is not None and self._since < SPAN:
            return
        before, since = self._length, self._since
        self._length, self._since = length, 0.0
        if before is None:
            return
        speed = (length - before) / since
        lacking = length - command + msc_compensation(self._robot, tension)
        telling = (np.abs(speed) > WINDING) & (length > command) & self._robot.used
        self._products -= float(lacking[telling] @ speed[telling])
        self._squares += float(speed[telling] @ speed[telling])

    def forget(self) -> None:
        """Begin anew after a pause; λ stays."""
        self._length, self._since = None, 0.0


class MotionControl:
    """Follows trajectories, and holds where the last one ended."""

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self._robot, self.settings = robot, settings
        self.trajectory: Trajectory | None = None
        self.next: tuple[Trajectory, float] | None = None  # and in how many seconds it starts
        self.effort: Array = np.zeros(robot.joint_count)  # beyond weight and motion [N·m]
        self.desired = Setpoint.resting(np.zeros(robot.joint_count))
        self.error: Array = np.zeros(robot.joint_count)  # desired − estimated θ [rad]
        self.missing_torque: Array = np.zeros(robot.joint_count)
        self.winches, self._feedback = Winches(robot), RestFeedback(robot)
        self._mae: Mae | None = None
        #: [s] since the trajectory began, and since it ended, whatever was planned anew meanwhile
        self.time = self.over = 0.0
        self._friction: Array = np.full(robot.muscle_count, FRICTION)
        self._blend: Ramp | None = None
        self._resting: tuple[Array, Array] | None = None  # l_target and G where it is held
        self._limit: Array = robot.tension.limit  # that was planned with [N], (M,)
        self._shift: Array = np.zeros(robot.joint_count)  # of θ by the feedback [rad]
        self.solution: Solution | None = None  # the last that T_K goes to
        self._near: Array = robot.tension.bias  # T_K [N], (M,)
        self.start()

    # -- what is asked --------------------------------------------------------------------------

    def use(self, mae: Mae) -> None:
        """Take a new network; the command goes over to it without a jump."""
        self._mae = mae
        touch = getattr(mae, 'touch', None)
        known = np.full(self._robot.muscle_count, FRICTION) if touch is None else touch.friction
        self._friction = known
        self.plan_anew()

    def start(self) -> None:
        """Go on from what something else commanded."""
        self._resting = self._blend = None
        if self.trajectory is not None:  # held, or held anew: its tensions are planned again
            self.time = min(self.time, self.trajectory.duration)
        # T at the far ends and at the motors [N], and s of each wire
        self._tension: Array = self._robot.tension.bias.copy()
        self._motor: Array = self._tension
        self._sliding: Array = np.zeros(self._robot.muscle_count)
        self.solution, self._solved = None, 0.0  # how long ago [s]
        self._feedback.reset()
        self.winches.forget()

    def follow(
        self, trajectory: Trajectory, delay: float = 0.0, slower: float | None = None
    ) -> None:
        """Follow a trajectory from `delay` [s] on, in the place of all that was to come after.

        It is passed `slower` times later, its `slowness` where that is not known yet.
        """
        assert self._mae is not None
        if slower is None:
            slower = slowness(self._robot, self._mae, trajectory, self.settings)
        trajectory = trajectory.scaled(slower)
        if delay > 0.0:
            self.next = trajectory, delay
        else:
            self._begin(trajectory, 0.0)

    def _begin(self, trajectory: Trajectory, time: float) -> None:
        self.trajectory, self.time, self.next = trajectory, time, None
        self.over = 0.0
        if self._resting is not None:  # on the way, one goes over to the next by itself
            self.plan_anew()

    def exert(self, effort: Array) -> None:
        """Exert a torque [N·m] (D,) beyond weight and motion, by the trajectory and after it."""
        if (effort != self.effort).any():
            self.effort = effort
            self.plan_anew()

    def plan_anew(self) -> None:
        """Go over from the last command to another without a jump; at rest, settle again."""
        if self._resting is not None and self.trajectory is not None:
            self.time = min(self.time, self.trajectory.duration)
            self._feedback.relief = np.zeros(self._robot.muscle_count)
        self._resting = self._blend = None

    @property
    def moving(self) -> bool:
        """Whether a trajectory goes on or is to come."""
        going = self.trajectory is not None and self.time < self.trajectory.duration
        return going or self.next is not None

    @property
    def fallen(self) -> bool:
        """Whether the arm lacks a muscle and rests elsewhere than where a trajectory has led."""
        rested = self.trajectory is not None and self.over > FALLING
        rested = rested and self.next is None and not self._robot.used.all()
        return bool(rested and np.abs(self.error / self._robot.kinematics.radian).max() > FALLEN)

    @property
    def latest(self) -> Trajectory | None:
        """What was to be followed last, whether it has begun or is to come."""
        return self.next[0] if self.next is not None else self.trajectory

    def ahead(self, delay: float) -> Setpoint:
        """Return what will be desired in `delay` [s], as far as is known now."""
        assert self.trajectory is not None
        return self.trajectory.sample(self.time + delay)

    # -- time -----------------------------------------------------------------------------------

    def step(
        self, length: Array, pull: Pull, theta: Array, sent: Array, limit: Array, dt: float
    ) -> Array:
        """Return the command [m] (M,), dt [s] after the last, of which `sent` left [m] (M,).

        l [m] is measured, θ [rad] estimated; `limit` [N] (M,) is the highest tension planned for
        each muscle.
        """
        mae, trajectory = self._mae, self.trajectory
        assert mae is not None and trajectory is not None
        if self.moving:
            self.winches.step(length, pull.motor, sent, dt)
        else:  # noise alone says nothing of λ
            self.winches.forget()
        self.time += dt
        self.over += dt if self.time >= trajectory.duration else 0.0
        if self.next is not None:
            self.next = self.next[0], self.next[1] - dt
            if self.next[1] <= 0.0:
                trajectory = self.next[0]
                self._begin(trajectory, -self.next[1])
        if another_plan(self._motor, self._limit, limit):
            self._limit = limit
            self.plan_anew()
        if self._resting is None:
            self.desired = trajectory.sample(self.time)
        self.error = self.desired.theta - theta
        feedback = self._feedback
        if self.time < trajectory.duration + SETTLING:
            error = np.zeros_like(theta) if self._stiff else self.error
            step, most = INTEGRAL * dt * error, feedback.most
            feedback.correction = np.clip(feedback.correction + step, -most, most)
            feedback.moving()
            # Bounded too: an estimate that is wrong at once must not take the arm along.
            shift = feedback.correction + PROPORTIONAL * error
            self._shift = np.clip(shift, -most, most)
            command = self._planned(mae, trajectory.sample(self.time + 0.5 * dt), limit, dt)
        else:
            command = self._held(mae, pull, limit, dt)
        command = np.where(self._robot.used, command, sent)
        if self._blend is None:
            rate = self.settings.rate_limit
            self._blend = Ramp(sent - command, np.zeros_like(command), BLENDING, rate)
        return command + self._blend.step(dt)

    def _planned(self, mae: Mae, at: Setpoint, limit: Array, dt: float) -> Array:
        """Return l_target [m] (M,) for a moment."""
        robot, lag = self._robot, self.winches.lag
        jacobian = mae.muscle_jacobian(at.theta, self._tension)
        speed = jacobian @ at.velocity
        self._sliding = slid(self._sliding, -np.tanh(speed / TURNING), speed * dt)
        torque = robot.kinematics.inverse_dynamics(*at) + self.effort
        low = robot.tension.bias + robot.stiffness * lag * np.maximum(speed, 0.0)
        loss = np.exp(self._friction * self._sliding)
        near = self._stiffening(mae, limit, dt) if self._stiff else 0.0
        self._tension, self.missing_torque = least_tension(
            jacobian, torque, np.minimum(low, limit) / loss, limit / loss, near
        )
        self._motor = self._tension * loss
        length = mae.lengths(at.theta + self._shift, self._tension)
        return length + msc_compensation(robot, self._motor) + lag * speed

    @property
    def _stiff(self) -> bool:
        return self.settings.method == 'stiffness'

    def _stiffening(self, mae: Mae, limit: Array, dt: float) -> Array:
        """Return T_K [N] (M,), as fast as it may change by what the plan leaves of the winches."""
        robot, trajectory, solution = self._robot, self.trajectory, self.solution
        assert trajectory is not None
        self._solved += dt
        if solution is None or self._solved >= AHEAD:
            at, self._solved = trajectory.sample(self.time + AHEAD), 0.0
            torque = robot.kinematics.inverse_dynamics(*at) + self.effort
            desired = np.array(self.settings.desired_stiffness(robot.kinematics.radian))
            near = None if solution is None else self._near
            solution = stiffness_command(robot, mae, at.theta, torque, desired, limit, near)
            self._near = solution.tension if near is None else near
            self.solution = solution
        # Half, since the elastic unit stretches as well.
        most = 0.5 * (1.0 - SHARE) * self.settings.rate_limit * robot.stiffness * dt
        self._near = self._near + np.clip(solution.tension - self._near, -most, most)
        return self._near

    def _held(self, mae: Mae, pull: Pull, limit: Array, dt: float) -> Array:
        """Return l_target [m] (M,) at rest, for which nothing is solved that does not change."""
        feedback = self._feedback
        if self._resting is None:
            feedback.correction = self._shift
            theta = self.desired.theta
            length = mae.lengths(theta, self._tension) + msc_compensation(self._robot, self._motor)
            self._resting = length, mae.muscle_jacobian(theta, self._tension)
        length, jacobian = self._resting
        gain = 0.0 if self._stiff else self.settings.feedback_gain
        feedback.step(self.error, jacobian, pull, limit, gain, dt)
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
