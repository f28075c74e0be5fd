# SPDX-License-Identifier: Apache-2.0
"""The content of the status line."""

import math
import os

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import JointState

from musculoskeletal_ae.control.stops import Condition, StopCause, remedy_of
from musculoskeletal_ae.estimation.finding import Finding, Kind
from musculoskeletal_ae.estimation.verification import LONGEST
from musculoskeletal_ae.nodes import bringup_status
from musculoskeletal_ae.nodes.needed_topics import SILENT_TOPIC, silence_remedy, slow_cause
from musculoskeletal_ae.nodes.situation import REPORTS, Situation, figures
from musculoskeletal_ae.remedy import Step, identifiers, sentence


def diagnostics(
    node: str, message: str = '', level: bytes = DiagnosticStatus.OK, **values: str
) -> DiagnosticArray:
    pairs = [KeyValue(key=key.replace('_', ' '), value=value) for key, value in values.items()]
    status = DiagnosticStatus(name=f'{node}: state', message=message, level=level, values=pairs)
    return DiagnosticArray(status=[status])


@pytest.fixture
def load(monkeypatch):
    """Return a function that sets the load average of this computer."""
    return lambda value: monkeypatch.setattr(os, 'getloadavg', lambda: (value, 0.0, 0.0))


def test_before_the_first_sample_a_hint_explains_why_the_error_may_rise():
    situation = Situation('/left')
    assert situation.hint() == ''  # no learner has reported yet, so there may be none
    situation.diagnosed(diagnostics('/left/learner', samples='0'))
    assert 'error may rise' in situation.hint()
    situation.diagnosed(diagnostics('/left/learner', samples='3', checkpoints='2'))
    assert situation.hint() == '' and (situation.samples, situation.checkpoints) == ('3', '2')


def test_there_is_no_hint_with_a_network_that_has_learned():
    situation = Situation('/left')
    situation.diagnosed(diagnostics('/left/learner', samples='0', network_learned='True'))
    assert situation.hint() == ''


def test_the_hint_states_the_number_of_samples_required():
    situation = Situation('/left')
    situation.diagnosed(diagnostics('/left/learner', samples='3', samples_to_begin_with='20'))
    assert 'learning begins with 20 samples' in situation.hint()
    situation.diagnosed(diagnostics('/left/learner', samples='20', samples_to_begin_with='20'))
    assert situation.hint() == ''


def test_an_arm_that_does_not_explore_is_shown_with_its_mode():
    situation = Situation('/left')
    situation.diagnosed(diagnostics('/left/controller', mode='exploring'))
    situation.diagnosed(diagnostics('/left/learner', samples='3'))
    assert situation.unexplored() == ''
    situation.diagnosed(diagnostics('/left/controller', mode='holding'))  # a target was sent
    assert situation.unexplored() == 'holding, not exploring'
    situation.diagnosed(stopped(StopCause.OPERATOR))
    assert situation.unexplored() == ''
    said = {'remedy_steps': Step.EXPLORE.identifier}
    warning = diagnostics('/left/controller', 'to explore', DiagnosticStatus.WARN, **said)
    situation.diagnosed(warning)
    assert situation.unexplored() == ''


def test_the_hint_is_printed_once(graph, capsys):
    node = graph.host(bringup_status.BringupStatus, robot='arm26')
    node.situation.diagnosed(diagnostics(f'{graph.namespace}/learner', samples='0'))
    for _ in range(2):
        node.anomalies.append(0.5)
        node._print()
    hint, *lines = capsys.readouterr().out.splitlines()
    assert 'error may rise' in hint and len(lines) == 2
    assert not any('error may rise' in line for line in lines)


def test_unknown_values_are_shown_with_the_missing_topic():
    assert figures(True, 0.1, 0.5) == 'error 0.100 rad  A 0.500'
    assert figures(False, math.nan, 0.5) == 'error waits for joint_states  A 0.500'
    none = figures(True, math.nan, math.nan)
    assert none == 'error waits for estimated_joint_states  A waits for anomaly'


def test_silent_joint_sensors_are_shown_as_missing(graph, capsys):
    node = graph.host(bringup_status.BringupStatus, robot='arm26')
    node.anomalies.append(0.5)
    node._on_measured_posture(np.zeros(2))
    node._on_estimate(np.ones(2))
    node._print()
    assert 'error 1.414 rad  A 0.500' in capsys.readouterr().out
    node.measured = node.measured[0] - 2.0, node.measured[1]
    node._on_estimate(np.ones(2))
    node._print()
    assert 'error waits for joint_states' in capsys.readouterr().out


