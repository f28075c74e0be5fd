# SPDX-License-Identifier: Apache-2.0
"""Several arms on one ROS graph: each in a namespace, and all of them in one list."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from graph import Graph
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.nodes.reported_conditions import Arms
from musculoskeletal_ae.ros.diagnostics import NODE_SILENCE
from nodes.test_bringup_status import OPERATOR, SLACK, diagnostics


@pytest.fixture
def pair(graph):
    """Return two ROS graphs in namespaces of their own."""
    graphs = [Graph(f'{graph.namespace}/{side}') for side in ('left', 'right')]
    yield graphs
    for each in graphs:
        each.close()


@pytest.mark.usefixtures('both_cores')
def test_networks_states_and_stops_of_two_arms_are_apart(pair, trained, trained_file):
    left, right = pair
    options = {'robot': 'arm26', 'checkpoint': trained_file, 'explore': True, 'max_age': 10.0}
    for seed, arm in enumerate(pair):
        arm.start('hardware_emulator', robot='arm26', seed=seed)
        arm.start('combined', **options)
        arm.listen(DiagnosticArray, '/diagnostics', 100)
        arm.listen(Float64MultiArray, 'muscle_length_command')
    for arm in pair:
        arm.wait(lambda arm=arm: arm.report('controller').message == 'exploring', 'exploration')

    def version(arm):
        return arm.report('estimator').values.get('checkpoint version')

    def listed():
        arms = Arms()
        for message in right.received['/diagnostics']:
            arms.diagnosed(message)
        return {arm.namespace: arm for arm in arms.summaries()}

    def left_level():
        return listed()[left.namespace].level if left.namespace in listed() else None

    before = right.wait(lambda: version(right), 'the network of the right arm')
    left.send_network(checkpoint.to_bytes(replace(trained['default'], version=7)))
    left.wait(lambda: version(left) == '7', 'the network of the left arm')
    assert left.call(Trigger, 'controller/stop').success
    left.wait(lambda: 'operator_stop' in left.report('controller').identifiers, 'the stop')
    right.wait(lambda: left_level() == 'error', 'the stop in the list of arms')
    right.next('muscle_length_command', 20)
    assert version(right) == before
    assert right.report('controller').message == 'exploring'

    home = Path(os.environ['XDG_STATE_HOME']) / 'musculoskeletal_ae' / 'arm26'
    stops = [(home / arm.namespace.strip('/') / 'controller.stop').read_text() for arm in pair]
    assert 'operator_stop' in stops[0] and 'operator_stop' not in stops[1]

    assert list(listed()) == [left.namespace, right.namespace]
    assert 'controller/stop' not in listed()[right.namespace].text

    for process in list(left.processes):
        left.ended(process, signal.SIGINT)
    right.next('muscle_length_command', 20)


def test_arms_are_listed_by_number_with_what_they_do_and_what_they_learned():
    arms = Arms()
    for name in 'arm10', 'arm2':
        arms.diagnosed(diagnostics(f'/{name}/controller', message=f'{name} explores', identity='a'))
    arms.diagnosed(diagnostics('/arm2/learner', identity='b', samples='12', checkpoints='3'))
    arms.diagnosed(diagnostics('/arm2/view', identity='c', page='http://localhost:8082'))
    assert [tuple(arm) for arm in arms.summaries()] == [
        ('/arm2', 'ok', 'arm2 explores', 'samples 12 · networks 3', 'http://localhost:8082'),
        ('/arm10', 'ok', 'arm10 explores', '', ''),
    ]


def test_the_most_urgent_condition_of_an_arm_is_listed_and_the_others_are_counted():
    arms = Arms()
    arms.diagnosed(diagnostics('/left/controller', OPERATOR, identity='a'))
    arms.diagnosed(diagnostics('/left/estimator', SLACK, identity='b'))
    (left,) = arms.summaries()
    assert left.level == 'error'
    assert left.text.startswith('estimator: ') and left.text.endswith(' (and 1 more)')


def test_nodes_of_other_packages_are_no_arms_and_a_list_leads_only_to_web_pages():
    arms = Arms()
    arms.diagnosed(diagnostics('/base/controller', message='runs'))  # of another package
    arms.diagnosed(diagnostics('/camera/driver', message='runs'))
    arms.diagnosed(diagnostics('/view', identity='a', page='http://localhost:8080'))
    assert arms.summaries() == []
    arms.diagnosed(diagnostics('/controller', identity='b', message='idle'))
    arms.diagnosed(diagnostics('/view', identity='a', page='javascript:alert(1)'))
    ((namespace, _, _, _, page),) = arms.summaries()
    assert namespace == '/' and page == ''


def test_an_arm_whose_nodes_have_all_left_the_graph_is_listed_as_ended():
    now, graph = 0.0, {'/left/estimator'}
    arms = Arms(lambda: graph, lambda: now)
    for node in 'controller', 'estimator':
        arms.diagnosed(diagnostics(f'/left/{node}', identity='a', message='runs'))
    now += NODE_SILENCE + 1.0
    assert 'all nodes have ended' not in arms.summaries()[0].text
    graph.clear()
    assert [(arm.level, arm.text) for arm in arms.summaries()] == [('warn', 'all nodes have ended')]
    arms.diagnosed(diagnostics('/left/controller', identity='b', message='idle'))
    assert arms.summaries()[0].text != 'all nodes have ended'
