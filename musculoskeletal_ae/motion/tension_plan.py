# SPDX-License-Identifier: Apache-2.0
"""Plans the tensions along a trajectory, and the lengths that muscle stiffness control needs.

The module `follower` states the equations. Only the tensions are varied, and the network is
evaluated at the setpoint, so that no plan deviates from it. Torque balance and tension limits are
constraints and therefore take priority over the least tension. In a weighted sum of norms, ‖T‖
could outweigh the torque balance, and the arm would sag.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Settings, Setup
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.activities import msc_compensation
from musculoskeletal_ae.motion.feedback import (
    CORRECTION,
    Shift,
    depends_on_limit,
    largest_support,
)
from musculoskeletal_ae.motion.holdable_paths import tendon_friction
from musculoskeletal_ae.motion.methods import SOLVES, Solution, stiffness_command
from musculoskeletal_ae.motion.slowness import SHARE
from musculoskeletal_ae.motion.trajectory import Setpoint, Trajectory
from musculoskeletal_ae.robot.joint_stops import supporting_stops
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension
from musculoskeletal_ae.signals.friction import slid

#: plan full tendon friction for tendons that slide much faster than this [m/s], and less for slower
#: ones, whose sliding direction is uncertain because of noise
TURNING = 0.005
AHEAD = 0.2  # compute T_K at this interval, for the setpoint that is this time ahead [s]


class Stiffening:
    """Computes the tensions T_K that give the desired joint stiffness (method `stiffness`).

    Every AHEAD seconds, the tensions for the setpoint AHEAD seconds later are computed. T_K
    changes towards them at a limited rate.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self.reset()

    def reset(self) -> None:
        """Discard the present solution; the next step computes a new one."""
        self.solution: Solution | None = None  # the solution that T_K approaches
        #: present tensions T_K [N], (M,), which approach `solution`
        self._near: Array = self._setup.robot.tension.bias
        self._solved = 0.0  # time since the solution was computed [s]

    def step(
        self, mae: Mae, trajectory: Trajectory, time: float, effort: Array, limit: Array, dt: float
    ) -> Array:
        """Advance by dt [s] and return the tensions T_K [N], (M,).

        The rate of T_K is limited. Trajectories may use the fraction SHARE of the rate limit of the
        lengths, and T_K may use half of the remaining fraction.
        """
        robot, settings, solution = self._setup.robot, self._setup.settings, self.solution
        self._solved += dt
        if solution is None or self._solved >= AHEAD:
            at, self._solved = trajectory.sample(time + AHEAD), 0.0
            torque = robot.kinematics.inverse_dynamics(*at) + effort
            desired = settings.desired_stiffness(robot.units)
            near = None if solution is None else self._near
            solution = stiffness_command(
                robot, mae, at.theta, torque, desired, limit, near, at.velocity, effort
            )
            self._near = solution.tension if near is None else near
            self.solution = solution
        # Use only half of the remaining rate. The other half is for the stretch of the series
        # elastic elements, which changes with T and which the command has to follow, too.
        actuation = robot.actuation
        rates = actuation.fastest(settings.rate_limit) * actuation.tension_per_length(self._near)
        largest = 0.5 * (1.0 - SHARE) * rates * dt
        self._near = self._near + np.clip(solution.tension - self._near, -largest, largest)
        return self._near


