# SPDX-License-Identifier: Apache-2.0
"""Converts poses and twists of the hand into joint trajectories.

Inverse kinematics converts a pose into joint angles. The search starts from the present setpoint,
so that it finds the nearest of several solutions. The solution has to be within the joint limits
and holdable with the learned G; otherwise the pose is refused. With `unreachable: nearest`, the
target is the posture within the joint limits in which the hand is nearest to the pose. If this
posture is not holdable, the arm stops on the straight path to it (`holdable_paths.nearest_held`).

The hand moves to a single pose at HAND_SPEED or more slowly. Poses in quick succession form a
path, which the hand follows at the speed at which they arrive. A pose is reached when the next pose
is due, and the arm comes to rest at the last pose. A twist moves the hand for TWIST_TIMEOUT
seconds.
"""

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Setup
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.messages.message_reading import TrajectoryPoints
from musculoskeletal_ae.motion.holdable_paths import lacking, nearest_held
from musculoskeletal_ae.motion.trajectory import JOINING, STOPPING, Setpoint, Trajectory
from musculoskeletal_ae.robot.inverse_kinematics import inverse_kinematics

#: end the search of the inverse kinematics within these distances [m] and angles [rad]: WHOLE for
#: position and orientation, POSITION for the position alone, with which any orientation is legal
WHOLE, POSITION = np.repeat([2e-4, 2e-3], 3), np.repeat([2e-4, 100.0], 3)
FAR = 0.005  # treat a pose as unreachable if the hand remains further away than this [m]
TURNED = 0.05  # treat a pose as unreachable if the orientation differs by more than this [rad]
HAND_SPEED = 0.25  # move the hand to a single pose no faster than this [m/s]
SHORTEST = 0.3  # take at least this time for a movement to a single pose [s]
PEAK = 1.875  # peak speed of a minimum-jerk motion, as a multiple of its mean speed
#: treat poses that arrive within this time of each other as a path, not as single targets [s]
PATH_INTERVAL = 0.25
#: treat poses as single targets if the hand would have to move faster than this between them [m/s]
PATH_SPEED = 1.0
#: weight of the newest interval between poses in the average interval of a path
INTERVAL_WEIGHT = 0.2
#: come to rest at the last pose of a path within this time after passing it [s]
RETURNING = 2.0 * STOPPING
TWIST_TIMEOUT = 0.3  # duration of the motion of the hand that one twist commands [s]
STARTING = 0.1  # time in which the hand accelerates to a twist [s]
#: damp the inverse Jacobian by this length, to limit joint speeds near singularities [m]
DAMPING = 0.02


