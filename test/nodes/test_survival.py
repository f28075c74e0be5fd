# SPDX-License-Identifier: Apache-2.0
"""No request or message ends a node, and every request gets a response."""

import math
import os
import signal

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

from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.nodes.bringup_status import BringupStatus
from musculoskeletal_ae.nodes.parameters import PARAMETERS
from musculoskeletal_ae.nodes.running import NICENESS

NODES = {
    'hardware_emulator': ['hardware_emulator/reset'],
    'estimator': ['estimator/reset'],
    'controller': ['controller/stop', 'controller/reset'],
    'sim': [],
    'learner': ['learner/save'],
    'bringup_status': [],
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


@pytest.fixture(params=NODES)
def node(request, graph):
    graph.listen(DiagnosticArray, '/diagnostics', 100)
    own = {'state_directory': ''} if request.param == 'learner' else {}
    graph.start(request.param, robot='arm26', use_sim_time=True, **own)
    graph.wait(lambda: states(graph, request.param), 'the first report of the node')
    return request.param


def test_no_request_or_clock_ends_a_node(graph, node):
    names = [*PARAMETERS[node], 'use_sim_time', 'start_type_description_service', *NAMES]
    lists = [[], names, names[:1] * 3, *([name] for name in NAMES)]
    for value in strange_values():
        # Set all parameters to this strange value: first independently, then all or none.
        parameters = [Parameter(name=name, value=value) for name in names]
        results = graph.call(
            SetParameters, f'{node}/set_parameters', SetParameters.Request(parameters=parameters)
        ).results
        assert len(results) == len(parameters)
        if value.type in (99, 255):
            assert not any(result.successful for result in results)
        graph.call(
            SetParametersAtomically,
            f'{node}/set_parameters_atomically',
            SetParametersAtomically.Request(parameters=parameters),
        )
    for kind, service in (
        (DescribeParameters, 'describe_parameters'),
        (GetParameters, 'get_parameters'),
        (GetParameterTypes, 'get_parameter_types'),
    ):
        for asked in lists:
            graph.call(kind, f'{node}/{service}', kind.Request(names=asked))
    for depth in (0, 1, 2**64 - 1):
        request = ListParameters.Request(prefixes=NAMES, depth=depth)
        graph.call(ListParameters, f'{node}/list_parameters', request)
    for text in NAMES:
        request = GetTypeDescription.Request(type_name=text, type_hash=text)
        graph.call(GetTypeDescription, f'{node}/get_type_description', request)
    for service in NODES[node]:
        assert graph.call(Trigger, service).message.isprintable()
    if node in ('controller', 'learner'):
        name = {'controller': 'controller/explore', 'learner': 'learner/enable'}[node]
        for data in (True, False):
            graph.call(SetBool, name, SetBool.Request(data=data))
    graph.set_parameter(node, 'use_sim_time', True)
    clock = graph.node.create_publisher(Clock, '/clock', BEST_EFFORT)
    graph.wait(clock.get_subscription_count, 'the clock to be heard')
    for seconds in (-1, 5, -(2**31), 2**31 - 1, 0, 7):
        message = Clock()
        message.clock.sec, message.clock.nanosec = seconds, 2**32 - 1
        clock.publish(message)
        graph.spin(0.1)
    assert graph.set_parameter(node, 'use_sim_time', False)[0]
    before = len(states(graph, node))
    graph.wait(lambda: len(states(graph, node)) > before + 1, 'the next reports of the node')
    process, own = graph.processes[-1].process.pid, os.nice(0)
    second = node in ('learner', 'sim')  # low priority, because commands do not depend on them
    assert os.getpriority(os.PRIO_PROCESS, process) == (max(own, NICENESS) if second else own)
    values = {value.key: value.value for value in states(graph, node)[-1].values}
    counted = [key for key in values if 'ValueError' in key]
    assert any('set_parameters' in key for key in counted), values
    assert any('/clock' in key for key in counted), values
    assert all(value.isprintable() for value in values.values())


def test_escape_sequences_in_messages_do_not_reach_the_terminal(graph, capsys):
    status = graph.host(BringupStatus, robot='arm26')
    shouting = [
        DiagnosticStatus(
            name=f'{graph.namespace}/{name}: state',
            values=[
                KeyValue(key='samples', value='\x1b]0;owned\x07'),
                KeyValue(key='mode', value='stopped'),
                KeyValue(key='stop', value='\x1b[2J\x9b1m'),
            ],
        )
        for name in ('controller', 'learner')
    ]
    publisher = graph.publisher(DiagnosticArray, '/diagnostics')
    publisher.publish(DiagnosticArray(status=shouting))
    graph.wait(lambda: status.situation.samples, 'the message')
    status.anomalies.append(0.0)
    status.started = 1.0  # so long ago that the status line no longer waits for the nodes
    status._print()
    printed = capsys.readouterr().out
    assert 'STOPPED' in printed and all(line.isprintable() for line in printed.splitlines())
    assert str(MessageError('wrong', '\x1b[2J\ud800')).isprintable()
    code, output = graph.ended(graph.start('controller', robot='arm26\x1b[2J'))
    assert code == 1 and '\x1b' not in output


def test_the_status_line_waits_for_a_slow_start_for_a_limited_time(graph):
    status = graph.host(BringupStatus, robot='arm26', duration=1e6, patience=0.01)
    status.anomalies.append(0.0)
    status._print()  # `patience` is over, but the system has come up: the status is printed
    status.begun -= 1e3
    status._print()
    status.started = None
    with pytest.raises(SystemExit, match='did not come up'):
        status._print()


def test_a_crash_of_the_interpreter_prints_where_it_happened(graph):
    graph.listen(DiagnosticArray, '/diagnostics', 100)
    process = graph.start('hardware_emulator', robot='arm26')
    graph.wait(lambda: states(graph, 'hardware_emulator'), 'the first report of the emulator')
    status, output = graph.ended(process, signal.SIGSEGV)
    assert status == -signal.SIGSEGV
    assert 'Segmentation fault' in output and 'File "' in output