def test_before_the_first_estimate_a_line_says_why_there_is_none(graph, capsys, monkeypatch, load):
    load(0.0)
    monkeypatch.setattr(bringup_status, 'WAITING_INTERVAL', 0.0)
    node = graph.host(bringup_status.BringupStatus, robot='arm26')
    node._print()
    assert capsys.readouterr().out == 'waiting for the first estimate\n'
    rejected = {'last_rejected': 'muscle_states: wrong length: 15 values; expected 18'}
    estimator = f'{graph.namespace}/estimator'
    node.situation.diagnosed(diagnostics(estimator, 'w', DiagnosticStatus.ERROR, **rejected))
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
    node = graph.host(bringup_status.BringupStatus, robot='arm26', end_with_replay=True)
    node._print()
    missing = ('estimator and learner', 'learner')
    for nodes in missing:
        message = f'waiting until {nodes} can receive'
        waiting = diagnostics(f'{graph.namespace}/replay', message, state='waiting')
        for _ in range(2):
            node.situation.diagnosed(waiting)
            node._print()
    first, *lines = capsys.readouterr().out.splitlines()
    assert 'replay' not in first and len(lines) == len(missing)
    assert all(f'until {nodes} can receive' in line for nodes, line in zip(missing, lines))


def test_at_the_end_of_a_recording_the_last_values_are_shown(graph, capsys):
    node = graph.host(bringup_status.BringupStatus, robot='arm26', end_with_replay=True)
    node.situation.diagnosed(diagnostics(f'{graph.namespace}/learner', samples='9'))
    node.anomalies.append(0.5)
    node._on_measured_posture(np.zeros(2))
    node._on_estimate(np.ones(2))
    node._print()
    end = diagnostics(f'{graph.namespace}/replay', 'end', state='end_of_recording')
    node.situation.diagnosed(end)
    node.measured = node.measured[0] - 2.0, node.measured[1]
    for _ in range(2):  # the learner has not reported since the end
        node.started -= bringup_status.SETTLING
        node._print()
    lines = capsys.readouterr().out.splitlines()
    assert sum('error 1.414 rad  A 0.500' in line for line in lines) == 3


@pytest.mark.parametrize('had_estimates', [True, False])
def test_the_end_of_a_recording_without_estimates_is_an_error(graph, had_estimates):
    node = graph.host(bringup_status.BringupStatus, robot='arm26', end_with_replay=True)
    if had_estimates:
        node.anomalies.append(0.5)
    node._print()
    rejected = {'last_rejected': 'muscle_states: wrong length'}
    node.situation.diagnosed(diagnostics(f'{graph.namespace}/estimator', **rejected))
    end = diagnostics(f'{graph.namespace}/replay', 'end', state='end_of_recording')
    node.situation.diagnosed(end)
    with pytest.raises(ExternalShutdownException if had_estimates else SystemExit) as ended:
        node._print()
    if not had_estimates:
        assert 'no estimate: rejected muscle_states: wrong length' in str(ended.value)


@pytest.mark.parametrize('lost', ['', 'learner'])
def test_at_the_end_of_a_recording_the_samples_and_losses_are_printed(graph, capsys, lost):
    node = graph.host(bringup_status.BringupStatus, robot='arm26', end_with_replay=True)
    learner = f'{graph.namespace}/learner'
    node.anomalies.append(0.5)
    node.situation.diagnosed(diagnostics(learner, samples='9'))
    end = {'state': 'end_of_recording', 'nodes_not_waited_for': lost}
    node.situation.diagnosed(diagnostics(f'{graph.namespace}/replay', 'end', **end))
    node._print()  # the learner has not reported since the end
    node.situation.diagnosed(diagnostics(learner, samples='10'))
    with pytest.raises(ExternalShutdownException):
        node._print()
    line = capsys.readouterr().out.splitlines()[-1]
    assert '10 resting postures' in line
    assert ('learner' in line and 'train --from-bag' in line) == bool(lost)


def found(kind, **more):
    """Return a report on /diagnostics of the estimator in /left, with a finding of this kind.

    None means a report without a finding; `more` has further values of the report.
    """
    values = {'finding': 'none'}
    if kind is not None:
        steps = Finding(0, kind, '').remedy
        values = {'finding': kind.value, 'remedy_steps': identifiers(steps)}
    return diagnostics('/left/estimator', suspect_muscle='biceps', **values, **more)


def stopped(cause, mode='stopped', also=(), explored=False):
    """Return a report on /diagnostics of the controller in /left, which has stopped.

    Args:
        cause: The first stop cause.
        mode: The mode of the controller.
        also: Further stop causes.
        explored: Whether the arm explored before the stop.
    """
    steps = remedy_of([cause, *also], explored)
    values = {
        'mode': mode,
        'stop_cause': cause.identifier,
        'stop_causes': ', '.join(each.identifier for each in (cause, *also)),
        'stop': str(Condition(cause)),
        'remedy': sentence(steps),
        'remedy_steps': identifiers(steps),
    }
    return diagnostics(
        '/left/controller', f'stopped: {cause.text}', DiagnosticStatus.ERROR, **values
    )


RESET = '(to go on: call controller/reset)'
ENDS = f'(ends by itself within {LONGEST:g} s)'
REPAIR = '(to go on: repair the muscle; call estimator/reset)'


