# SPDX-License-Identifier: Apache-2.0
"""The status line: what the nodes report, sorted, and nothing else."""

import math
import os
import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from hypothesis import given
from hypothesis import strategies as st
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import JointState

from musculoskeletal_ae.awake_clock import AwakeClock
from musculoskeletal_ae.conditions import (
    CONDITIONS,
    Condition,
    ConditionKind,
    from_json,
    stop_causes,
    to_json,
)
from musculoskeletal_ae.nodes import bringup_status
from musculoskeletal_ae.nodes.reported_conditions import Situation, figures
from musculoskeletal_ae.remedy_steps import Step, sentence


def diagnostics(
    node: str, *conditions: Condition, message: str = '', level: bytes = b'\0', **values: str
) -> DiagnosticArray:
    """Return a report of a node with these conditions."""
    pairs = [KeyValue(key=key.replace('_', ' '), value=value) for key, value in values.items()]
    pairs.append(KeyValue(key=CONDITIONS, value=to_json(conditions)))
    status = DiagnosticStatus(name=f'{node}: state', message=message, level=level, values=pairs)
    return DiagnosticArray(status=[status])


@pytest.fixture
def load(monkeypatch):
    """Return a function that sets the load average of this computer."""
    return lambda value: monkeypatch.setattr(os, 'getloadavg', lambda: (value, 0.0, 0.0))


OPERATOR = ConditionKind.OPERATOR.condition()
SLACK = ConditionKind.SLACK_TENDON.condition('biceps: no tension', ['biceps'])


def test_before_the_first_sample_a_hint_explains_why_the_error_may_rise():
    situation = Situation('/left')
    assert situation.hint() == ''  # no learner has reported yet, so there may be none
    situation.diagnosed(diagnostics('/left/learner', samples='0'))
    assert 'error may rise' in situation.hint()
    situation.diagnosed(diagnostics('/left/learner', samples='3', checkpoints='2'))
    assert situation.hint() == '' and situation.count('checkpoints') == '2'


def test_there_is_no_hint_with_a_network_that_has_learned():
    situation = Situation('/left')
    situation.diagnosed(diagnostics('/left/learner', samples='0', network_learned='True'))
    assert situation.hint() == ''


def test_the_hint_states_the_number_of_samples_required():
    situation = Situation('/left')
    situation.diagnosed(diagnostics('/left/learner', samples='3', samples_to_begin_with='20'))
    assert 'learning begins once there are 20 samples' in situation.hint()
    situation.diagnosed(diagnostics('/left/learner', samples='20', samples_to_begin_with='20'))
    assert situation.hint() == ''


def test_an_arm_that_does_not_explore_is_shown_with_its_mode():
    situation = Situation('/left')
    situation.diagnosed(diagnostics('/left/controller', mode='exploring'))
    situation.diagnosed(diagnostics('/left/learner', samples='3'))
    assert situation.unexplored() == ''
    situation.diagnosed(diagnostics('/left/controller', mode='holding'))  # a target was sent
    assert situation.unexplored() == 'holding, not exploring'
    not_exploring = ConditionKind.NOT_EXPLORING.condition()
    situation.diagnosed(diagnostics('/left/controller', not_exploring, mode='idle'))
    assert situation.unexplored() == ''


def test_the_hint_is_printed_once(graph, capsys):
    node = graph.host(bringup_status.BringupStatusNode, robot='arm26')
    node.situation.diagnosed(diagnostics(f'{graph.namespace}/learner', samples='0'))
    for _ in range(2):
        node.anomalies.append(0.5)
        node._print()
    hint, *lines = capsys.readouterr().out.splitlines()
    assert 'error may rise' in hint and len(lines) == 2
    assert not any('error may rise' in line for line in lines)


def test_unknown_values_are_shown_with_the_missing_topic():
    assert figures(True, '0.100 rad', 0.5) == 'error 0.100 rad  A 0.500'
    assert figures(False, '', 0.5) == 'error waits for joint_states  A 0.500'
    none = figures(True, '', math.nan)
    assert none == 'error waits for estimated_joint_states  A waits for anomaly'


def measure(node, ago=0.0):
    """Let a node have received joint angles of 0, for the last time `ago` seconds ago."""
    node._on_measured_posture(np.zeros(2))
    node._reception.arrivals['joint_states'].use(time.monotonic() - ago)


