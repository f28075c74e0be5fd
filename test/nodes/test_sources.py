# SPDX-License-Identifier: Apache-2.0
"""Second publishers are detected from the graph, from reports and from stamps."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from controlled_arm import ControlledArm
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, UInt8MultiArray
from std_srvs.srv import Trigger

from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.nodes.controller import ControllerNode
from musculoskeletal_ae.nodes.estimator import EstimatorNode
from musculoskeletal_ae.ros.diagnostics import NODE_SILENCE
from musculoskeletal_ae.ros.latched_values import LatchedPublisher
from musculoskeletal_ae.ros.message_building import LATCHED, array_message, joint_message
from musculoskeletal_ae.ros.second_publishers import (
    LEASE,
    NAMING,
    UNNAMED,
    Authorship,
    Publisher,
    Sources,
    Twins,
    full_name,
)
from musculoskeletal_ae.signals.body_state import Anomaly, BodyState, LengthOffsets

FIRST, SECOND = Publisher('/estimator', b'1'), Publisher('/estimator', b'2')


def looked(publishers, turns=(0,), seconds=(0.0,)):
    authorship = Authorship()
    for count, now in zip(turns, seconds, strict=True):
        authorship.look(publishers, count, now)
    return authorship


def test_another_node_on_a_topic_is_an_intruder_at_once():
    intruders = looked([FIRST, Publisher('/stranger', b'3')]).intruders
    assert intruders == '/estimator and /stranger'


def test_a_killed_node_beside_its_successor_is_no_intruder():
    seconds = np.arange(0.0, 20.0, 0.1)
    assert looked([FIRST, SECOND], np.ones_like(seconds), seconds).intruders == ''


def test_two_nodes_of_one_name_are_intruders_once_they_take_turns_or_outlast_the_lease():
    taking_turns = looked([FIRST, SECOND], range(5), np.arange(5) * 0.1)
    assert taking_turns.intruders == '2 nodes /estimator'
    assert looked([FIRST, SECOND], (0, 0), (0.0, LEASE)).intruders


def test_a_publisher_without_a_name_is_waited_for_and_then_an_intruder():
    unnamed = [FIRST, Publisher(full_name('_NODE_NAMESPACE_UNKNOWN_', UNNAMED), b'3')]
    early = looked(unnamed)
    assert (early.intruders, early.is_certain) == ('', False)
    late = looked(unnamed, (0, 0), (0.0, NAMING)).intruders
    assert late == '/estimator and a node that has not announced its name yet'


def test_a_latched_value_is_requested_again_once_its_topic_has_one_publisher():
    own = SimpleNamespace(node_namespace='/', node_name='estimator', endpoint_gid=b'1')
    other = SimpleNamespace(node_namespace='/', node_name='stranger', endpoint_gid=b'2')
    present, renewed = [own, other], []
    node = SimpleNamespace(
        count_publishers=lambda _: len(present),
        get_publishers_info_by_topic=lambda _: present,
    )
    sources = Sources(node, resolve=str, turns=lambda _: 0, renew=renewed.append)
    sources.watch('body_state')
    with pytest.raises(MessageError, match='several publishers'):
        sources.check('body_state', is_latched=True)
    sources.look()
    assert renewed == []
    present.remove(other)
    for _ in range(2):
        sources.look()
    assert renewed == ['body_state']


def report(node, identity):
    values = [KeyValue(key='identity', value=identity)]
    status = DiagnosticStatus(name=f'{node}: state', values=values)
    return serialize_message(DiagnosticArray(status=[status]))


def test_a_second_node_of_the_same_name_is_noticed_by_its_reports():
    twins = Twins('/controller: state', 'ours')
    twins.take(report('/controller', 'ours'), 0.1)
    twins.take(report('/left/controller', 'of another arm'), 0.2)
    assert twins.is_alone(0.2)
    twins.take(report('/controller', 'theirs'), 0.3)
    assert not twins.is_alone(0.3)
    assert twins.is_alone(0.4 + NODE_SILENCE)


def test_only_once_it_has_met_a_node_of_its_name_a_node_reads_the_reports_of_others(graph):
    node = graph.host(EstimatorNode, robot='arm26')

    def reads_reports():
        topics = node.get_subscriber_names_and_types_by_node('estimator', graph.namespace)
        return '/diagnostics' in dict(topics)

    graph.spin(2.5)
    assert not reads_reports() and not node.intruders
    twin = graph.host(EstimatorNode, robot='arm26')
    graph.wait(lambda: 'two nodes are named' in node.intruders, 'the second node to be noticed')
    graph.end(twin)
    graph.wait(lambda: not node.intruders, 'the end of the second node')


def test_a_repeated_estimate_grows_old(graph, arm26, trained_file):
    controller = graph.host(ControllerNode, robot='arm26', checkpoint=trained_file)
    joints = graph.publisher(JointState, 'estimated_joint_states')
    repeated = joint_message(arm26.joints, np.zeros(2), graph.node.get_clock().now().to_msg())

    def is_stale():
        joints.publish(repeated)
        present = controller.core.watchdog.conditions(controller.core.watchdog.steps.stepped_at)
        return controller.core.estimate is not None and any(
            condition.identifier == 'stale_estimate' for condition in present
        )

    graph.wait(is_stale, 'the data to become stale')


def strange_body(count):
    """Return a body state in which everything is wrong: offsets, isolated muscles and anomaly."""
    offsets = LengthOffsets.of(np.full(count, 0.08), np.full(count, 1e-3))
    body = BodyState(offsets, (1, 2), Anomaly.VERIFYING, 1, generation=99)
    return array_message(body.rows, 'quantity', 'muscle')


def endpoints(node, topic):
    """Return the identities of all subscriptions of a topic."""
    full = node.resolve_topic_name(topic)
    return {bytes(each.endpoint_gid) for each in node.get_subscriptions_info_by_topic(full)}


STRANGE = {
    'body_state': (Float64MultiArray, lambda robot: strange_body(robot.muscle_count)),
    'accepted_checkpoint': (UInt8MultiArray, lambda _: UInt8MultiArray(data=b'not a network')),
}


def test_messages_in_the_name_of_the_estimator_stop_the_arm_and_change_nothing(
    graph, arm26, trained_file
):
    arm = ControlledArm(graph, arm26, trained_file)
    core = arm.controller.core
    arm.target([-0.5, -1.2])
    graph.wait(lambda: arm.count() > 30, 'commands')
    before, network = core.stream.body, core.mae
    subscriptions = {topic: endpoints(graph.node, topic) for topic in STRANGE}
    for topic, (kind, message) in STRANGE.items():
        stranger = graph.publisher(kind, topic, LATCHED)
        stranger.publish(message(arm26))
        graph.wait(lambda topic=topic: topic in core.watchdog.second_publisher, topic)
        rejected = f'{topic}: several publishers'
        graph.wait(lambda key=rejected: arm.controller.rejected[key], rejected)
        arm.says('another node publishes')
        assert not graph.call(Trigger, 'controller/reset').success
        arm.says('another node publishes', 'estimator')
        graph.node.destroy_publisher(stranger)
        graph.wait(lambda: graph.call(Trigger, 'controller/reset').success, 'the reset')
        # The reset succeeds only after the controller has received the estimator's own value again.
        assert core.stream.body.isolated == before.isolated == ()
        assert core.stream.body.offsets.known and not core.stream.body.offsets.offset.any()
        assert core.mae is network or core.mae.version == network.version
        assert not core.stream.body.has_anomaly
        # Fast DDS may crash if a subscription is destroyed while other publishers come and go.
        assert endpoints(graph.node, topic) == subscriptions[topic]
    arm.goes_to([-0.5, -1.2])
    arm.never_jumped()


def test_a_value_published_beside_a_second_node_is_used_once_that_node_has_ended(graph, arm26):
    healthy = BodyState.healthy(arm26.muscle_count)
    author = Node('author', context=graph.context, namespace=graph.namespace)
    graph.executor.add_node(author)
    values = LatchedPublisher(author, Float64MultiArray, 'body_state')

    def publish(generation, isolated=()):
        body = replace(healthy.with_isolated(isolated), generation=generation)
        values.publish(array_message(body.rows, 'quantity', 'muscle'))

    controller = graph.host(ControllerNode, robot='arm26')
    publish(1)
    graph.wait(lambda: controller.body.generation == 1, 'the first value')
    stranger = graph.publisher(Float64MultiArray, 'body_state', LATCHED)
    stranger.publish(strange_body(arm26.muscle_count))
    graph.wait(lambda: controller.intruders, 'the second node to be noticed')
    rejected = 'body_state: several publishers'
    before = controller.rejected[rejected]
    publish(2, [1])
    graph.wait(lambda: controller.rejected[rejected] > before, 'the rejection')
    assert controller.body.isolated == ()
    graph.node.destroy_publisher(stranger)
    graph.wait(lambda: controller.body.generation == 2, 'the value to be published again')
    assert controller.body.isolated == (1,)
    graph.executor.remove_node(author)
    author.destroy_node()


def test_a_second_clock_stops_the_nodes_that_use_it(graph):
    follower = graph.host(ControllerNode, robot='arm26', use_sim_time=True)
    other = graph.host(EstimatorNode, robot='arm26')
    stranger = Node('stranger', context=graph.context, namespace=graph.namespace)
    for node in (graph.node, stranger):
        node.create_publisher(Clock, '/clock', 10)
    nodes = ' and '.join(f'{graph.namespace}/{name}' for name in ('stranger', 'test'))
    stopped = f'/clock come from {nodes}'
    graph.wait(lambda: stopped in follower.core.watchdog.second_publisher, 'the second clock')
    assert other.intruders == ''
    stranger.destroy_node()
    graph.wait(lambda: not follower.intruders, 'the end of the second clock')


@pytest.mark.parametrize(
    'denial', [Anomaly.NONE, pytest.param(Anomaly.ENDED, marks=pytest.mark.thorough)]
)
def test_another_node_cannot_end_an_anomaly(graph, arm26, trained_file, denial):
    arm = ControlledArm(graph, arm26, trained_file)
    core, name = arm.controller.core, arm26.muscles[3]
    arm.target([-0.5, -1.2])
    graph.wait(lambda: arm.count() > 30, 'commands')
    assert graph.set_parameter('hardware_emulator', 'faults', [f'rupture:{name}'])[0]
    graph.wait(lambda: core.stream.body.has_anomaly, 'the anomaly')
    body = replace(core.stream.body.with_anomaly(denial, 3), isolated=(), generation=2**52)
    stranger = graph.publisher(Float64MultiArray, 'body_state', LATCHED)
    stranger.publish(array_message(body.rows, 'quantity', 'muscle'))
    rejected = 'body_state: several publishers'
    graph.wait(lambda: arm.controller.rejected[rejected], 'the rejection')
    assert core.stream.body.has_anomaly and core.supervisor.is_latched
    graph.node.destroy_publisher(stranger)
    graph.spin(0.5)
    assert core.stream.body.has_anomaly
    assert not graph.call(Trigger, 'controller/reset').success


def test_without_an_estimator_no_body_state_ends_a_stop_by_itself(graph, arm26, trained_file):
    arm = ControlledArm(graph, arm26, trained_file)
    core, name = arm.controller.core, arm26.muscles[3]
    arm.target([-0.5, -1.2])
    graph.wait(lambda: arm.count() > 30, 'commands')
    assert graph.set_parameter('estimator', 'on_anomaly', 'isolate')[0]
    assert graph.set_parameter('hardware_emulator', 'faults', [f'rupture:{name}'])[0]
    graph.wait(lambda: arm.state().values['mode'] == 'verifying', 'the verification')
    assert graph.set_parameter('controller', 'max_age', 0.5)[0]
    graph.end(arm.estimator)
    graph.tell_body(replace(BodyState.healthy(6), generation=2**52))
    graph.wait(lambda: not core.stream.body.has_anomaly, 'the false body state')
    graph.spin(1.0)
    assert core.supervisor.is_latched
    assert not graph.call(Trigger, 'controller/reset').success
