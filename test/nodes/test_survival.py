# SPDX-License-Identifier: Apache-2.0
"""No request or message ends a node, and every request gets a response."""

import math

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger
from type_description_interfaces.srv import GetTypeDescription

from musculoskeletal_ae.conditions import CONDITIONS
from musculoskeletal_ae.exceptions import MessageError, MusculoskeletalError
from musculoskeletal_ae.nodes.bringup_status import BringupStatusNode
from musculoskeletal_ae.nodes.controller import ControllerNode
from musculoskeletal_ae.nodes.declared_parameters import PARAMETERS
from musculoskeletal_ae.nodes.estimator import EstimatorNode
from musculoskeletal_ae.nodes.hardware_emulator import HardwareEmulatorNode
from musculoskeletal_ae.nodes.learner import LearnerNode
from musculoskeletal_ae.nodes.sim import SimNode

#: services of each node, besides those of rclpy
NODES = {
    HardwareEmulatorNode: ['hardware_emulator/reset'],
    EstimatorNode: ['estimator/reset'],
    ControllerNode: ['controller/stop', 'controller/reset'],
    SimNode: [],
    LearnerNode: ['learner/save'],
    BringupStatusNode: [],
}
NAMES = ['', ' ', '.', '/', 'ö' * 300, '\x1b[2J', 'a\nb', '*' * 3000]
TYPES = [*range(11), 99, 255]
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def strange_values():
    for kind in TYPES:
        yield ParameterValue(type=kind)
    for number in (0.0, -1.0, 1e308, -1e308, math.inf, math.nan):
        yield ParameterValue(type=3, double_value=number)
        yield ParameterValue(type=8, double_array_value=[number] * 3)
    for number in (-5, 2**63 - 1, -(2**63)):
        yield ParameterValue(type=2, integer_value=number)
        yield ParameterValue(type=7, integer_array_value=[number] * 3)
    for text in NAMES:
        yield ParameterValue(type=4, string_value=text)
        yield ParameterValue(type=9, string_array_value=[text, text])


def states(graph, node):
    return [
        status
        for message in graph.received['/diagnostics']
        for status in message.status
        if status.name.startswith(f'{graph.namespace}/{node}:')
    ]


class Caller:
    """Calls services of a node; keeps the clients, because a new one takes a while to connect."""

    def __init__(self, graph, node):
        self.graph, self.node = graph, node
        self.clients = {}

    def __call__(self, kind, service, **request):
        if kind not in self.clients:
            name = f'{self.node}/{service}'
            self.clients[kind] = self.graph.node.create_client(kind, name)
        return self.graph.ask(self.clients[kind], kind.Request(**request))


@pytest.mark.parametrize('kind', NODES)
def test_no_request_or_clock_ends_a_node(graph, kind):
    graph.listen(DiagnosticArray, '/diagnostics', 100)
    own = {'state_directory': ''} if kind is LearnerNode else {}
    hosted = graph.host(kind, robot='arm26', use_sim_time=True, **own)
    # `running` lowers the priority of nodes on which no command depends.
    assert hosted.is_time_critical is (kind not in (LearnerNode, SimNode))
    node = hosted.get_name()
    call = Caller(graph, node)
    names = [*PARAMETERS[node], 'use_sim_time', 'start_type_description_service', *NAMES]
    lists = [[], names, names[:1] * 3, *([name] for name in NAMES)]
    for value in strange_values():
        # Set all parameters to this strange value: first independently, then all or none.
        parameters = [Parameter(name=name, value=value) for name in names]
        results = call(SetParameters, 'set_parameters', parameters=parameters).results
        assert len(results) == len(parameters)
        if value.type in (99, 255):
            assert not any(result.successful for result in results)
        call(SetParametersAtomically, 'set_parameters_atomically', parameters=parameters)
    for asked in lists:
        call(DescribeParameters, 'describe_parameters', names=asked)
        call(GetParameters, 'get_parameters', names=asked)
        call(GetParameterTypes, 'get_parameter_types', names=asked)
    for depth in (0, 1, 2**64 - 1):
        call(ListParameters, 'list_parameters', prefixes=NAMES, depth=depth)
    for text in NAMES:
        call(GetTypeDescription, 'get_type_description', type_name=text, type_hash=text)
    for service in NODES[kind]:
        assert graph.call(Trigger, service).message.isprintable()
    if kind in (ControllerNode, LearnerNode):
        name = {ControllerNode: 'controller/explore', LearnerNode: 'learner/enable'}[kind]
        for data in (True, False):
            graph.call(SetBool, name, SetBool.Request(data=data))
    graph.set_parameter(node, 'use_sim_time', True)
    clock = graph.node.create_publisher(Clock, '/clock', BEST_EFFORT)
    graph.wait(clock.get_subscription_count, 'the clock to be heard')
    for seconds in (-1, 5, -(2**31), 2**31 - 1, 0, 7):
        message = Clock()
        message.clock.sec, message.clock.nanosec = seconds, 2**32 - 1
        clock.publish(message)
        graph.spin(0.02)
    assert graph.set_parameter(node, 'use_sim_time', False)[0]
    before = len(states(graph, node))
    graph.wait(lambda: len(states(graph, node)) > before + 1, 'the next reports of the node')
    values = {value.key: value.value for value in states(graph, node)[-1].values}
    counted = [key for key in values if 'ValueError' in key]
    assert any('set_parameters' in key for key in counted), values
    assert any('/clock' in key for key in counted), values
    assert all(value.isprintable() for value in values.values())


SHOUTED = r'[{"identifier": "a", "level": "error", "text": "\u001b[2J\u009b1m"}]'


def test_escape_sequences_in_messages_do_not_reach_the_terminal(graph, capsys):
    status = graph.host(BringupStatusNode, robot='arm26')
    shouting = [
        DiagnosticStatus(
            name=f'{graph.namespace}/{name}: state',
            values=[
                KeyValue(key='samples', value='\x1b]0;owned\x07'),
                KeyValue(key='mode', value='stopped'),
                KeyValue(key=CONDITIONS, value=SHOUTED),
            ],
        )
        for name in ('controller', 'learner')
    ]
    publisher = graph.publisher(DiagnosticArray, '/diagnostics')
    publisher.publish(DiagnosticArray(status=shouting))
    graph.wait(lambda: status.situation.has_learner, 'the message')
    status.anomalies.append(0.0)
    status.started = 1.0  # so long ago that the status line no longer waits for the nodes
    status._print()
    printed = capsys.readouterr().out
    assert 'ERROR: controller' in printed and all(
        line.isprintable() for line in printed.splitlines()
    )
    assert str(MessageError('wrong', '\x1b[2J\ud800')).isprintable()
    with pytest.raises(MusculoskeletalError) as refusal:
        graph.host(ControllerNode, robot='arm26\x1b[2J')
    assert str(refusal.value).isprintable()


def test_the_status_line_waits_for_a_slow_start_for_a_limited_time(graph):
    status = graph.host(BringupStatusNode, robot='arm26', duration=1e6, patience=0.01)
    status.anomalies.append(0.0)
    status._print()  # `patience` is over, but the system has come up: the status is printed
    status.begun -= 1e3
    status._print()
    status.started = None
    with pytest.raises(SystemExit, match='did not come up'):
        status._print()
