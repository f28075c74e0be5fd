# SPDX-License-Identifier: Apache-2.0
"""The progress of an arm along trajectories: time, setpoint and error."""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.motion.trajectory import Setpoint, Trajectory
from musculoskeletal_ae.robot.robot import Robot

#: an arm with isolated muscles counts as fallen if it ends this far away from its goal [rad]
FALLEN = 0.2
#: an arm counts as fallen no earlier than this after the end of its trajectory, and its trajectory
#: counts as lost once the error has exceeded LOST for this time [s]
FALLING = 2.0
#: the trajectory of an arm with isolated muscles counts as lost, and is planned again, if the error
#: exceeds this for the time FALLING [rad]
LOST = 0.4


class Progress:
    """Tracks how far the arm is along a trajectory, and how far it is away from the setpoint.

    Attributes:
        trajectory: The present or last trajectory; None before the first trajectory and after a
            stop.
        next: The trajectory that will replace the present one, and the time until then [s]; None if
            no other trajectory is due.
        time: Time since the start of the trajectory [s].
        over: Time since the end of the trajectory [s]; 0 before its end.
        lost_time: Time [s] for which the error of some joint has been larger than LOST.
        desired: The present setpoint.
        error: Posture error, desired − estimated θ [rad], (D,).
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.trajectory: Trajectory | None = None
        self.next: tuple[Trajectory, float] | None = None
        self.time = self.over = self.lost_time = 0.0
        self.desired = Setpoint.resting(np.zeros(robot.joint_count))
        self.error: Array = np.zeros(robot.joint_count)

    def use(self, robot: Robot) -> None:
        """Use another robot description, which also states the isolated muscles."""
        self._robot = robot

    def begin(self, trajectory: Trajectory, time: float = 0.0) -> None:
        """Replace all trajectories by a trajectory that began `time` [s] ago."""
        self.trajectory, self.time, self.next = trajectory, time, None
        self.over = self.lost_time = 0.0

    def discard(self) -> None:
        """Discard all trajectories, so that the next motion has to be planned anew."""
        self.trajectory = self.next = None

    def return_to_end(self) -> None:
        """Set the time back to the end of the trajectory, as if it had only just ended.

        The follower then repeats the time of settling before the arm counts as resting. A
        trajectory that has not ended is not affected.
        """
        if self.trajectory is not None:
            self.time = min(self.time, self.trajectory.duration)

    def advance(self, dt: float) -> bool:
        """Advance by dt [s], and return whether the next trajectory has begun."""
        assert self.trajectory is not None
        self.time += dt
        self.over += dt if self.time >= self.trajectory.duration else 0.0
        if self.next is None:
            return False
        trajectory, delay = self.next[0], self.next[1] - dt
        self.next = trajectory, delay
        if delay > 0.0:
            return False
        self.begin(trajectory, -delay)
        return True

    def update_desired(self) -> None:
        """Set `desired` to the present setpoint of the trajectory."""
        self.desired = self.ahead(0.0)

    def compare(self, theta: Array, dt: float) -> None:
        """Compare `desired` with the estimated θ [rad], (D,), dt [s] after the last comparison."""
        self.error = self.desired.theta - theta
        self.lost_time = self.lost_time + dt if self._largest_error > LOST else 0.0

    @property
    def _largest_error(self) -> float:
        """Largest difference of a joint from its setpoint [rad]."""
        return float(np.abs(self.error).max())

    @property
    def is_moving(self) -> bool:
        """Whether a trajectory is being followed or is due to start."""
        is_under_way = self.trajectory is not None and self.time < self.trajectory.duration
        return is_under_way or self.next is not None

    @property
    def has_fallen(self) -> bool:
        """Whether an arm with isolated muscles has not stayed at the end of its trajectory.

        This is the case if, FALLING seconds after the end, the error of a joint exceeds FALLEN.
        """
        is_at_rest = self.trajectory is not None and self.next is None and self.over > FALLING
        return is_at_rest and not self._robot.used.all() and self._largest_error > FALLEN

    @property
    def has_lost_path(self) -> bool:
        """Whether an arm with isolated muscles has fallen away from its trajectory.

        This is the case during the motion if the error of a joint has exceeded LOST for FALLING
        seconds, and after the motion if `has_fallen` is true.
        """
        is_lost = self.lost_time > FALLING and not self._robot.used.all()
        return self.has_fallen or (is_lost and self.next is None)

    @property
    def latest(self) -> Trajectory | None:
        """The most recently requested trajectory, even if it has not started yet."""
        return self.next[0] if self.next is not None else self.trajectory

    def ahead(self, delay: float) -> Setpoint:
        """Return the setpoint of the present trajectory `delay` [s] from now."""
        assert self.trajectory is not None
        return self.trajectory.sample(self.time + delay)
