# SPDX-License-Identifier: Apache-2.0
"""From poses and twists of the hand to joint trajectories.

A pose becomes joint angles by inverse kinematics, from where the arm is desired to be, so that of
several postures the nearest is taken. It has to be within the joint limits and one that the muscles
can hold, with the learned G. Where it is not, it is refused, or, if that is wished (`unreachable`:
nearest), the hand comes as near as it can: as the inverse kinematics leaves it, and as far on the
way as the muscles can hold.

A single pose is gone to at `hand_speed`. Poses that come one soon after the other are a path,
passed at the speed at which they come: each is reached when the next is due, and if no other comes
the arm comes to rest at the last. A twist moves the hand for TWIST_TIMEOUT.
"""

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.reach import lacking, nearest_held
from musculoskeletal_ae.control.trajectory import STOPPING, Points, Setpoint, Trajectory
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.inverse_kinematics import inverse_kinematics
from musculoskeletal_ae.robot.robot import Robot

#: to which a pose is sought: [m] and [rad]; only its position
WHOLE, POSITION = np.repeat([2e-4, 2e-3], 3), np.repeat([2e-4, 100.0], 3)
FAR, TURNED = 0.005, 0.05  # [m], [rad] from a pose that is not reached
SHORTEST = 0.3  # [s] of a movement to a single pose
PEAK = 1.875  # fastest over mean speed of a motion of least jerk
#: [s] and [m/s] within which poses are a path, and how soon a new interval counts
FOLLOWING, FASTEST, MEMORY = 0.25, 1.0, 0.2
JOINING = 0.1  # [s] in which a path is joined, at least
RETURNING = 2.0 * STOPPING  # [s] to the last pose of a path
TWIST_TIMEOUT, STARTING = 0.3, 0.1  # [s]
DAMPING = 0.02  # [m] of a joint's leverage below which it turns less


class Hand:
    """Turns what is asked of the hand into trajectories; knows the last pose."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._last: tuple[float, Array, Array] | None = None  # when [s], where [m], θ [rad]
        self._interval = 0.0

    def posture(
        self, mae: Mae, pose: pin.SE3, whole: bool, start: Array, nearest: bool
    ) -> tuple[Array, str]:
        """Return θ [rad] (D,) for a pose, or for its position alone, and what it falls short of.

        A MessageError says why there is none, unless the `nearest` is wished.
        """
        robot = self._robot
        theta, distance, angle, _ = inverse_kinematics(
            robot, pose, start, WHOLE if whole else POSITION
        )
        short = ''
        if distance > FAR or (whole and angle > TURNED):
            short = f'{1000.0 * distance:.0f} mm'
            short += f' and {angle:.2f} rad' * whole + ' beyond the joint limits or the arm'
        theta, lack = nearest_held(robot, mae, start, theta)
        short = '; '.join(filter(None, (short, lack)))
        if short and not nearest:
            raise MessageError('out of reach', short)
        return theta, short

    def towards(self, start: Setpoint, theta: Array, speed: float, now: float) -> Trajectory:
        """Return the trajectory to θ [rad] (D,), the posture of a pose that came at `now` [s].

        A single one is gone to at `speed` [m/s].
        """
        robot, last = self._robot, self._last
        here = robot.kinematics.end_effector_pose(start.theta).translation
        where = robot.kinematics.end_effector_pose(theta).translation  # as near as it comes
        self._last = now, where, theta
        if last is not None and 0.0 < now - last[0] < FOLLOWING:
            interval, moved = now - last[0], float(np.linalg.norm(where - last[1]))
            behind = float(np.linalg.norm(here - last[1]))
            if max(moved, behind) < FASTEST * interval:
                before = self._interval or interval
                self._interval = before + MEMORY * (interval - before)
                velocity = (theta - last[2]) / self._interval
                # As far ahead as joining the path takes, as if it went on like this; and back.
                ahead = max(self._interval, JOINING)
                further = theta + (ahead - self._interval) * velocity
                path = np.array([np.clip(further, robot.lower, robot.upper), theta])
                rates = np.array([velocity, np.zeros_like(velocity)])
                time, every = np.array([ahead, ahead + RETURNING]), np.arange(len(theta))
                return Trajectory.through(start, Points(every, time, path, rates, 0.0 * rates))
        self._interval = 0.0
        way = float(np.linalg.norm(where - here))
        return Trajectory.to(start, theta, max(SHORTEST, PEAK * way / speed))

    def again(self, now: float) -> None:
        """Take that the last pose came once more."""
        if self._last is not None:
            self._last = now, *self._last[1:]

    def moved(self, mae: Mae, start: Setpoint, twist: Array) -> Trajectory:
        """Return the trajectory that moves the hand by a twist [m/s], [rad/s] (6,) for a while."""
        robot = self._robot
        jacobian = robot.kinematics.end_effector_jacobian(start.theta)
        rows = slice(0, 6 if twist[3:].any() else 3)  # without turning, as the arm likes
        part = jacobian[rows]
        normal = part @ part.T + DAMPING**2 * np.eye(len(part))
        velocity: Array = part.T @ np.linalg.solve(normal, twist[rows])
        time = np.cumsum([STARTING, TWIST_TIMEOUT, STOPPING])
        ways = 0.5 * STARTING + np.array([0.0, TWIST_TIMEOUT, TWIST_TIMEOUT + 0.5 * STOPPING])
        theta = start.theta + 0.5 * STARTING * start.velocity + ways[:, None] * velocity
        inside = np.clip(theta, robot.lower, robot.upper)
        # A joint that would meet its limit stops there, the others go on.
        free = (inside == theta).all(axis=0)
        if missing := lacking(robot, mae, inside[-1]):
            raise MessageError('out of reach', f'the muscles lack {missing} there')
        rates = np.array([1.0, 1.0, 0.0])[:, None] * velocity * free
        return Trajectory.through(
            start, Points(np.arange(len(velocity)), time, inside, rates, 0.0 * rates)
        )
