# SPDX-License-Identifier: Apache-2.0
"""From targets, poses and twists to trajectories that the arm can follow.

Every function returns a plan or raises a MessageError that says why there is none; nothing changes
then. A plan keeps within the joint limits, ends where the muscles can hold the arm, and is slowed
to what the winches can follow.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control import reach
from musculoskeletal_ae.control.follower import slowness
from musculoskeletal_ae.control.hand import Hand
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.control.trajectory import Points, Setpoint, Trajectory
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot.robot import Robot

ROUNDING = 1e-6  # [rad] by which a point may lie beyond a joint limit
SAME = 1e-6  # poses that differ by less are one


class Plan(NamedTuple):
    """A trajectory as it can be followed.

    Attributes:
        trajectory: Already slowed.
        unreachable_reason: Why it ends elsewhere than was asked, or ''.
    """

    trajectory: Trajectory
    unreachable_reason: str = ''


class Planner:
    """Plans trajectories with the network in use."""

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self._hand = Hand(robot)
        #: the last pose, whether its orientation counts, and the trajectory to it
        self._last_pose: tuple[pin.SE3, bool, Trajectory] | None = None
        self.use(robot, settings)

    def use(self, robot: Robot, settings: Settings) -> None:
        """Plan with this robot, whose isolated muscles pull nothing, and these settings."""
        self._robot, self._settings = robot, settings

    @property
    def takes_nearest(self) -> bool:
        """Whether the nearest posture is approached where the one asked for is out of reach."""
        return self._settings.unreachable == 'nearest'

    def to_posture(self, mae: Mae, start: Setpoint, theta: Array, duration: float) -> Plan:
        """Plan a motion to rest at θ [rad] (D,) within a duration [s], by a way that is held."""
        way = reach.way(self._robot, mae, start.theta, theta)
        return Plan(self._within_limits(mae, Trajectory.to(start, way, duration)))

    def through(self, mae: Mae, start: Setpoint, points: Points, passed: float) -> Plan:
        """Plan a motion through points, `passed` [s] after the time that they count from."""
        self._check_limits(points)
        planned = self._slowed(mae, Trajectory.through(start, points, passed))
        self.reachable(mae, start.theta, planned.end, nearest=False)
        return Plan(planned)

    def to_rest(self, start: Setpoint) -> Plan:
        """Plan to come to rest within a moment."""
        return Plan(Trajectory.stopping(start, self._robot))

    def to_pose(self, mae: Mae, start: Setpoint, pose: pin.SE3, whole: bool, now: float) -> Plan:
        """Plan to bring the end effector to a pose in the root link's frame.

        Args:
            mae: The network in use.
            start: Where the motion starts.
            pose: Where to bring the end effector.
            whole: Whether the orientation counts.
            now: When the pose came [s].
        """
        theta, problem = self._hand.posture(mae, pose, whole, start.theta, self.takes_nearest)
        towards = self._hand.towards(start, theta, self._settings.hand_speed, now)
        planned = self._within_limits(mae, towards)
        self._last_pose = pose, whole, planned
        return Plan(planned, problem and f'{problem}; nearest approached')

    def is_under_way(self, pose: pin.SE3, whole: bool, followed: Trajectory | None) -> bool:
        """Return whether what is followed leads to this very pose already."""
        if self._last_pose is None or followed is None:
            return False
        before, whole_before, trajectory = self._last_pose
        same = whole == whole_before and bool(before.isApprox(pose, SAME))
        return same and trajectory is followed

    def repeat_pose(self, now: float) -> None:
        """Take that the last pose came once more at `now` [s]."""
        self._hand.again(now)

    def by_twist(self, mae: Mae, start: Setpoint, twist: Array) -> Plan:
        """Plan to move the end effector by a twist [m/s], [rad/s] (6,) for a while."""
        return Plan(self._within_limits(mae, self._hand.moved(mae, start, twist)))

    def reachable(self, mae: Mae, start: Array, theta: Array, nearest: bool) -> tuple[Array, str]:
        """Return the posture that can be held without the isolated muscles, and what θ lacks.

        Args:
            mae: The network in use.
            start: Where the arm is [rad], (D,).
            theta: Where it should go [rad], (D,).
            nearest: Whether the nearest posture that can be held will do.

        Raises:
            MessageError: If the arm cannot be held at θ and `nearest` is false.
        """
        robot = self._robot
        if robot.used.all():
            return theta, ''
        held, problem = reach.nearest_held(robot, mae, start, theta)
        if not problem:
            return theta, ''
        isolated = robot.names(robot.isolated)
        problem = f'{problem} without {isolated}; nearest posture held: {robot.told(held)}'
        if not nearest:
            raise MessageError('out of reach', problem)
        return held, f'{problem}; nearest approached'

    def _check_limits(self, points: Points) -> None:
        robot = self._robot
        low, high = robot.lower[points.joints], robot.upper[points.joints]
        beyond = (points.position < low - ROUNDING) | (points.position > high + ROUNDING)
        if not beyond.any():
            return
        k, j = np.argwhere(beyond)[0]
        unit = robot.units[points.joints[j]].theta
        value, least, most = distinct(points.position[k, j], low[j], high[j], digits=4)
        raise MessageError(
            'beyond the joint limits',
            f'{robot.joints[points.joints[j]]} {value}, legal: {least} to {most} {unit}',
        )

    def _slowed(self, mae: Mae, planned: Trajectory) -> Trajectory:
        """Return a trajectory as slow as the winches need.

        A MessageError says that it then leaves the joint limits: one that is slowed and starts in
        motion takes another way.
        """
        slower = planned.scaled(slowness(self._robot, mae, planned, self._settings))
        slower.check(self._robot)
        return slower

    def _within_limits(self, mae: Mae, planned: Trajectory) -> Trajectory:
        """Return a trajectory within the joint limits, which comes to rest first if it has to."""
        try:
            return self._slowed(mae, planned)
        except MessageError:
            return self._slowed(mae, planned.after_rest(self._robot))
