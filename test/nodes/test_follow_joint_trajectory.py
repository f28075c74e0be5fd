# SPDX-License-Identifier: Apache-2.0
"""The action `follow_joint_trajectory`, with a client where control_msgs is installed."""

import sys
import threading
import time
from contextlib import suppress

import numpy as np
import pytest
import rclpy
from action_msgs.msg import GoalStatus
from controlled_arm import ControlledArm
from graph import DEADLINE
from rclpy.action import ActionClient
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.guard_condition import GuardCondition
from rclpy.waitable import NumberOfEntities, Waitable
from trajectory_msgs.msg import JointTrajectory

from musculoskeletal_ae.ros import executor

from .test_motion import HERE, THERE, trajectory


class SentGoal:
    """A goal that a client has sent, and the responses to it."""

    def __init__(self, graph, client, goal):
        self._graph = graph
        self.feedback = []
        sent = client.send_goal_async(goal, lambda message: self.feedback.append(message.feedback))
        graph.wait(sent.done, 'an answer to the goal')
        self.handle = sent.result()
        self.is_accepted = self.handle.accepted
        self._ended = self.handle.get_result_async() if self.is_accepted else None

    def cancel(self):
        response = self.handle.cancel_goal_async()
        self._graph.wait(response.done, 'an answer to the cancellation')

    def ended(self):
        """Wait for the end of the goal; return its status and result."""
        self._graph.wait(self._ended.done, 'the end of the goal')
        return self._ended.result().status, self._ended.result().result


@pytest.fixture
def arm(graph, arm26, trained_file):
    return ControlledArm(graph, arm26, trained_file)


def test_goals_are_followed_replaced_cancelled_aborted_and_refused(arm):
    action = pytest.importorskip('control_msgs.action', reason='control_msgs is not installed')
    from control_msgs.msg import JointTolerance

    kind = action.FollowJointTrajectory
    client = ActionClient(arm.graph.node, kind, 'follow_joint_trajectory')
    arm.graph.wait(client.server_is_ready, 'the action')

    def send(message, **tolerances):
        return SentGoal(arm.graph, client, kind.Goal(trajectory=message, **tolerances))

    first = send(trajectory(arm, HERE))
    status, result = first.ended()
    assert (status, result.error_code) == (GoalStatus.STATUS_SUCCEEDED, kind.Result.SUCCESSFUL)
    assert tuple(first.feedback[0].joint_names) == arm.robot.joints
    # Do not expect feedback of the end: rclpy's client drops what arrives after the result.
    desired = np.array([feedback.desired.positions for feedback in first.feedback])
    distance = np.linalg.norm(desired - HERE, axis=1)
    assert (np.diff(distance) <= 0.0).all() and distance[-1] < distance[0]
    # A new goal replaces an active one.
    second = send(trajectory(arm, THERE, 20))
    arm.graph.wait(lambda: second.feedback, 'feedback')
    third = send(trajectory(arm, THERE, 20))
    status, result = second.ended()
    assert status == GoalStatus.STATUS_ABORTED and 'replaced' in result.error_string
    third.cancel()
    assert third.ended()[0] == GoalStatus.STATUS_CANCELED
    arm.says('holding')
    # Send a goal that the arm cannot follow.
    tolerance = JointTolerance(name=arm.robot.joints[0], position=1e-6)
    fourth = send(trajectory(arm, THERE), path_tolerance=[tolerance])
    status, result = fourth.ended()
    assert status == GoalStatus.STATUS_ABORTED
    assert result.error_code == kind.Result.PATH_TOLERANCE_VIOLATED
    arm.says('holding')
    before = arm.controller.core.activities.follower.progress.trajectory
    assert not send(trajectory(arm, arm.robot.upper + 0.5)).is_accepted
    assert not send(JointTrajectory()).is_accepted
    assert arm.controller.core.activities.follower.progress.trajectory is before
    rejected = arm.controller.rejected
    assert rejected['follow_joint_trajectory: beyond the joint limits'] == 1
    assert rejected['follow_joint_trajectory: empty'] == 1
    client.destroy()


def test_without_control_msgs_there_is_no_action(graph, arm26, trained_file, monkeypatch):
    for module in ('control_msgs', 'control_msgs.action'):
        monkeypatch.setitem(sys.modules, module, None)
    assert ControlledArm(graph, arm26, trained_file).controller.action is None


class FakeServer(Waitable):
    """A stand-in for an action server: an executor waits for it, and the test sends requests."""

    def __init__(self, node):
        super().__init__(ReentrantCallbackGroup())
        self.guard = GuardCondition(None, None, context=node.context)
        self.served, self.pending = [], False
        self.callback_group.add_entity(self)
        node.add_waitable(self)

    def is_ready(self, _wait_set):
        return self.pending  # ready until `take_data` takes the request

    def take_data(self):
        self.pending = False
        return 'asked'

    def ask(self):
        self.pending = True
        self.guard.trigger()

    async def execute(self, data):
        self.served.append(data)

    def get_num_entities(self):
        return NumberOfEntities(num_gcs=1)

    def add_to_wait_set(self, wait_set):
        wait_set.add_guard_condition(self.guard.handle)

    def __enter__(self):
        return self.guard.handle.__enter__()

    def __exit__(self, *how):
        self.guard.handle.__exit__(*how)


def test_requests_of_an_action_are_served_at_once(monkeypatch):
    # Between full rounds, the executor serves only urgent entities. Let there be no full round.
    monkeypatch.setattr(executor, 'FULL_ROUND_PERIOD', 600)
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('asked', context=context)
    asked = FakeServer(node)
    lean = executor.LeanExecutor(context=context)
    lean.add_node(node)
    spun = threading.Thread(target=lambda: _until_shutdown(lean), daemon=True)
    spun.start()
    end = time.monotonic() + DEADLINE
    for count in range(1, 4):
        asked.ask()
        while len(asked.served) < count and time.monotonic() < end:
            time.sleep(0.001)
    rclpy.shutdown(context=context)
    spun.join(DEADLINE)
    assert asked.served == ['asked'] * 3


def _until_shutdown(lean):
    with suppress(executor.ExternalShutdownException):
        lean.spin()
