# SPDX-License-Identifier: Apache-2.0
"""The action, with a stand-in of control_msgs and of rclpy's server; actions are served at once."""

import sys
import threading
import time
from contextlib import suppress
from types import ModuleType, SimpleNamespace

import pytest
import rclpy
from builtin_interfaces.msg import Duration
from controlled_arm import ControlledArm
from rclpy.action import CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.guard_condition import GuardCondition
from rclpy.waitable import NumberOfEntities, Waitable
from trajectory_msgs.msg import JointTrajectory

from musculoskeletal_ae.nodes import executor, follow_joint_trajectory

from .test_motion import HERE, THERE, trajectory


class Goal(SimpleNamespace):
    """What a client of control_msgs sends."""

    def __init__(self, message, **given):
        nothing = {'path_tolerance': [], 'goal_tolerance': [], 'goal_time_tolerance': Duration()}
        super().__init__(trajectory=message, **{**nothing, **given})


class Handle:
    """The server's side of a goal, as rclpy has it."""

    def __init__(self):
        self.told, self.status, self.result = [], 'accepted', None
        self.is_cancel_requested = False

    def execute(self):
        self.status = 'executing'

    publish_feedback = property(lambda self: self.told.append)

    def _end(self, status):
        assert self.status == 'executing'
        self.status = status

    def succeed(self):
        self._end('succeeded')

    def abort(self):
        self._end('aborted')

    def canceled(self):
        assert self.is_cancel_requested
        self._end('canceled')


class Server:
    """Keeps the callbacks, which the test calls in the client's place."""

    def __init__(self, _node, _kind, name, _execute, **callbacks):
        self.name, self.callbacks = name, callbacks

    def notify_execute(self, handle, callback):
        if callback is not None:
            handle.result = callback(handle)

    def send(self, goal):
        """Return the handle of a goal, None if it is refused."""
        if self.callbacks['goal_callback'](goal) == GoalResponse.REJECT:
            return None
        handle = Handle()
        self.callbacks['handle_accepted_callback'](handle)
        return handle

    def cancel(self, handle):
        assert self.callbacks['cancel_callback'](handle) == CancelResponse.ACCEPT
        handle.is_cancel_requested = True


@pytest.fixture
def arm(graph, arm26, trained_file, monkeypatch):
    package, module = ModuleType('control_msgs'), ModuleType('control_msgs.action')
    kind = SimpleNamespace(Goal=Goal, Result=SimpleNamespace, Feedback=SimpleNamespace)
    module.FollowJointTrajectory = kind
    monkeypatch.setitem(sys.modules, 'control_msgs', package)
    monkeypatch.setitem(sys.modules, 'control_msgs.action', module)
    monkeypatch.setattr(follow_joint_trajectory, 'LateServer', Server)
    return ControlledArm(graph, arm26, trained_file)


def test_goals_are_followed_replaced_cancelled_aborted_and_refused(arm):
    server = arm.controller.action._server
    assert server.name == 'follow_joint_trajectory'
    first = server.send(Goal(trajectory(arm, HERE)))
    arm.graph.wait(lambda: first.status == 'succeeded', 'the end of the first goal')
    assert first.result.error_code == 0
    assert tuple(first.told[0].joint_names) == arm.robot.joints
    assert first.told[-1].desired.positions.tolist() == pytest.approx(HERE.tolist(), abs=0.02)
    # A new one replaces it.
    second = server.send(Goal(trajectory(arm, THERE, 20)))
    arm.graph.wait(lambda: second.told, 'feedback')
    third = server.send(Goal(trajectory(arm, THERE, 20)))
    assert second.status == 'aborted'
    assert 'replaced' in second.result.error_string
    server.cancel(third)
    arm.graph.wait(lambda: third.status == 'canceled', 'the end of the cancelled goal')
    arm.says('holding')
    # One that cannot be kept to.
    tolerance = SimpleNamespace(name=arm.robot.joints[0], position=1e-6)
    fourth = server.send(Goal(trajectory(arm, THERE), path_tolerance=[tolerance]))
    arm.graph.wait(lambda: fourth.status == 'aborted', 'the end of the goal')
    assert fourth.result.error_code == -4
    arm.says('holding')
    before = arm.controller.core.activities.follower.trajectory
    assert server.send(Goal(trajectory(arm, arm.robot.upper + 0.5))) is None
    assert server.send(Goal(JointTrajectory())) is None
    assert arm.controller.core.activities.follower.trajectory is before
    rejected = arm.controller.rejected
    assert rejected['follow_joint_trajectory: beyond the joint limits'] == 1
    assert rejected['follow_joint_trajectory: empty'] == 1


def test_without_control_msgs_there_is_no_action(graph, arm26, trained_file):
    assert ControlledArm(graph, arm26, trained_file).controller.action is None


class Asked(Waitable):
    """Something that is waited for as an action server is."""

    def __init__(self, node):
        super().__init__(ReentrantCallbackGroup())
        self.guard = GuardCondition(None, None, context=node.context)
        self.served, self.pending = [], False
        self.callback_group.add_entity(self)
        node.add_waitable(self)

    def is_ready(self, _wait_set):
        return self.pending  # as a request, until it is taken

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
    monkeypatch.setattr(executor, 'FULL_ROUND_PERIOD', 600)  # only what is served at once is served
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('asked', context=context)
    asked = Asked(node)
    lean = executor.LeanExecutor(context=context)
    lean.add_node(node)
    spun = threading.Thread(target=lambda: _until_shutdown(lean), daemon=True)
    spun.start()
    end = time.monotonic() + 60.0
    for count in range(1, 4):
        asked.ask()
        while len(asked.served) < count and time.monotonic() < end:
            time.sleep(0.001)
    rclpy.shutdown(context=context)
    spun.join(60.0)
    assert asked.served == ['asked'] * 3


def _until_shutdown(lean):
    with suppress(executor.ExternalShutdownException):
        lean.spin()
