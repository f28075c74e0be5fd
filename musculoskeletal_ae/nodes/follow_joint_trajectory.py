# SPDX-License-Identifier: Apache-2.0
"""The action `follow_joint_trajectory` of the controller, where control_msgs is installed."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse

from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.followed_goal import (
    INVALID,
    SUCCESSFUL,
    FollowedGoal,
    read_tolerances,
)
from musculoskeletal_ae.exceptions import MessageError

NAME = 'follow_joint_trajectory'


class LateServer(ActionServer):
    """An action server whose goals are active without a running callback.

    rclpy's server runs `execute_callback` from the start of a goal to its end, which occupies the
    executor. This server runs nothing when a goal starts. To end the goal, its owner later calls
    `notify_execute` with a callback.
    """

    def notify_execute(self, goal_handle: Any, execute_callback: Any) -> None:
        """Run `execute_callback` to end a goal; if it is None, only start the goal."""
        if execute_callback is not None:
            super().notify_execute(goal_handle, execute_callback)


class FollowJointTrajectory:
    """Serves one goal at a time; a new goal replaces the active one."""

    def __init__(
        self,
        node: Any,
        kind: Any,
        core: Controller,
        start: Callable[[Any], None],
        refuse: Callable[[str, str, str], object],
    ) -> None:
        """Offer the action.

        Args:
            node: The controller's node.
            kind: Action type.
            core: The controller.
            start: Starts a JointTrajectory, or raises a MessageError.
            refuse: Counts a refused goal; called with the action's name, the reason and the text of
                the error.
        """
        self._kind, self._core, self._start, self._refuse = kind, core, start, refuse
        self._joints, self._units = node.robot.joints, node.robot.units
        self._requested: FollowedGoal | None = None  # the goal that is being accepted
        self._goal: FollowedGoal | None = None
        self._handle: Any = None
        self._server = LateServer(
            node, kind, NAME, lambda _: kind.Result(), goal_callback=self._ask,
            handle_accepted_callback=self._on_accepted, cancel_callback=self._cancel,
        )  # fmt: skip

    def _ask(self, goal: Any) -> GoalResponse:
        try:
            bounds = [
                read_tolerances(tolerances, self._units)
                for tolerances in (goal.path_tolerance, goal.goal_tolerance)
            ]
            if not goal.trajectory.points:
                raise MessageError('empty', 'a goal needs at least one point')
            self._start(goal.trajectory)
        except MessageError as error:
            self._refuse(NAME, error.reason, str(error))
            return GoalResponse.REJECT
        patience = goal.goal_time_tolerance
        late = patience.sec + 1e-9 * patience.nanosec
        self._requested = FollowedGoal(self._core, self._joints, bounds[0], bounds[1], late)
        return GoalResponse.ACCEPT

    def _on_accepted(self, handle: Any) -> None:
        self._end(INVALID, 'replaced by a new goal')
        self._handle, self._goal = handle, self._requested
        handle.execute()

    def _cancel(self, handle: Any) -> CancelResponse:
        if handle is self._handle:  # not a goal that another one has just replaced
            self._rest()
        return CancelResponse.ACCEPT

    def _rest(self) -> None:
        with suppress(MessageError):  # raised if the controller has already stopped
            self._core.trajectory(None)

    def step(self, get_state: Callable[[], Any], time: float) -> None:
        """Publish feedback on the active goal, and end the goal when it has an outcome.

        Args:
            get_state: Returns the controller's state as a message of `controller_state`.
            time: Time of the ROS clock [s].
        """
        if self._handle is None or self._goal is None:
            return
        if self._handle.is_cancel_requested:
            self._end(SUCCESSFUL, 'cancelled: the arm comes to rest')
            return
        if self._core.is_following:
            state = get_state()
            desired, actual, error = state.points
            names = {'header': state.header, 'joint_names': state.joint_names}
            feedback = self._kind.Feedback(**names, desired=desired, actual=actual, error=error)
            self._handle.publish_feedback(feedback)
        if outcome := self._goal.outcome(time):
            if outcome[0] not in (SUCCESSFUL, INVALID):
                self._rest()
            self._end(*outcome)

    def _end(self, code: int, text: str) -> None:
        handle, self._handle = self._handle, None
        if handle is None:
            return

        def finish(_: Any) -> Any:
            if handle.is_cancel_requested:
                handle.canceled()
            elif code == SUCCESSFUL:
                handle.succeed()
            else:
                handle.abort()
            return self._kind.Result(error_code=code, error_string=text)

        self._server.notify_execute(handle, finish)