def test_a_stop_of_this_arm_alone_is_shown_with_its_remedy():
    situation = Situation('/left')
    situation.diagnosed(diagnostics('/right/controller', mode='stopped', stop='another arm'))
    assert situation.trouble() == ''
    situation.diagnosed(diagnostics('/left/controller', mode='holding'))
    assert situation.trouble() == ''
    situation.diagnosed(stopped(StopCause.OPERATOR))
    assert situation.trouble() == f'STOPPED: controller/stop was called {RESET}'
    situation.diagnosed(diagnostics('/left/controller', mode='paused', stop_cause='stale_estimate'))
    assert situation.trouble() == ''  # from the mode `paused`, the controller resumes by itself


@pytest.mark.parametrize('cause', StopCause)
def test_every_stop_is_shown_with_the_remedy_of_its_cause(cause):
    situation = Situation('/left')
    situation.diagnosed(stopped(cause))
    assert situation.trouble() == f'STOPPED: {cause.text} (to go on: {cause.remedy})'
    assert situation.steps() == [step.identifier for step in cause.steps]


def test_an_anomaly_is_shown_with_the_muscle_and_every_step_to_take():
    situation = Situation('/left')
    suspect = {'finding': 'slack_tendon', 'suspect_muscle': 'biceps'}
    situation.diagnosed(diagnostics('/left/estimator', **suspect, d='12.5', d_limit='9.0'))
    assert (situation.distance, situation.limit) == (12.5, 9.0)
    # No controller has reported yet, so the remedy names only the estimator's steps.
    assert situation.trouble() == f'ANOMALY: biceps {REPAIR}'
    situation.diagnosed(stopped(StopCause.ANOMALY, explored=True))
    assert situation.trouble() == (
        'ANOMALY: biceps, STOPPED: anomaly detected (to go on: repair the muscle; call '
        'estimator/reset; call controller/reset; call controller/explore true to explore again)'
    )
    assert situation.steps() == ['repair_muscle', 'reset_estimator', 'reset_controller', 'explore']
    situation.diagnosed(diagnostics('/left/estimator', finding='none'))
    situation.diagnosed(diagnostics('/left/controller', mode='holding'))
    assert situation.trouble() == ''


@pytest.mark.parametrize('parameter', ['ruptured_muscles', 'faults'])
def test_on_an_emulated_arm_the_remedy_names_the_parameter_that_repairs_the_muscle(parameter):
    situation = Situation('/left')
    situation.diagnosed(found(Kind.SLACK_TENDON))
    situation.diagnosed(diagnostics('/left/hardware_emulator', emulated_faults=parameter))
    repair = f"repair the muscle: set {parameter} of hardware_emulator to ['']"
    for report in (diagnostics('/left/controller'), stopped(StopCause.ANOMALY)):
        situation.diagnosed(report)
        assert repair in situation.trouble()
    situation.diagnosed(diagnostics('/left/hardware_emulator', emulated_faults='none'))
    assert 'hardware_emulator' not in situation.trouble()


def test_a_muscle_of_an_emulated_arm_that_has_been_repaired_is_not_to_be_repaired_again():
    situation = Situation('/left')
    emulator = '/left/hardware_emulator'
    sound = diagnostics(emulator, emulated_faults='none')
    isolated = {'isolated_muscles': 'triceps', 'isolated_muscles_with_faults': 'triceps (ruptured)'}
    situation.diagnosed(sound)
    situation.diagnosed(stopped(StopCause.ANOMALY))
    # The last report of the emulator may be older than the rupture.
    for report in (found(Kind.SLACK_TENDON, **isolated), diagnostics(emulator, emulated_faults='')):
        situation.diagnosed(report)
        assert situation.trouble().count(Step.REPAIR_MUSCLE.text) == 2
        assert situation.steps()[0] == 'repair_muscle'
    situation.diagnosed(sound)
    assert situation.steps() == ['reset_estimator', 'reset_controller']
    assert Step.REPAIR_MUSCLE.text not in situation.trouble()
    assert Step.RESTORE_MUSCLES.text in situation.trouble()


def test_an_anomaly_is_shown_with_its_evidence_and_the_learner_advises_nothing_else():
    situation = Situation('/left')
    suspect = {'finding': 'slack_tendon', 'suspect_muscle': 'biceps', 'evidence': 'no tension'}
    situation.diagnosed(diagnostics('/left/estimator', **suspect, verification='running'))
    stopped_learner = 'stopped by an anomaly', DiagnosticStatus.WARN
    situation.diagnosed(diagnostics('/left/learner', *stopped_learner, waits_for='anomaly'))
    verifying = f'ANOMALY: biceps is being verified: no tension {ENDS}'
    # The text is the same before and after the controller reports its stop.
    assert situation.trouble() == verifying
    situation.diagnosed(stopped(StopCause.ANOMALY))
    assert situation.trouble() == verifying
    situation.diagnosed(diagnostics('/left/estimator', **suspect, verification='none'))
    assert situation.trouble().startswith('ANOMALY: biceps: no tension, STOPPED: ')
    assert 'learner' not in situation.trouble()


