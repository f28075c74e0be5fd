# SPDX-License-Identifier: Apache-2.0
"""The progress of an arm along trajectories: time, setpoint and error."""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Setup
from musculoskeletal_ae.motion.trajectory import Setpoint, Trajectory

#: a new motion of an arm with isolated muscles starts from the estimated posture instead of the
#: setpoint if a joint is further than this away from it [rad]: the arm has fallen
FALLEN = 0.4


class Progress:
    """Tracks how far the arm is along a trajectory, and how far it is away from the setpoint.

    Attributes:
        trajectory: The present or last trajectory; None before the first trajectory and after a
            stop.
        next: The trajectory that will replace the present one, and the time until then [s]; None if
            no other trajectory is due.
        time: Time since the start of the trajectory [s].
        desired: The present setpoint.
        error: Posture error, desired − estimated θ [rad], (D,).
    """

    def __init__(self, setup: Setup) -> None:
        self._setup, joints = setup, setup.robot.joint_count
        self.trajectory: Trajectory | None = None
        self.next: tuple[Trajectory, float] | None = None
        self.time = 0.0
        self.desired = Setpoint.resting(np.zeros(joints))
        self.error: Array = np.zeros(joints)

    def begin(self, trajectory: Trajectory, time: float = 0.0) -> None:
        """Replace all trajectories by a trajectory that began `time` [s] ago."""
        self.trajectory, self.time, self.next = trajectory, time, None

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

    def compare(self, theta: Array) -> None:
        """Compare `desired` with the estimated θ [rad], (D,)."""
        self.error = self.desired.theta - theta

    @property
    def is_moving(self) -> bool:
        """Whether a trajectory is being followed or is due to start."""
        is_under_way = self.trajectory is not None and self.time < self.trajectory.duration
        return is_under_way or self.next is not None

    @property
    def has_fallen(self) -> bool:
        """Whether an arm with isolated muscles is far away from its setpoint."""
        return not self._setup.robot.used.all() and bool((np.abs(self.error) > FALLEN).any())

    @property
    def latest(self) -> Trajectory | None:
        """The most recently requested trajectory, even if it has not started yet."""
        return self.next[0] if self.next is not None else self.trajectory

    def ahead(self, delay: float) -> Setpoint:
        """Return the setpoint of the present trajectory `delay` [s] from now."""
        assert self.trajectory is not None
        return self.trajectory.sample(self.time + delay)