def test_silent_joint_sensors_are_shown_as_missing(graph, capsys):
    node = graph.host(bringup_status.BringupStatusNode, robot='arm26')
    node.anomalies.append(0.5)
    measure(node)
    node._on_estimate(np.ones(2))
    node._print()
    assert 'error 1.414 rad  A 0.500' in capsys.readouterr().out
    measure(node, ago=2.0)
    node._on_estimate(np.ones(2))
    node._print()
    assert 'error waits for joint_states' in capsys.readouterr().out


def test_before_the_first_estimate_a_line_says_why_there_is_none(graph, capsys, monkeypatch, load):
    load(0.0)
    monkeypatch.setattr(bringup_status, 'WAITING_INTERVAL', 0.0)
    node = graph.host(bringup_status.BringupStatusNode, robot='arm26')
    node._print()
    assert capsys.readouterr().out == 'waiting for the first estimate\n'
    rejected = {'last_rejected': 'muscle_states: wrong length: 15 values; expected 18'}
    estimator = f'{graph.namespace}/estimator'
    node.situation.diagnosed(diagnostics(estimator, **rejected))
    node.begun -= 2 * bringup_status.SETTLING
    node._print()
    line = f'waiting for the first estimate: rejected {rejected["last_rejected"]}\n'
    assert capsys.readouterr().out == line
    node._print()
    assert capsys.readouterr().out == ''  # nothing has changed
    for busy in (1e3, 2e3):
        load(busy)
        node._print()
    (line,) = capsys.readouterr().out.splitlines()  # printed once
    assert rejected['last_rejected'] in line and 'this computer is overloaded' in line


def test_what_a_replay_waits_for_is_printed_as_soon_as_it_changes(graph, capsys, load):
    load(0.0)
    node = graph.host(bringup_status.BringupStatusNode, robot='arm26', end_with_replay=True)
    node._print()
    missing = ('estimator and learner', 'learner')
    for nodes in missing:
        message = f'waiting until {nodes} can receive'
        waits = ConditionKind.REPLAY_STANDS.condition(message)
        waiting = diagnostics(f'{graph.namespace}/replay', waits, state='waiting')
        for _ in range(2):
            node.situation.diagnosed(waiting)
            node._print()
    first, *lines = capsys.readouterr().out.splitlines()
    assert 'replay' not in first and len(lines) == len(missing)
    assert all(f'until {nodes} can receive' in line for nodes, line in zip(missing, lines))


def test_at_the_end_of_a_recording_the_last_values_are_shown(graph, capsys):
    node = graph.host(bringup_status.BringupStatusNode, robot='arm26', end_with_replay=True)
    node.situation.diagnosed(diagnostics(f'{graph.namespace}/learner', samples='9'))
    node.anomalies.append(0.5)
    measure(node)
    node._on_estimate(np.ones(2))
    node._print()
    end = diagnostics(f'{graph.namespace}/replay', state='end_of_recording')
    node.situation.diagnosed(end)
    measure(node, ago=2.0)
    for _ in range(2):  # the learner has not reported since the end
        node.started -= bringup_status.SETTLING
        node._print()
    lines = capsys.readouterr().out.splitlines()
    assert sum('error 1.414 rad  A 0.500' in line for line in lines) == 3


@pytest.mark.parametrize('had_estimates', [True, False])
def test_the_end_of_a_recording_without_estimates_is_an_error(graph, had_estimates):
    node = graph.host(bringup_status.BringupStatusNode, robot='arm26', end_with_replay=True)
    if had_estimates:
        node.anomalies.append(0.5)
    node._print()
    rejected = {'last_rejected': 'muscle_states: wrong length'}
    node.situation.diagnosed(diagnostics(f'{graph.namespace}/estimator', **rejected))
    end = diagnostics(f'{graph.namespace}/replay', state='end_of_recording')
    node.situation.diagnosed(end)
    with pytest.raises(ExternalShutdownException if had_estimates else SystemExit) as ended:
        node._print()
    if not had_estimates:
        assert 'no estimate: rejected muscle_states: wrong length' in str(ended.value)