def test_after_an_isolation_the_fault_is_named_and_the_learner_advises_nothing_for_some_seconds():
    situation = Situation('/left')
    body = {'isolated_muscles': 'biceps', 'isolated_muscles_with_faults': 'biceps (ruptured)'}
    isolated = diagnostics('/left/estimator', finding='none', state='isolated', **body)
    paused = 'paused by an anomaly', DiagnosticStatus.WARN
    situation.diagnosed(diagnostics('/left/estimator', finding='slack_tendon', **body))
    situation.diagnosed(diagnostics('/left/learner', *paused, waits_for='anomaly'))
    for _ in range(3):
        situation.diagnosed(isolated)
        assert situation.trouble() == (
            'isolated: biceps (ruptured) '
            '(to use it again: repair the muscle; call estimator/restore)'
        )
        assert situation.steps() == []  # the arm goes on without the muscle
    situation.diagnosed(isolated)  # the learner still waits for an anomaly that has ended
    assert situation.trouble().endswith('warning: /left/learner: paused by an anomaly')


@pytest.mark.parametrize(
    ('kind', 'first'),
    [
        (Kind.LENGTHS_JUMPED, 'call estimator/zero'),
        (Kind.SLACK_TENDON, 'repair the muscle'),
        (None, 'call controller/reset'),  # the anomaly is over, but the stop is latched
    ],
)
def test_the_remedy_of_an_anomaly_is_that_of_its_kind(kind, first):
    situation = Situation('/left')
    situation.diagnosed(found(kind))
    situation.diagnosed(stopped(StopCause.ANOMALY))
    _, _, remedy = situation.trouble().partition('STOPPED: anomaly detected (to go on: ')
    assert remedy.startswith(first) and 'call controller/reset' in remedy
    assert (kind is Kind.SLACK_TENDON) == ('repair' in situation.trouble())


def test_the_remedy_of_an_anomaly_is_that_of_its_kind_also_beside_other_causes():
    situation = Situation('/left')
    situation.diagnosed(found(Kind.LENGTHS_JUMPED))
    situation.diagnosed(
        stopped(StopCause.ANOMALY, also=[StopCause.LENGTH_OFFSETS_REVOKED, StopCause.OVERHEATED])
    )
    assert situation.steps() == [
        'calibrate_lengths', 'wait_until_cool', 'reset_controller', 'explore_gently'
    ]  # fmt: skip


def test_the_remedy_of_several_causes_repairs_nothing_if_only_lengths_are_off():
    causes = (
        StopCause.IMPLAUSIBLE_MUSCLE_STATES, StopCause.ANOMALY, StopCause.LENGTH_OFFSETS_REVOKED
    )  # fmt: skip
    situation = Situation('/left')
    situation.diagnosed(found(Kind.LENGTHS_JUMPED, unknown_length_offsets='biceps'))
    first, *also = causes
    situation.diagnosed(stopped(first, also=also, explored=True))
    assert situation.steps() == ['calibrate_lengths', 'reset_controller', 'explore_gently']
    assert 'repair' not in situation.trouble()


CONSEQUENCES = (
    StopCause.IMPLAUSIBLE_MUSCLE_STATES, StopCause.IMPLAUSIBLE_ESTIMATE, StopCause.STALE_ESTIMATE
)  # fmt: skip
REPAIR_STEPS = ['repair_muscle', 'reset_estimator', 'reset_controller', 'explore']


def with_silent_estimates(report):
    """Add to the report of a controller that usable estimates are missing; return the report."""
    status = report.status[0]
    steps = next(value for value in status.values if value.key == 'remedy steps')
    steps.value += ', check_estimator'
    status.values.append(KeyValue(key=SILENT_TOPIC, value='no usable estimated_joint_states'))
    return report


@pytest.mark.parametrize('first', [StopCause.ANOMALY, *CONSEQUENCES])
def test_what_follows_from_an_anomaly_needs_no_steps_until_the_anomaly_has_returned(first):
    situation = Situation('/left')
    also = [cause for cause in (StopCause.ANOMALY, *CONSEQUENCES) if cause is not first]
    stop = with_silent_estimates(stopped(first, also=also, explored=True))
    lengths = {'unknown_length_offsets': 'triceps'}
    situation.diagnosed(found(Kind.RESIDUAL_DISTANCE, **lengths))
    situation.diagnosed(stop)
    assert situation.steps() == REPAIR_STEPS
    for consequence in ('checkpoint', 'estimator/zero', 'is running', 'no usable'):
        assert consequence not in situation.trouble()
    for _ in range(REPORTS):  # the report of the controller may be older than the end
        situation.diagnosed(found(None))
        assert not {'repair_muscle', 'check_checkpoint', 'check_sensor'} & set(situation.steps())
    situation.diagnosed(found(None))  # what is still present now is necessary
    after = situation.steps()
    assert 'repair_muscle' not in after
    needed = {'check_sensor', 'check_checkpoint', 'calibrate_lengths', 'check_estimator'}
    assert needed <= set(after)
    situation.diagnosed(found(Kind.RESIDUAL_DISTANCE, **lengths))  # the repair has not helped
    assert {*REPAIR_STEPS, 'check_checkpoint', 'calibrate_lengths'} <= set(situation.steps())
    situation.diagnosed(diagnostics('/left/controller', mode='exploring'))
    situation.diagnosed(stop)
    assert situation.steps() == REPAIR_STEPS