class Hand:
    """Converts commanded poses and twists of the hand into trajectories of the joints."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        #: time [s], position [m] and posture θ [rad] of the last pose
        self._last: tuple[float, Array, Array] | None = None
        self._interval = 0.0  # average time between the poses of a path [s]; 0 if there is no path

    def posture(
        self, mae: Mae, pose: pin.SE3, whole: bool, start: Array, nearest: bool
    ) -> tuple[Array, str]:
        """Return the posture for a pose, and the reason why the hand does not reach the pose.

        Args:
            mae: The network in use.
            pose: The pose in the root link's frame.
            whole: True to reach position and orientation, False for the position alone.
            start: Posture from which the search starts [rad], (D,).
            nearest: Whether to return another posture, as `unreachable: nearest` demands, if the
                hand cannot reach or hold the pose.

        Returns:
            The posture θ [rad], (D,), and the reason, which is '' if the hand reaches the pose.

        Raises:
            MessageError: If the hand cannot reach or hold the pose and `nearest` is false.
        """
        robot = self._setup.robot
        theta, distance, angle, _ = inverse_kinematics(
            robot, pose, start, WHOLE if whole else POSITION
        )
        reason = ''
        if distance > FAR or (whole and angle > TURNED):
            reason = f'within the joint limits, the hand remains {1000.0 * distance:.0f} mm'
            if whole:
                reason += f' and {angle:.2f} rad'
            reason += ' away from the pose'
        kind = 'out of reach' if reason else 'not holdable'
        theta, lack = nearest_held(robot, mae, start, theta)
        reason = '; '.join(filter(None, (reason, lack)))
        if reason and not nearest:
            remedy = 'send another pose, or set the parameter `unreachable` to `nearest`'
            raise MessageError(kind, f'{reason}; {remedy}')
        return theta, reason

    def towards(self, start: Setpoint, theta: Array, now: float) -> Trajectory:
        """Return the trajectory that moves the hand towards a received pose.

        If poses arrive in quick succession, the trajectory continues the path of the earlier ones.

        Args:
            start: Setpoint from which the trajectory starts.
            theta: Posture in which the hand has the pose, θ [rad], (D,).
            now: Time at which the pose was received [s].
        """
        robot, last = self._setup.robot, self._last
        here = robot.kinematics.end_effector_pose(start.theta).translation
        where = robot.kinematics.end_effector_pose(theta).translation
        self._last = now, where, theta
        if last is not None and 0.0 < now - last[0] < PATH_INTERVAL:
            interval, moved = now - last[0], float(np.linalg.norm(where - last[1]))
            behind = float(np.linalg.norm(here - last[1]))
            if max(moved, behind) < PATH_SPEED * interval:
                before = self._interval or interval
                self._interval = before + INTERVAL_WEIGHT * (interval - before)
                velocity = (theta - last[2]) / self._interval
                # The arm passes this pose when the next one is due, after `_interval`. If joining
                # the path takes longer, it joins the path at a point extrapolated beyond this pose.
                # If no other pose arrives, the arm comes to rest at this pose.
                ahead = max(self._interval, JOINING)
                further = theta + (ahead - self._interval) * velocity
                path = np.array([np.clip(further, robot.lower, robot.upper), theta])
                rates = np.array([velocity, np.zeros_like(velocity)])
                time, every = np.array([ahead, ahead + RETURNING]), np.arange(len(theta))
                return Trajectory.through(
                    start, TrajectoryPoints(every, time, path, rates, 0.0 * rates)
                )
        self._interval = 0.0
        distance = float(np.linalg.norm(where - here))
        return Trajectory.to(start, theta, max(SHORTEST, PEAK * distance / HAND_SPEED))

    def again(self, now: float) -> None:
        """Record that the last pose was received again at `now` [s], so that its path continues."""
        if self._last is not None:
            self._last = now, *self._last[1:]

    def moved(self, mae: Mae, start: Setpoint, twist: Array) -> Trajectory:
        """Return the trajectory that moves the hand by a twist for TWIST_TIMEOUT seconds.

        Args:
            mae: The network in use.
            start: Setpoint from which the trajectory starts.
            twist: Linear [m/s] and angular [rad/s] velocity, (6,). The orientation of the hand is
                free if the angular velocity is 0.

        Raises:
            MessageError: If the muscles cannot hold the arm at the end of the motion.
        """
        robot = self._setup.robot
        jacobian = robot.kinematics.end_effector_jacobian(start.theta)
        rows = slice(0, 6 if twist[3:].any() else 3)
        part = jacobian[rows]
        normal = part @ part.T + DAMPING**2 * np.eye(len(part))
        velocity: Array = part.T @ np.linalg.solve(normal, twist[rows])
        time = np.cumsum([STARTING, TWIST_TIMEOUT, STOPPING])
        moving = 0.5 * STARTING + np.array([0.0, TWIST_TIMEOUT, TWIST_TIMEOUT + 0.5 * STOPPING])
        theta = start.theta + 0.5 * STARTING * start.velocity + moving[:, None] * velocity
        inside = np.clip(theta, robot.lower, robot.upper)
        # A joint that would exceed its limit stops at the limit; all other joints continue.
        free = (inside == theta).all(axis=0)
        if missing := lacking(robot, mae, inside[-1]):
            detail = f'at the end of this motion, the muscles lack {missing}'
            remedy = 'send a smaller twist, or one in another direction'
            raise MessageError('not holdable', f'{detail}; {remedy}')
        rates = np.array([1.0, 1.0, 0.0])[:, None] * velocity * free
        return Trajectory.through(
            start, TrajectoryPoints(np.arange(len(velocity)), time, inside, rates, 0.0 * rates)
        )
