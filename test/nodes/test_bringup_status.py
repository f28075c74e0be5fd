# SPDX-License-Identifier: Apache-2.0
"""What the status line says, and the screen that takes its place on a terminal."""

import io
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from graph import no_number_of

from musculoskeletal_ae.nodes import bringup_status
from musculoskeletal_ae.nodes.bringup_status import muscle_table, open_screen
from musculoskeletal_ae.nodes.situation import Situation


def diagnostics(
    node: str, message: str = '', level: bytes = DiagnosticStatus.OK, **values: str
) -> DiagnosticArray:
    pairs = [KeyValue(key=key.replace('_', ' '), value=value) for key, value in values.items()]
    status = DiagnosticStatus(name=f'{node}: state', message=message, level=level, values=pairs)
    return DiagnosticArray(status=[status])


def test_the_status_explains_before_the_first_sample_why_the_error_may_rise():
    situation = Situation('/left')
    assert situation.hint() == ''  # nobody learns
    situation.diagnosed(diagnostics('/left/learner', samples='0'))
    assert 'error may rise' in situation.hint()
    situation.diagnosed(diagnostics('/left/learner', samples='3', checkpoints='2'))
    assert situation.hint() == '' and (situation.samples, situation.checkpoints) == ('3', '2')


def test_the_status_line_shows_errors_only_with_fresh_joint_states(graph, capsys):
    node = graph.host(bringup_status.BringupStatus, robot='arm26')
    node.anomalies.append(0.5)
    node._measured(np.zeros(2))
    node._estimated(np.ones(2))
    node._print()
    assert 'error 1.414 rad  A 0.500' in capsys.readouterr().out
    node.measured = node.measured[0] - 2.0, node.measured[1]
    node._estimated(np.ones(2))
    node._print()
    assert 'error waits for joint_states' in capsys.readouterr().out


def test_trouble_of_this_arm_only_is_shown_with_its_remedies():
    situation = Situation('/left')
    situation.diagnosed(diagnostics('/right/controller', 'stopped: by request'))
    assert situation.trouble() == ''
    situation.diagnosed(diagnostics('/left/controller', 'exploring'))
    assert situation.trouble() == ''
    situation.diagnosed(diagnostics('/left/controller', 'stopped: anomaly'))
    situation.diagnosed(
        diagnostics('/left/estimator', suspect_muscle='biceps', d='12.5', d_limit='9.0')
    )
    situation.detected = True
    assert situation.trouble() == (
        'ANOMALY: biceps, STOPPED: anomaly (to go on: mend it, estimator/reset, controller/reset, '
        'controller/explore)'
    )
    assert (situation.distance, situation.limit) == (12.5, 9.0)
    situation.detected = False
    situation.diagnosed(diagnostics('/left/controller', 'holding'))
    assert situation.trouble() == ''
    situation.diagnosed(diagnostics('/left/controller', 'stopped: a cause'))
    assert situation.trouble() == 'STOPPED: a cause (to go on: controller/reset)'


def test_no_remedy_is_shown_during_a_verification():
    situation = Situation('/left')
    anomaly = 'anomaly_detected; call estimator/reset when it is mended'
    situation.diagnosed(diagnostics('/left/controller', f'stopped: {anomaly}'))
    cause = 'anomaly detected: biceps: d 12.5 above 9.0'
    situation.diagnosed(
        diagnostics('/left/estimator', f'{cause}; verifying it', suspect_muscle='biceps')
    )
    situation.detected = True
    assert situation.trouble() == 'ANOMALY: biceps is being verified'
    situation.diagnosed(diagnostics('/left/controller', 'stopped: controller/stop was called'))
    assert situation.trouble() == (
        'ANOMALY: biceps is being verified, '
        'STOPPED: controller/stop was called (to go on: controller/reset)'
    )
    situation.diagnosed(diagnostics('/left/estimator', cause, suspect_muscle='biceps'))
    assert 'mend it' in situation.trouble()


def test_an_error_of_any_node_is_shown_until_it_is_over():
    error = DiagnosticStatus.ERROR
    alone = Situation('/')
    alone.diagnosed(diagnostics('/right/learner', 'the disk is full', error))
    assert alone.trouble() == ''
    alone.diagnosed(diagnostics('/learner', 'the disk is full', error))
    assert alone.trouble() == '/learner: the disk is full'
    situation = Situation('/left')
    situation.diagnosed(diagnostics('/right/learner', 'the disk is full', error))
    situation.diagnosed(diagnostics('/left/controller', 'stopped: a cause', error))
    assert situation.trouble() == 'STOPPED: a cause (to go on: controller/reset)'
    situation.diagnosed(diagnostics('/left/learner', 'the disk is full', error))
    assert situation.trouble() == (
        'STOPPED: a cause (to go on: controller/reset), /left/learner: the disk is full'
    )
    situation.diagnosed(diagnostics('/left/controller', 'holding'))
    assert situation.trouble() == '/left/learner: the disk is full'
    situation.diagnosed(diagnostics('/left/learner', 'learning'))
    assert situation.trouble() == ''


def test_a_terminal_shows_every_muscle_and_the_trouble_where_rich_is_there(arm26):
    console = pytest.importorskip('rich.console', reason='rich comes with ./bringup.sh --view')
    states = np.stack([np.linspace(-0.02, 0.03, 6), np.linspace(30.0, 250.0, 6), np.full(6, 41.0)])
    screen = console.Console(width=100, record=True, file=io.StringIO())
    marked = SimpleNamespace(muscles=[f'{m} [/l]' for m in arm26.muscles], tension=arm26.tension)
    screen.print(muscle_table(marked, states, ['error 0.1 rad', 'STOPPED']))
    text = screen.export_text()
    assert all(name in text for name in marked.muscles)
    assert 'STOPPED' in text and '250' in text and '█' in text
    assert open_screen() is None  # output is kept, not a terminal


def test_the_screen_goes_on_where_an_isolated_muscle_says_no_number(graph, arm26, monkeypatch):
    console = pytest.importorskip('rich.console', reason='rich comes with ./bringup.sh --view')
    shown = console.Console(width=100, record=True, file=io.StringIO())
    screen = SimpleNamespace(
        update=lambda table, refresh: shown.print(table),  # noqa: ARG005
        stop=lambda: None,
    )
    monkeypatch.setattr(bringup_status, 'open_screen', lambda: screen)
    node = graph.host(bringup_status.BringupStatus, robot='arm26')
    publish = no_number_of(graph, arm26, 'brachialis')

    def taken():
        publish()
        return node.states is not None

    graph.wait(taken, 'what the others say')
    node.anomalies.append(0.0)  # an estimate has come
    node._print()
    rows = dict(line.split(maxsplit=1) for line in shown.export_text().splitlines() if 'i' in line)
    assert rows['brachialis'].split() == ['0', '–', '25']
    assert rows['biceps_long'].split()[:2] == ['0', '61']