def test_revoked_lengths_are_to_be_calibrated_also_during_an_anomaly():
    situation = Situation('/left')
    situation.diagnosed(found(Kind.RESIDUAL_DISTANCE))  # estimator/reset is refused until then
    situation.diagnosed(stopped(StopCause.ANOMALY, also=[StopCause.LENGTH_OFFSETS_REVOKED]))
    assert 'calibrate_lengths' in situation.steps()


def test_an_arm_that_should_explore_but_does_not_is_shown_with_the_step():
    situation = Situation('/left')
    message = f'not exploring, mode idle (to go on: {Step.EXPLORE.text})'
    values = {'mode': 'idle', 'remedy_steps': 'explore'}
    situation.diagnosed(diagnostics('/left/controller', message, DiagnosticStatus.WARN, **values))
    assert situation.trouble() == f'warning: /left/controller: {message}'
    assert situation.steps() == ['explore']


def test_a_pause_is_shown_without_steps_because_it_ends_by_itself():
    situation = Situation('/left')
    values = {'mode': 'paused', 'stop_cause': 'stale_estimate', 'remedy_steps': 'check_estimator'}
    situation.diagnosed(diagnostics('/left/controller', 'paused', DiagnosticStatus.WARN, **values))
    assert situation.trouble() == 'warning: /left/controller: paused'
    assert situation.steps() == []


def test_a_suspect_counts_as_isolated_only_after_its_verification():
    situation = Situation('/left')
    body = {'isolated_muscles': 'triceps, biceps'}
    body['isolated_muscles_with_faults'] = 'triceps (ruptured), biceps'
    situation.diagnosed(found(Kind.SLACK_TENDON, verification='running', **body))
    assert 'isolated: triceps (ruptured) (to use' in situation.trouble()
    alone = {'isolated_muscles': 'biceps', 'isolated_muscles_with_faults': 'biceps'}
    situation.diagnosed(found(Kind.SLACK_TENDON, verification='running', **alone))
    assert situation.trouble() == f'ANOMALY: biceps is being verified {ENDS}'


def test_a_learner_that_waits_for_a_calibration_is_not_shown_beside_the_calibration():
    situation = Situation('/left')
    waiting = diagnostics(
        '/left/learner', 'waiting', DiagnosticStatus.WARN, waits_for='length_offsets'
    )
    lengths = {'state': 'calibrating', 'unknown_length_offsets': 'biceps'}
    situation.diagnosed(diagnostics('/left/estimator', finding='none', **lengths))
    situation.diagnosed(waiting)
    assert situation.trouble() == 'length offsets unknown: biceps'
    for _ in range(REPORTS):  # the report of the learner may be older than the end
        situation.diagnosed(diagnostics('/left/estimator', finding='none'))
        assert situation.trouble() == ''
    situation.diagnosed(diagnostics('/left/estimator', finding='none'))
    assert situation.trouble() == 'warning: /left/learner: waiting'


@pytest.mark.parametrize('state', ['waiting', 'paused'])
def test_silence_of_a_replay_that_does_not_play_is_not_put_down_to_a_driver(state):
    now = 100.0
    situation = Situation('/left', lambda: now)
    situation.diagnosed(diagnostics('/left/replay', 'waiting until learner can', state=state))
    silent = {'silent_topic': 'no usable muscle_states: check the driver', 'finding': 'none'}
    situation.diagnosed(diagnostics('/left/estimator', 'old', DiagnosticStatus.ERROR, **silent))
    waits = {'waits_for': 'muscle_states', 'samples': '0'}
    situation.diagnosed(diagnostics('/left/learner', 'no data', DiagnosticStatus.WARN, **waits))
    is_waiting = state == 'waiting'
    assert situation.trouble() == ('replay is waiting until learner can' if is_waiting else '')
    situation.diagnosed(diagnostics('/left/replay', 'playing', state='playing'))
    assert situation.trouble() == ''  # the reports of the other nodes are older
    for _ in range(REPORTS):
        now += 1.0
        situation.tick()
        situation.diagnosed(diagnostics('/left/replay', 'playing', state='playing'))
        situation.diagnosed(diagnostics('/left/estimator', 'old', DiagnosticStatus.ERROR, **silent))
    assert 'check the driver' not in situation.trouble() and '/left/estimator: old' in (
        situation.trouble()
    )


def test_nothing_counts_as_silent_before_an_expected_replay_has_begun():
    silent = {'silent_topic': 'no usable muscle_states: check the driver', 'finding': 'none'}
    for expects_replay in (False, True):
        situation = Situation('/left', expects_replay=expects_replay)
        situation.diagnosed(diagnostics('/left/estimator', 'old', DiagnosticStatus.ERROR, **silent))
        assert situation.trouble() == ('' if expects_replay else '/left/estimator: old')