class TensionPlan:
    """Computes tensions and lengths for the successive setpoints of a trajectory.

    Attributes:
        effort: Torque in addition to inverse dynamics [N·m], (D,).
        bone_tension: Bone-side tension T of the last setpoint [N], (M,); T_bias before the first.
        motor_tension: Motor-side tension T e^{μ s} of the last setpoint [N], (M,).
        missing_torque: Torque that no tensions within their limits provide there [N·m], (D,).
        jacobian: Muscle Jacobian G at the last setpoint [m/rad], (M, D).
    """

    def __init__(self, setup: Setup) -> None:
        self._setup, robot = setup, setup.robot
        self.effort: Array = np.zeros(robot.joint_count)
        self.jacobian: Array = np.zeros((robot.muscle_count, robot.joint_count))
        self._limit: Array = robot.tension.limit  # tension limit of the present plan [N], (M,)
        self._stiffening = Stiffening(setup)
        self.reset()

    def reset(self) -> None:
        """Discard the plan: all muscles are at T_bias again, and no sliding direction is known."""
        self.bone_tension: Array = self._setup.robot.tension.bias.copy()
        self.motor_tension: Array = self.bone_tension
        self.missing_torque: Array = np.zeros(self._setup.robot.joint_count)
        #: sliding state s of each tendon: 1 after winding in, −1 after paying out, (M,)
        self._sliding: Array = np.zeros(self._setup.robot.muscle_count)
        self._stiffening.reset()

    @property
    def is_stiff(self) -> bool:
        """Whether the method is `stiffness`, which uses no feedback."""
        return self._setup.settings.control_method.sets_stiffness

    @property
    def solution(self) -> Solution | None:
        """The last solution of the method `stiffness`; None if there is none."""
        return self._stiffening.solution

    def adopt(self, limit: Array, effort: Array) -> bool:
        """Adopt a tension limit and an effort; return whether they require a new plan.

        Args:
            limit: Highest motor-side tension that may be planned [N], (M,).
            effort: Torque in addition to inverse dynamics [N·m], (D,).
        """
        is_other = depends_on_limit(self.motor_tension, self._limit, limit)
        if is_other:
            self._limit = limit
        is_other = is_other or bool((effort != self.effort).any())
        self.effort = effort
        return is_other

    def step(
        self,
        trajectory: Trajectory,
        time: float,
        shift: Shift,
        lag: float,
        mae: Mae,
        limit: Array,
        dt: float,
    ) -> Array:
        """Plan the next setpoint of a trajectory, and return its length command [m], (M,).

        Args:
            trajectory: The trajectory that the arm follows.
            time: Time since the start of the trajectory [s].
            shift: Shift of θ by the feedback.
            lag: Time λ by which the muscle modules lag behind their commands [s].
            mae: The network.
            limit: Highest motor-side tension that may be planned [N], (M,).
            dt: Time since the last setpoint [s].
        """
        robot = self._setup.robot
        at = trajectory.sample(time + 0.5 * dt)
        self.jacobian = jacobian = mae.muscle_jacobian(at.theta, self.bone_tension)
        speed = jacobian @ at.velocity
        self._sliding = slid(self._sliding, -np.tanh(speed / TURNING), speed * dt)
        torque = robot.kinematics.inverse_dynamics(*at) + self.effort
        actuation, low = robot.actuation, robot.tension.bias
        low = low + actuation.tension_of_lag(lag, np.maximum(speed, 0.0))
        loss = np.exp(tendon_friction(robot, mae) * self._sliding)
        near: Array | float = 0.0
        if self.is_stiff:
            near = self._stiffening.step(mae, trajectory, time, self.effort, limit, dt)
        if robot.tension_source.is_known:
            limits = np.minimum(low, limit) / loss, limit / loss
            stops = supporting_stops(robot, at.theta, at.velocity, self.effort)
            supporting = torque + largest_support(mae) / CORRECTION * shift.torque
            tension, missing_torque = least_tension(jacobian, supporting, *limits, near, stops)
            if missing_torque.any():  # report only what is missing without the feedback
                without_feedback = least_tension(jacobian, torque, *limits, near, stops)
                missing_torque = without_feedback.missing_torque
            self.bone_tension, self.motor_tension = tension, tension * loss
            self.missing_torque = missing_torque
        else:
            self.bone_tension = self.motor_tension = actuation.assumed_tension
        return self.length(mae, at.theta + shift.length) + lag * speed

    def length(self, mae: Mae, theta: Array) -> Array:
        """Return the length command [m], (M,), that exerts the planned tensions at rest.

        The arm rests at the posture `theta` [rad], (D,).
        """
        length = mae.lengths(theta, self.bone_tension)
        return length + msc_compensation(self._setup.robot, self.motor_tension)


def plan_at_rest(robot: Robot, mae: Mae, theta: Array) -> TensionPlan:
    """Return the plan by which method `proposed` holds the posture θ [rad], (D,), without feedback.

    Its `length(mae, theta)` is the length command. The arm has not moved before, so that tendon
    friction does not count.
    """
    plan, none = TensionPlan(Setup(robot, Settings())), np.zeros(robot.joint_count)
    trajectory = Trajectory.to(Setpoint.resting(theta), theta, 1.0)
    for _ in range(SOLVES):
        plan.step(trajectory, 0.0, Shift(none, none), 0.0, mae, robot.tension.limit, 0.0)
    return plan
