# SPDX-License-Identifier: Apache-2.0
"""The status shows commands that are refused or that a node cannot receive."""

from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from musculoskeletal_ae.messages import reception
from musculoskeletal_ae.nodes.controller import ControllerNode


def test_a_refused_command_is_shown_for_some_seconds_with_its_reason(graph, monkeypatch):
    monkeypatch.setattr(reception, 'SHOWN', 3.0)
    graph.host(ControllerNode, robot='arm26')
    graph.listen(DiagnosticArray, '/diagnostics')
    beyond = JointTrajectoryPoint(positions=[-99.0], time_from_start=Duration(sec=1))
    unknown = JointState(name=['elbo'], position=[0.1])
    for topic, message, reason in (
        ('target_joint_states', unknown, "unknown joint: 'elbo'"),
        ('joint_trajectory', JointTrajectory(joint_names=['elbow'], points=[beyond]), 'no posture'),
        ('target_pose', PoseStamped(), "wrong frame: ''; expected"),
        ('target_twist', TwistStamped(), "wrong frame: ''; expected"),
    ):
        graph.publisher(type(message), topic).publish(message)
        texts = f'refused: {topic}: ', reason

        def shown(texts=texts):
            report = graph.report('controller')
            return report if all(text in report.message for text in texts) else None

        assert graph.wait(shown, f'the refusal of {topic}').level == 'warn'
    graph.wait(
        lambda: 'request_refused' not in graph.report('controller').identifiers,
        'the end of the report',
    )


def test_a_publisher_whose_quality_of_service_does_not_fit_is_reported(graph):
    graph.host(ControllerNode, robot='arm26')
    graph.listen(DiagnosticArray, '/diagnostics')
    unreliable = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    graph.node.create_publisher(JointState, 'target_joint_states', unreliable)
    latching = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    texts = set()

    def shown():
        texts.add(graph.report('controller').message)
        return any('publish it reliable' in text for text in texts)

    graph.wait(shown, 'the report of an unreliable publisher')
    graph.listen(Float64MultiArray, 'muscle_length_command', latching)

    def is_shown_too():
        return 'muscle_length_command: incompatible QoS' in graph.report('controller').message

    graph.wait(is_shown_too, 'the report of an incompatible subscriber')