def test_silence_after_a_recording_is_put_down_to_its_end():
    now = 100.0
    situation = Situation('/left', lambda: now)
    silent = {'silent_topic': 'no usable muscle_states', 'finding': 'none'}
    situation.diagnosed(diagnostics('/left/replay', 'end', state='end_of_recording'))
    situation.diagnosed(diagnostics('/left/estimator', 'old', DiagnosticStatus.ERROR, **silent))
    assert situation.trouble() == 'end of the recording'
    situation.diagnosed(diagnostics('/left/replay', 'playing'))
    assert situation.trouble() == ''
    for _ in range(REPORTS):
        now += 1.0
        situation.tick()
        situation.diagnosed(diagnostics('/left/replay', 'playing'))
        situation.diagnosed(diagnostics('/left/estimator', 'old', DiagnosticStatus.ERROR, **silent))
    assert situation.trouble() == '/left/estimator: old'


def test_a_calibration_that_runs_is_not_to_be_started():
    situation = Situation('/left')
    lengths = {'state': 'calibrating', 'unknown_length_offsets': 'biceps'}
    situation.diagnosed(diagnostics('/left/estimator', finding='none', **lengths))
    assert situation.trouble() == 'length offsets unknown: biceps'


@pytest.mark.parametrize('mode', ['idle', 'holding', 'moving', 'torque', 'calibrating'])
def test_the_arm_is_to_explore_while_a_calibration_waits_for_gentle_motion(mode):
    situation = Situation('/left')
    lengths = {'state': 'calibrating', 'unknown_length_offsets': 'biceps'}
    situation.diagnosed(diagnostics('/left/controller', mode=mode))
    situation.diagnosed(diagnostics('/left/estimator', **lengths, calibration='standing'))
    assert situation.steps() == []
    situation.diagnosed(diagnostics('/left/estimator', **lengths, calibration='gentle_motion'))
    assert situation.steps() == ([] if mode == 'calibrating' else ['explore_gently'])


def test_a_calibration_that_cannot_end_is_shown_with_its_remedy():
    situation = Situation('/left')
    lengths = {'state': 'calibrating', 'unknown_length_offsets': 'biceps'}
    problem = 'biceps has a residual of 55 mm, limit 20 mm'
    situation.diagnosed(diagnostics('/left/estimator', **lengths, calibration_problem=problem))
    assert situation.steps() == ['check_sensor', 'calibrate_lengths']
    assert 'check the named sensor' in situation.trouble()


@pytest.mark.parametrize('nodes', [['controller'], ['controller', 'sim']])
def test_no_restart_is_advised_while_the_load_of_the_computer_explains_silence(load, nodes):
    now = 100.0
    situation = Situation('/left', lambda: now)
    for node in nodes:
        situation.diagnosed(diagnostics(f'/left/{node}'))
    advised = {}
    for is_busy in (False, True):
        load(1e3 if is_busy else 0.0)
        for _ in range(6):
            now += 1.0
            situation.tick()
            trouble = situation.trouble()
            if 'no report' in trouble:
                advised[is_busy] = 'restart' in trouble, 'this computer is overloaded' in trouble
                assert all(node in trouble for node in nodes) and situation.level() == 'error'
        situation.tick()
        for node in nodes:
            situation.diagnosed(diagnostics(f'/left/{node}'))
        assert situation.trouble() == ''
    assert advised == {False: (True, False), True: (False, True)}
    for _ in range(12):  # so long a silence is not due to the load alone
        now += 1.0
        situation.tick()
    assert 'restart' in situation.trouble()


def test_several_silent_nodes_are_put_down_to_the_computer(load):
    now = 100.0
    load(0.0)  # the average over a minute has not risen yet
    situation = Situation('/left', lambda: now)
    for node in ('sim', 'learner'):
        situation.diagnosed(diagnostics(f'/left/{node}'))
    for _ in range(4):
        now += 1.0
        situation.tick()
    assert situation.trouble().startswith(
        '/left/sim, /left/learner: no report for 4 s; perhaps the computer is overloaded (load '
    )


@pytest.mark.parametrize('cause', [StopCause.ANOMALY, StopCause.IMPLAUSIBLE_ESTIMATE])
def test_while_a_verification_ends_the_stop_no_step_is_advised(cause):
    situation = Situation('/left')
    stop = with_silent_estimates(stopped(cause, 'verifying', also=CONSEQUENCES, explored=True))
    situation.diagnosed(found(Kind.SLACK_TENDON, verification='running'))
    situation.diagnosed(stop)
    assert situation.steps() == []
    assert 'to go on' not in situation.trouble()
    for _ in range(REPORTS):  # the report of the controller may be older than the end
        situation.diagnosed(found(None))
        assert situation.steps() == []
        assert 'STOPPED' not in situation.trouble()
    situation.diagnosed(found(None))
    assert 'reset_controller' in situation.steps()


