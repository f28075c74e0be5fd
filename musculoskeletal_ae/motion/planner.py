# SPDX-License-Identifier: Apache-2.0
"""Plans trajectories that the arm can follow, from target postures, poses and twists.

The methods that plan return a trajectory, or raise a MessageError with the reason. All trajectories
except those of `to_rest` are slowed to the speed of the muscle modules. They stay within the joint
limits, with the tolerance `trajectory.BEYOND`. Those of `to_pose` and `by_twist` end in a holdable
posture. Those of `through` are checked for this only if a muscle is isolated. `to_posture` does not
check the target: its caller does so with `reachable`. With isolated muscles, `holdable_paths.py`
finds the path, and the whole way is checked, except that of `by_twist`.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Setup
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.messages.message_reading import TrajectoryPoints
from musculoskeletal_ae.motion import holdable_paths
from musculoskeletal_ae.motion.hand import Hand
from musculoskeletal_ae.motion.slowness import slowed_to_exert, slowness
from musculoskeletal_ae.motion.trajectory import Setpoint, Trajectory
from musculoskeletal_ae.report import distinct

#: Refuse a point that exceeds a joint limit by more than this [rad]; clip any other point to the
#: limit. The points of a replayed motion are estimated postures, and the estimate of an arm that is
#: held against a joint stop exceeds the limit by less than this.
TOLERANCE = 0.01
#: reason of a refused motion to a posture that the muscles cannot hold, or to which they cannot
#: move the arm
NOT_HOLDABLE = 'not holdable'
SAME = 1e-6  # treat two poses as equal below this relative difference


class Planner:
    """Plans trajectories with the network in use."""

    def __init__(self, setup: Setup) -> None:
        self._setup, self._hand = setup, Hand(setup)
        #: the last pose, whether its orientation counts, and the trajectory to it
        self._last_pose: tuple[pin.SE3, bool, Trajectory] | None = None

    @property
    def takes_nearest(self) -> bool:
        """Whether the arm goes to the nearest holdable posture if the target is not holdable."""
        return self._setup.settings.unreachable == 'nearest'

    def to_posture(
        self, mae: Mae, start: Setpoint, theta: Array, duration: float, lag: float
    ) -> tuple[Trajectory, str]:
        """Plan a motion to rest at θ [rad], (D,).

        With isolated muscles, the motion avoids postures that are not holdable
        (`holdable_paths.way`). If the muscles cannot move the arm along the whole way, the motion
        is refused, or ends on the way if `takes_nearest`.

        Args:
            mae: The network in use.
            start: Setpoint from which the motion starts.
            theta: Target posture [rad], (D,).
            duration: Shortest time for each segment of the path [s]. The motion takes longer if the
                muscles cannot accelerate the arm enough.
            lag: Lag λ of the muscle modules [s].

        Returns:
            The trajectory, and why it does not end at θ, or ''.

        Raises:
            MessageError: If the motion is refused.
        """
        path = np.vstack(
            [start.theta, holdable_paths.way(self._setup.robot, mae, start.theta, theta)]
        )
        path, problem = self._passable(mae, path, self.takes_nearest)
        planned = self._within_limits(mae, Trajectory.to(start, path[1:], duration))
        return slowed_to_exert(self._setup.robot, mae, planned, lag), problem

    def through(
        self, mae: Mae, start: Setpoint, points: TrajectoryPoints, passed: float, lag: float
    ) -> Trajectory:
        """Plan a motion through points.

        Args:
            mae: The network in use.
            start: Setpoint from which the motion starts.
            points: The points, with times relative to the same time 0.
            passed: Time elapsed since time 0 of the points [s].
            lag: Lag λ of the muscle modules [s].

        Raises:
            MessageError: If the motion is refused.
        """
        points = self._clipped(points)
        planned = self._slowed(mae, Trajectory.through(start, points, passed))
        self.reachable(mae, start.theta, planned.end, nearest=False)
        self._passable(mae, planned.path[1], nearest=False)
        return slowed_to_exert(self._setup.robot, mae, planned, lag)

    def to_rest(self, start: Setpoint) -> Trajectory:
        """Plan to come to rest within `trajectory.STOPPING` seconds from the setpoint `start`."""
        return Trajectory.stopping(start, self._setup.robot)

    def to_pose(
        self, mae: Mae, start: Setpoint, pose: pin.SE3, whole: bool, now: float
    ) -> tuple[Trajectory, str]:
        """Plan to bring the end effector to a pose in the root link's frame.

        Args:
            mae: The network in use.
            start: Setpoint from which the motion starts.
            pose: Target pose of the end effector.
            whole: True to reach position and orientation, False for the position alone.
            now: Time at which the pose was received [s].

        Returns:
            The trajectory, and why it does not end at the pose, or ''.

        Raises:
            MessageError: If the motion is refused.
        """
        theta, problem = self._hand.posture(mae, pose, whole, start.theta, self.takes_nearest)
        straight = np.stack([start.theta, theta])
        path, lack = self._passable(mae, straight, self.takes_nearest)
        problem = '; '.join(filter(None, (problem, lack)))
        towards = self._hand.towards(start, path[-1], now)
        planned = self._within_limits(mae, towards)
        self._last_pose = pose, whole, planned
        return planned, problem and f'{problem}; the arm goes to the nearest posture'

    def is_under_way(self, pose: pin.SE3, whole: bool, followed: Trajectory | None) -> bool:
        """Return whether `followed` was planned for this pose, `whole` or its position only."""
        if self._last_pose is None or followed is None:
            return False
        before, whole_before, trajectory = self._last_pose
        same = whole == whole_before and bool(before.isApprox(pose, SAME))
        return same and trajectory is followed

    def repeat_pose(self, now: float) -> None:
        """Record that the last pose was received again at `now` [s], so that its path continues."""
        self._hand.again(now)

    def by_twist(self, mae: Mae, start: Setpoint, twist: Array) -> Trajectory:
        """Plan to move the end effector for `hand.TWIST_TIMEOUT` seconds.

        Args:
            mae: The network in use.
            start: Setpoint from which the motion starts.
            twist: Linear [m/s] and angular [rad/s] velocity, (6,).
        """
        return self._within_limits(mae, self._hand.moved(mae, start, twist))

    def reachable(self, mae: Mae, start: Array, theta: Array, nearest: bool) -> tuple[Array, str]:
        """Return θ if the muscles can hold it, else the nearest holdable posture.

        The nearest holdable posture is that of `holdable_paths.nearest_held`. If no muscle is
        isolated, θ is returned without a check.

        Args:
            mae: The network in use.
            start: Present posture [rad], (D,).
            theta: Target posture [rad], (D,).
            nearest: Whether to return the nearest holdable posture if θ is not holdable.

        Returns:
            θ and '', or another posture and the reason why θ is not holdable.

        Raises:
            MessageError: If θ is not holdable and `nearest` is false.
        """
        robot = self._setup.robot
        if robot.used.all():
            return theta, ''
        held, problem = holdable_paths.nearest_held(robot, mae, start, theta)
        if not problem:
            return theta, ''
        problem = (
            f'{problem}, {self._because_of_isolation}; nearest holdable posture: '
            f'{robot.posture_text(held)}'
        )
        if not nearest:
            raise MessageError(NOT_HOLDABLE, problem)
        return held, f'{problem}; the arm goes to that posture instead'

    def _passable(self, mae: Mae, path: Array, nearest: bool) -> tuple[Array, str]:
        """Return the part of a path [rad], (K, D), along which the muscles can move the arm.

        Paths of an arm without isolated muscles are not checked.

        Args:
            mae: The network in use.
            path: Postures that straight lines connect.
            nearest: Whether to return a part of the path if the muscles cannot move the arm along
                the rest.

        Returns:
            The path or its first part, and why it is only a part, or ''.

        Raises:
            MessageError: If it is only a part, and `nearest` is false.
        """
        robot = self._setup.robot
        if robot.used.all():
            return path, ''
        part, missing = holdable_paths.passable(robot, mae, path)
        if not missing:
            return path, ''
        problem = f'on the way, the muscles lack {missing}, {self._because_of_isolation}'
        if not nearest:
            remedy = 'choose another target, or call estimator/restore and send this one again'
            raise MessageError(NOT_HOLDABLE, f'{problem}; {remedy}')
        return part, problem

    @property
    def _because_of_isolation(self) -> str:
        robot = self._setup.robot
        verb = 'are' if len(robot.isolated) > 1 else 'is'
        return f'because {robot.names(robot.isolated)} {verb} isolated'

    def _clipped(self, points: TrajectoryPoints) -> TrajectoryPoints:
        """Return the points clipped to the joint limits.

        Raises:
            MessageError: If a point exceeds the joint limits by more than `TOLERANCE`.
        """
        robot = self._setup.robot
        low, high = robot.lower[points.joints], robot.upper[points.joints]
        beyond = (points.position < low - TOLERANCE) | (points.position > high + TOLERANCE)
        if not beyond.any():
            return points._replace(position=np.clip(points.position, low, high))
        k, j = np.argwhere(beyond)[0]
        unit = robot.units[points.joints[j]].position
        values = np.array([points.position[k, j], low[j], high[j]])
        values = robot.units.to_position(values, points.joints[j])
        value, least, most = distinct(*values, digits=4)
        raise MessageError(
            'beyond the joint limits',
            f'{robot.joints[points.joints[j]]} is {value} {unit}; legal: {least} to {most} {unit}',
        )

    def _slowed(self, mae: Mae, planned: Trajectory) -> Trajectory:
        """Return the planned trajectory, slowed to a speed that the muscle modules can follow.

        Raises:
            MessageError: If the slowed trajectory leaves the joint limits. This can happen because
                slowing changes the path of a trajectory that starts in motion.
        """
        slower = planned.scaled(slowness(self._setup.robot, mae, planned, self._setup.settings))
        slower.check(self._setup.robot)
        return slower

    def _within_limits(self, mae: Mae, planned: Trajectory) -> Trajectory:
        """Return the planned trajectory, slowed and within the joint limits.

        If the slowed trajectory would leave the joint limits, the returned trajectory first brings
        the arm to rest and then plans the motion from there.
        """
        try:
            return self._slowed(mae, planned)
        except MessageError:
            return self._slowed(mae, planned.after_rest(self._setup.robot))
