# SPDX-License-Identifier: Apache-2.0
"""The status shows commands that are refused or that a node cannot receive."""

import pytest
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from musculoskeletal_ae import reception
from musculoskeletal_ae.nodes.controller import Controller


@pytest.mark.parametrize(
    ('topic', 'message', 'reason'),
    [
        ('target_joint_states', JointState(name=['elbo'], position=[0.1]), "unknown joint: 'elbo'"),
        (
            'joint_trajectory',
            JointTrajectory(
                joint_names=['elbow'],
                points=[JointTrajectoryPoint(positions=[-99.0], time_from_start=Duration(sec=1))],
            ),
            'no posture yet',
        ),
        ('target_pose', PoseStamped(), "wrong frame: '', expected"),
        ('target_twist', TwistStamped(), "wrong frame: '', expected"),
    ],
)
def test_a_refused_command_is_shown_for_some_seconds_with_its_reason(
    graph, topic, message, reason, monkeypatch
):
    monkeypatch.setattr(reception, 'SHOWN', 3.0)
    graph.host(Controller, robot='arm26')
    graph.listen(DiagnosticArray, '/diagnostics')
    graph.publisher(type(message), topic).publish(message)

    def shown():
        report = graph.report('controller')
        return 'refused' in report.values and report

    report = graph.wait(shown, 'the refusal')
    assert report.level == 'warn'
    assert f'refused {topic}: ' in report.message and reason in report.message
    graph.wait(lambda: not shown(), 'its end')


def test_a_publisher_whose_quality_of_service_does_not_fit_is_reported(graph):
    graph.host(Controller, robot='arm26')
    graph.listen(DiagnosticArray, '/diagnostics')
    unreliable = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    graph.node.create_publisher(JointState, 'target_joint_states', unreliable)
    latching = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    texts = set()

    def shown():
        texts.add(graph.report('controller').message.partition('; refused ')[2])
        return any('publish it reliable' in text for text in texts)

    graph.wait(shown, 'the report')
    graph.listen(Float64MultiArray, 'muscle_length_command', latching)

    def is_shown_too():
        return 'muscle_length_command: incompatible QoS' in graph.report('controller').message

    graph.wait(is_shown_too, 'that of a subscriber')
