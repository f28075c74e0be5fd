# SPDX-License-Identifier: Apache-2.0
"""The action `follow_joint_trajectory` of the controller, where control_msgs is installed."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse

from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.goal import INVALID, SUCCESSFUL, FollowedGoal, read_tolerances
from musculoskeletal_ae.exceptions import MessageError

NAME = 'follow_joint_trajectory'


class LateServer(ActionServer):
    """Whose goals end when they are told to, without a task that waits meanwhile."""

    def notify_execute(self, goal_handle: Any, execute_callback: Any) -> None:
        """Let a goal begin without doing anything; with a callback, end it as that says."""
        if execute_callback is not None:
            super().notify_execute(goal_handle, execute_callback)


class FollowJointTrajectory:
    """Serves one goal at a time: a new one replaces it."""

    def __init__(
        self,
        node: Any,
        kind: Any,
        core: Controller,
        start: Callable[[Any], None],
        refuse: Callable[[str, str, str], object],
    ) -> None:
        """Offer the action `kind`; `start` takes a JointTrajectory or raises a MessageError."""
        self._kind, self._core, self._start, self._refuse = kind, core, start, refuse
        self._joints = node.robot.joints
        self._asked: FollowedGoal | None = None  # of the goal that is just being accepted
        self._goal: FollowedGoal | None = None
        self._handle: Any = None
        self._server = LateServer(
            node, kind, NAME, lambda _: kind.Result(), goal_callback=self._ask,
            handle_accepted_callback=self._accepted, cancel_callback=self._cancel,
        )  # fmt: skip

    def _ask(self, goal: Any) -> GoalResponse:
        try:
            bounds = [
                read_tolerances(given, self._joints)
                for given in (goal.path_tolerance, goal.goal_tolerance)
            ]
            if not goal.trajectory.points:
                raise MessageError('empty', 'a goal has points')
            self._start(goal.trajectory)
        except MessageError as error:
            self._refuse(NAME, error.reason, str(error))
            return GoalResponse.REJECT
        patience = goal.goal_time_tolerance
        late = patience.sec + 1e-9 * patience.nanosec
        self._asked = FollowedGoal(self._core, self._joints, bounds[0], bounds[1], late)
        return GoalResponse.ACCEPT

    def _accepted(self, handle: Any) -> None:
        self._end(INVALID, 'replaced by a new goal')
        self._handle, self._goal = handle, self._asked
        handle.execute()

    def _cancel(self, _: Any) -> CancelResponse:
        self._rest()
        return CancelResponse.ACCEPT

    def _rest(self) -> None:
        with suppress(MessageError):  # stopped already
            self._core.trajectory(None)

    def step(self, say: Callable[[], Any]) -> None:
        """Tell of the goal, if there is one, what `say` returns for `controller_state`; end it."""
        if self._handle is None or self._goal is None:
            return
        if self._handle.is_cancel_requested:
            self._end(SUCCESSFUL, 'cancelled: comes to rest')
            return
        state = say()
        desired, actual, error = state.points
        names = {'header': state.header, 'joint_names': state.joint_names}
        feedback = self._kind.Feedback(**names, desired=desired, actual=actual, error=error)
        self._handle.publish_feedback(feedback)
        if outcome := self._goal.outcome():
            if outcome[0] not in (SUCCESSFUL, INVALID):
                self._rest()
            self._end(*outcome)

    def _end(self, code: int, told: str) -> None:
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
            return self._kind.Result(error_code=code, error_string=told)

        self._server.notify_execute(handle, finish)