@pytest.mark.parametrize('lost', ['', 'learner'])
def test_at_the_end_of_a_recording_the_samples_and_losses_are_printed(graph, capsys, lost):
    node = graph.host(bringup_status.BringupStatusNode, robot='arm26', end_with_replay=True)
    learner = f'{graph.namespace}/learner'
    node.anomalies.append(0.5)
    node.situation.diagnosed(diagnostics(learner, samples='9'))
    end = {'state': 'end_of_recording', 'nodes_not_waited_for': lost}
    node.situation.diagnosed(diagnostics(f'{graph.namespace}/replay', **end))
    node._print()  # the learner has not reported since the end
    node.situation.diagnosed(diagnostics(learner, samples='10'))
    with pytest.raises(ExternalShutdownException):
        node._print()
    line = capsys.readouterr().out.splitlines()[-1]
    assert '10 resting postures' in line
    assert ('learner' in line and 'train --from-bag' in line) == bool(lost)


def test_every_condition_is_shown_with_its_node_and_its_remedy():
    """One condition never hides another: all kinds are present at once."""
    situation = Situation('/left')
    present = [kind.condition('detail', ['subject']) for kind in ConditionKind]
    situation.diagnosed(diagnostics('/left/controller', *present))
    trouble = situation.trouble()
    for condition in present:
        to_do = f' (to end it: {sentence(condition.steps)})' if condition.steps else ''
        if condition.level != 'ok' or condition.steps:
            assert f'controller: {condition.text}{to_do}' in trouble, condition
    assert trouble.index('ERROR') < trouble.index('warning') < trouble.index('note')


def test_a_healthy_arm_and_the_faults_of_another_arm_show_nothing():
    situation = Situation('/left')
    situation.diagnosed(diagnostics('/right/controller', OPERATOR))
    situation.diagnosed(diagnostics('/left/controller', mode='holding'))
    # What only informs is no trouble: for example, the learner waits for a calibration.
    waiting = ConditionKind.LEARNING_WAITS.condition()
    situation.diagnosed(diagnostics('/left/learner', waiting))
    assert (situation.level(), situation.trouble(), situation.steps()) == ('ok', '', [])
    situation.diagnosed(diagnostics('/left/controller', OPERATOR))
    assert situation.trouble() == (
        'ERROR: controller: controller/stop was called (to end it: call controller/reset)'
    )
    situation.diagnosed(diagnostics('/left/controller', mode='holding'))
    assert situation.trouble() == ''


def test_a_stop_by_the_operator_is_shown_beside_a_verification():
    situation = Situation('')
    verified = SLACK._replace(text=f'{SLACK.text} (it is being verified)', steps=())
    situation.diagnosed(diagnostics('/estimator', verified))
    situation.diagnosed(diagnostics('/controller', OPERATOR, mode='verifying'))
    assert 'being verified' in situation.trouble()
    assert 'controller/stop was called (to end it: call controller/reset)' in situation.trouble()


def test_steps_of_several_conditions_are_given_once_and_the_reset_comes_after_the_repair():
    situation = Situation('')
    gone = ConditionKind.NOT_EXPLORING.condition()
    stop = ConditionKind.ANOMALY.condition(), gone, ConditionKind.OVERHEATED.condition()
    situation.diagnosed(diagnostics('/controller', *stop))
    situation.diagnosed(diagnostics('/estimator', SLACK))
    assert situation.steps() == [
        Step.REPAIR_MUSCLE,
        Step.CHECK_COOLING,
        Step.WAIT_UNTIL_COOL,
        Step.RESET_ESTIMATOR,
        Step.RESET_CONTROLLER,
        Step.EXPLORE,
    ]
    assert situation.suspects == ('biceps',)


def test_what_several_nodes_report_of_the_same_subject_is_shown_once_with_all_their_names():
    situation = Situation('')
    silent = ConditionKind.SILENT_TOPIC.condition('no usable muscle_states', ['muscle_states'])
    for node in ('estimator', 'controller', 'learner'):
        situation.diagnosed(diagnostics(f'/{node}', silent))
    assert situation.trouble().startswith('ERROR: estimator, controller, learner: ')
    assert situation.trouble().count('no usable muscle_states') == 1


def test_the_level_of_the_arm_is_that_of_its_worst_condition():
    situation = Situation('')
    situation.diagnosed(diagnostics('/sim', ConditionKind.NO_CHECKPOINT.condition()))
    assert situation.level() == 'warn'
    situation.diagnosed(diagnostics('/estimator', SLACK))
    assert situation.level() == 'error'
    summary = diagnostics('/bringup_status', OPERATOR)  # repeats what all others have reported
    situation.diagnosed(summary)
    assert 'operator' not in situation.trouble()


