# SPDX-License-Identifier: Apache-2.0
"""Monitors the goal of a FollowJointTrajectory action, as joint_trajectory_controller does."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.supervisor import Activity
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.robot.joint_units import JointUnits

# Error codes that control_msgs/action/FollowJointTrajectory defines for its result.
SUCCESSFUL, INVALID, BEYOND_PATH, BEYOND_GOAL = 0, -1, -4, -5


def read_tolerances(tolerances: Iterable[Any], units: JointUnits) -> Array:
    """Return the position tolerance [rad] of each joint, (D,), from control_msgs/JointTolerance.

    A position of 0 (the default) or a negative position means that the joint has no tolerance.
    Tolerances of velocity and acceleration are ignored, because neither is estimated.

    Raises:
        MessageError: If a joint is unknown or a tolerance is not finite.
    """
    joints, bounds = units.names, np.full(len(units), np.inf)
    for one in tolerances:
        if one.name not in joints:
            raise MessageError('unknown joint', f'{one.name!r}; legal: {", ".join(joints)}')
        if not np.isfinite(one.position):
            detail = f'the tolerance of {one.name} is {one.position}; expected a finite number'
            raise MessageError('not finite', detail)
        if one.position > 0.0:
            bounds[joints.index(one.name)] = one.position
    return units.to_theta(bounds)


class FollowedGoal:
    """Monitors how the controller follows the trajectory that is the goal of an action."""

    def __init__(
        self, core: Controller, joints: Sequence[str], path: Array, goal: Array, patience: float
    ) -> None:
        """Begin to monitor the trajectory that the controller has just accepted.

        Args:
            core: The controller that follows the trajectory.
            joints: Names of all joints, for messages.
            path: Tolerances along the trajectory [rad], (D,).
            goal: Tolerances at the end of the trajectory [rad], (D,).
            patience: Longest time after the end of the trajectory until the tolerances `goal` are
                met [s]; 0 for no limit.
        """
        trajectory = core.activities.follower.progress.latest
        assert trajectory is not None
        self._core, self._trajectory = core, trajectory
        self._joints, self._path, self._goal, self._patience = joints, path, goal, patience
        #: time at which the end of the trajectory was noticed [s]; None before its end
        self._ended_at: float | None = None

    def outcome(self, time: float) -> tuple[int, str] | None:
        """Return an error code (0 for success) and its reason, or None while the goal is active.

        Args:
            time: Time of the messages' clock [s].
        """
        core, trajectory = self._core, self._trajectory
        progress, condition = core.activities.follower.progress, core.supervisor.condition
        if condition is not None:
            return INVALID, f'stopped: {condition.text}'
        holds, target = core.supervisor.activity is Activity.HOLDING, core.target_state.theta
        is_target = target is not None and np.array_equal(target, trajectory.end)
        if progress.latest is trajectory:
            if progress.trajectory is not trajectory:
                return None  # the trajectory has not started yet
            off = np.abs(progress.error)
            if progress.time < trajectory.duration:
                return self._beyond(BEYOND_PATH, off, self._path)
        elif progress.latest is not None or (holds and not is_target):
            return INVALID, 'the trajectory was replaced by another target'
        elif not holds or self._ended_at is None:
            mode = core.supervisor.mode
            return INVALID, f'the trajectory ended, because the mode changed to {mode}'
        elif core.estimate is None:
            return None
        else:  # a method such as `tension` holds the end without the follower
            off = np.abs(trajectory.end - core.estimate)
        # After a backward jump of the clock, measure the time since the end anew.
        self._ended_at = time if self._ended_at is None else min(self._ended_at, time)
        if missed := self._beyond(BEYOND_GOAL, off, self._goal):
            return missed if 0.0 < self._patience < time - self._ended_at else None
        return SUCCESSFUL, ''

    def _beyond(self, code: int, off: Array, bounds: Array) -> tuple[int, str] | None:
        m = int((off - bounds).argmax())
        if off[m] <= bounds[m]:
            return None
        unit = self._core.robot.units[m]
        error, legal = unit.position_text(off[m], '.3f'), unit.position_text(bounds[m], '.3g')
        error = f'deviates by {error}; its tolerance is {legal}'
        return code, f'{self._joints[m]} {error}'