def test_at_the_end_of_a_calibration_an_older_report_of_the_controller_advises_nothing():
    situation = Situation('/left')
    lengths = {'unknown_length_offsets': 'biceps'}
    situation.diagnosed(
        diagnostics('/left/controller', 'gentle', DiagnosticStatus.WARN, mode='calibrating',
                    **lengths)
    )  # fmt: skip
    situation.diagnosed(
        diagnostics('/left/estimator', finding='none', state='calibrating', **lengths)
    )
    assert 'length offsets unknown' in situation.trouble()
    for _ in range(REPORTS):
        situation.diagnosed(diagnostics('/left/estimator', finding='none', state='estimating'))
        assert situation.steps() == []
        assert 'length offsets unknown' not in situation.trouble()
    # A controller that does not learn the offsets is a fault.
    situation.diagnosed(diagnostics('/left/estimator', finding='none', state='estimating'))
    assert situation.steps() == ['calibrate_lengths']


def test_a_suspect_that_is_verified_is_not_to_be_repaired_yet():
    situation = Situation('/left')
    situation.diagnosed(found(Kind.SLACK_TENDON, verification='running'))
    verifying = f'ANOMALY: biceps is being verified {ENDS}'
    situation.diagnosed(stopped(StopCause.ANOMALY, 'verifying'))
    assert situation.trouble() == verifying
    situation.diagnosed(stopped(StopCause.OPERATOR, 'verifying'))
    assert situation.trouble() == f'{verifying}, STOPPED: controller/stop was called {RESET}'
    # Only the estimator decides when the verification has ended.
    situation.diagnosed(found(Kind.SLACK_TENDON, verification='none'))
    assert situation.trouble() == (
        f'ANOMALY: biceps {REPAIR}, STOPPED: controller/stop was called {RESET}'
    )


def test_the_load_of_the_computer_explains_another_network_for_some_seconds(load):
    load(1e3)
    situation, advised = Situation('/left'), []
    for _ in range(20):
        situation.diagnosed(diagnostics('/left/estimator', checkpoint_version='20'))
        situation.diagnosed(diagnostics('/left/controller', checkpoint_version='3'))
        if 'uses network 3' in (trouble := situation.trouble()):
            advised.append('restart' in trouble)
    assert advised[0] is False and advised[-1] is True
    assert advised == sorted(advised)


def test_a_node_with_another_network_than_the_estimator_is_shown_after_some_seconds(load):
    load(0.0)
    situation = Situation('/')

    def second(estimator, controller):
        for node, version in ('estimator', estimator), ('controller', controller):
            situation.diagnosed(
                diagnostics(f'/{node}', mode='holding', checkpoint_version=str(version))
            )

    for version in range(10):  # the controller takes each version over one report later
        second(version, max(version - 1, 0))
        assert situation.trouble() == ''
    for _ in range(3):
        second(20, 3)
    assert situation.trouble() == (
        'controller uses network 3, but the estimator uses network 20; '
        'if this lasts, restart controller or bringup.sh'
    )
    second(20, 20)
    assert situation.trouble() == ''


def test_an_error_of_any_node_is_shown_until_it_is_over():
    error = DiagnosticStatus.ERROR
    alone = Situation('/')
    alone.diagnosed(diagnostics('/right/learner', 'the disk is full', error))
    assert alone.trouble() == ''
    alone.diagnosed(diagnostics('/learner', 'the disk is full', error))
    assert alone.trouble() == '/learner: the disk is full'
    situation = Situation('/left')
    situation.diagnosed(diagnostics('/right/learner', 'the disk is full', error))
    situation.diagnosed(
        diagnostics('/left/controller', 'a KeyError escaped', error, fault='a KeyError')
    )
    assert situation.trouble() == '/left/controller: a KeyError escaped'
    situation.diagnosed(stopped(StopCause.OPERATOR))
    stop = f'STOPPED: controller/stop was called {RESET}'
    assert situation.trouble() == stop
    situation.diagnosed(diagnostics('/left/learner', 'the disk is full', error))
    assert situation.trouble() == f'{stop}, /left/learner: the disk is full'
    situation.diagnosed(diagnostics('/left/controller', 'holding', mode='holding'))
    assert situation.trouble() == '/left/learner: the disk is full'
    situation.diagnosed(diagnostics('/left/learner', 'learning'))
    assert situation.trouble() == ''


def test_a_node_that_no_longer_reports_is_an_error_but_our_own_pause_is_none(load):
    now = 100.0
    load(0.0)
    situation = Situation('/left', lambda: now)

    def second(*nodes, lasting=1.0):
        nonlocal now
        for node in nodes:
            situation.diagnosed(diagnostics(f'/left/{node}'))
        now += lasting
        situation.tick()
        return situation.level(), situation.trouble()

    for _ in range(3):
        assert second('sim', 'learner', 'view') == ('ok', '')
    # A jump of the clock by 60 s means that this machine was suspended, not that nodes are silent.
    assert second('sim', lasting=60.0)[0] == 'ok'
    assert second('sim')[0] == 'error'
    level, trouble = second('sim')
    assert level == 'error' and trouble.startswith('/left/learner: no report for 4 s; ')
    assert 'sim' not in trouble and 'view' not in trouble
    assert second('sim', 'learner') == ('ok', '')
    situation.diagnosed(diagnostics('/left/second', 'wrong', DiagnosticStatus.ERROR))
    assert second('sim', 'learner')[1] == '/left/second: wrong'
    for _ in range(6):  # a node that is not part of the arm may end without being reported
        second('sim', 'learner')
    assert second('sim', 'learner') == ('ok', '')