def test_a_report_of_a_node_of_another_package_is_shown():
    situation = Situation('')
    error = {'message': 'the bus is off', 'level': DiagnosticStatus.ERROR}
    situation.diagnosed(diagnostics('/my_driver', **error))
    assert situation.trouble() == 'ERROR: my_driver: the bus is off'


class Clocked(Situation):
    """The situation of an arm whose nodes are or are not in the ROS graph, at a settable time."""

    def __init__(self):
        self.now, self.nodes, self.awake = 100.0, set(), AwakeClock()
        super().__init__('/left', lambda: self.nodes, lambda: self.awake.at(self.now))

    def second(self, *nodes, pause=0.0):
        """Let nodes report, and let a second pass, which begins with a pause of this process."""
        for node in nodes:
            self.diagnosed(diagnostics(f'/left/{node}'))
        self.now += pause
        for _ in range(10):
            self.awake.tick(self.now)
            self.now += 0.1
        self.forget_ended()


@pytest.mark.parametrize('busy', [0.0, 1e3])
@pytest.mark.parametrize('nodes', [['controller'], ['sim', 'learner']])
def test_nodes_that_have_ended_or_hang_are_named_and_load_is_never_the_cause(load, busy, nodes):
    load(busy)
    situation = Clocked()
    situation.nodes = {f'/left/{node}' for node in nodes}
    situation.second(*nodes)
    assert situation.trouble() == ''
    for _ in range(3):
        situation.second()
    for text in ('the node does not report', 'the node has ended'):
        trouble = situation.trouble()
        assert situation.level() == 'error' and situation.steps() == [Step.RESTART_NODE]
        for node in nodes:
            assert f'ERROR: {node}: {text}: no report for' in trouble
        assert ('this computer is overloaded' in trouble) == bool(busy)
        situation.nodes = set()
    situation.second(*nodes)
    assert situation.trouble() == ''


def test_our_own_pause_is_no_silence_of_others_and_a_viewer_may_end():
    situation = Clocked()
    for _ in range(3):
        situation.second('sim', 'learner', 'view')
    # A jump of the clock by 60 s means that this machine was suspended, not that nodes are silent.
    situation.second('sim', 'learner', pause=60.0)
    assert situation.level() == 'ok'
    for _ in range(6):
        situation.second('sim', 'learner')
    assert situation.level() == 'ok'


texts = st.text(max_size=20)


@given(
    st.lists(
        st.builds(
            Condition,
            texts,
            st.sampled_from(['ok', 'warn', 'error']),
            texts,
            st.lists(st.sampled_from(list(Step)), max_size=3).map(tuple),
            st.lists(texts, max_size=3).map(tuple),
        )
    )
)
def test_conditions_keep_their_content_on_the_way_through_diagnostics(conditions):
    again = from_json(to_json(conditions))
    assert [(c.level, c.steps) for c in again] == [(c.level, c.steps) for c in conditions]
    assert all(c.text.isprintable() for c in again)
    assert to_json(again) == to_json(conditions)


@pytest.mark.parametrize(
    'value', ['', '{', '[' * 9999, '7', '[7]', '[{}]', '[{"level": "fatal", "text": "x"}]']
)
def test_what_is_no_list_of_conditions_is_ignored(value):
    assert from_json(value) == ()


def test_every_kind_has_a_text_and_every_stop_ends_with_a_reset():
    for kind in ConditionKind:
        assert kind.identifier and kind.when and kind.text and kind.owner
    assert all(kind.steps[-1] is Step.RESET_CONTROLLER for kind in stop_causes())


def test_a_joint_sensor_without_a_number_is_counted_and_the_others_are_used(graph):
    node = graph.host(bringup_status.BringupStatusNode, robot='arm26')
    graph.listen(DiagnosticArray, '/diagnostics')
    publisher = graph.publisher(JointState, 'joint_states')
    first, second = node.robot.joints

    def is_counted():
        publisher.publish(JointState(name=[first, second], position=[0.5, math.nan]))
        values = graph.report('bringup_status').values
        return int(values.get(f'ignored joint_states: position of {second} is not finite', 0)) > 0

    graph.wait(is_counted, 'the count')
    np.testing.assert_array_equal(node.theta, [0.5, math.nan])