def test_the_situation_is_as_bad_as_the_worst_node_and_shows_warnings_and_the_body():
    situation = Situation('')
    situation.diagnosed(diagnostics('/sim', 'slow', DiagnosticStatus.WARN))
    assert (situation.level(), situation.trouble()) == ('warn', 'warning: /sim: slow')
    body = {'state': 'isolated', 'isolated_muscles': 'biceps', 'unknown_length_offsets': 'triceps'}
    situation.diagnosed(diagnostics('/estimator', 'estimating', DiagnosticStatus.WARN, **body))
    assert situation.trouble() == (
        'isolated: biceps (to use it again: call estimator/restore), '
        'length offsets unknown: triceps (to go on: call estimator/zero), '
        'warning: /sim: slow'
    )
    situation.diagnosed(diagnostics('/estimator', finding='none', state='estimating'))
    situation.diagnosed(diagnostics('/controller', mode='idle', unknown_length_offsets='triceps'))
    assert situation.trouble().startswith('length offsets unknown: triceps (to go on: ')
    situation.diagnosed(diagnostics('/controller', mode='idle'))
    several = {'several_publishers': 'joint_states come from a and b', 'finding': 'none'}
    situation.diagnosed(diagnostics('/estimator', 'two', DiagnosticStatus.ERROR, **several))
    assert (situation.level(), situation.trouble()) == (
        'error',
        '/estimator: two, warning: /sim: slow',
    )
    stop = 'several publishers: joint_states come from a and b'
    values = {'mode': 'stopped', 'stop_cause': 'second_publisher', 'stop': stop, 'remedy': 'end it'}
    situation.diagnosed(diagnostics('/controller', 'stopped', DiagnosticStatus.ERROR, **values))
    assert situation.trouble() == f'STOPPED: {stop} (to go on: end it), warning: /sim: slow'
    situation.diagnosed(diagnostics('/bringup_status', 'the same again', DiagnosticStatus.ERROR))
    assert 'the same again' not in situation.trouble()


def test_slow_messages_of_the_emulator_are_put_down_to_the_computer_not_to_a_driver(load):
    load(0.0)
    assert 'driver' not in slow_cause(['hardware_emulator'])
    assert 'driver' in slow_cause(['my_driver'])


def test_silence_is_put_down_to_what_publishes_or_to_the_load(load):
    load(0.0)
    assert silence_remedy('muscle_states', 3.0, ['my_driver']) == (
        Step.CHECK_DRIVER,
        Step.CHECK_DRIVER.text,
    )
    step, text = silence_remedy('muscle_states', 3.0, ['replay'])
    assert step is Step.CHECK_REPLAY and 'driver' not in text
    load(1e3)
    for silence, is_explained in ((3.0, True), (30.0, False)):
        step, text = silence_remedy('muscle_states', silence, ['my_driver'])
        assert step is Step.CHECK_DRIVER
        assert ('driver' not in text and 'this computer is overloaded' in text) == is_explained


def test_a_silent_topic_is_shown_beside_a_stop_of_another_cause():
    situation, silent = Situation('/left'), 'no usable muscle_states for 3 s: check the driver'
    reported = stopped(StopCause.OPERATOR)
    reported.status[0].values.append(KeyValue(key=SILENT_TOPIC, value=silent))
    situation.diagnosed(reported)
    assert situation.trouble().endswith(f'{RESET}, /left/controller: {silent}')


def test_a_refused_command_is_shown_beside_a_stop():
    situation = Situation('/left')
    reported = stopped(StopCause.OPERATOR)
    refused = "target_joint_states: unknown joint: 'elbo'"
    reported.status[0].values.append(KeyValue(key='refused', value=refused))
    situation.diagnosed(reported)
    assert f'STOPPED: controller/stop was called {RESET}' in situation.trouble()
    assert f'refused {refused}' in situation.trouble()


def test_a_joint_sensor_without_a_number_is_named_and_the_others_are_used(graph):
    node = graph.host(bringup_status.BringupStatus, robot='arm26')
    graph.listen(DiagnosticArray, '/diagnostics')
    publisher = graph.publisher(JointState, 'joint_states')
    first, second = node.robot.joints

    def is_named():
        publisher.publish(JointState(name=[first, second], position=[0.5, math.nan]))
        report = graph.report('bringup_status')
        return f'joint_states: position of {second} is not finite' in report.message and report

    report = graph.wait(is_named, 'the warning')
    assert report.level == 'warn'
    assert int(report.values[f'ignored joint_states: position of {second} is not finite']) > 0
    np.testing.assert_array_equal(node.theta, [0.5, math.nan])
