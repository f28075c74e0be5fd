# SPDX-License-Identifier: Apache-2.0
"""What the reports of the cores state, as a user reads /diagnostics, until cores have conditions.

A statement that one report hides is missing here, too. The identifiers are those of the conditions
that replace the reports.
"""

from __future__ import annotations

from collections.abc import Iterator

from musculoskeletal_ae.control import status, stops
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.remedy import REMEDY_STEPS, REPAIR, Step, parse
from musculoskeletal_ae.report import WAITS_FOR

#: owner, identifier, level, text, steps, and a text that names the muscles and joints concerned
Row = tuple[str, str, str, str, tuple[Step, ...], str]

#: identifiers of the controller's warnings, by the beginning of their texts
_WARNINGS = {
    'not exploring': 'not_exploring',
    'target clamped': 'target_clamped',
    'method `': 'effort_ignored',
    'trajectory ': 'trajectory_slowed',
    'the target needs more torque': 'torque_missing',
    'out of reach': 'out_of_reach',
    'the arm has fallen': 'arm_fallen',
    'the length offsets are unknown': 'gentle_only',
    'too much tension': 'tension_above_limit',
    'heat limits': 'tension_limited_by_heat',
}
#: identifiers of the learner's messages, by their beginnings
_LEARNER = {
    'learning is paused because lengths have jumped': 'lengths_not_learned',
    'waiting for a checkpoint': 'no_checkpoint',
    'stopped by learner/enable': 'learning_disabled',
    'waiting for a length calibration': 'learning_waits',
    'checking new length offsets': 'learning_waits',
    'paused by an anomaly': 'learning_waits',
    'no usable data': 'nothing_to_learn',
}


def statements_of_reports(
    estimator: Estimator, controller: Controller, learner: Learner, now: float
) -> Iterator[Row]:
    """Yield what the reports state at the time `now` of the steady clock [s]."""
    yield from _of_estimator(estimator, now)
    yield from _of_controller(controller, estimator, now)
    yield from _of_learner(learner)


def _of_estimator(core: Estimator, now: float) -> Iterator[Row]:
    report = core.report(now)
    values, robot = report.values, core.robot
    state, text = values.get('state', ''), report.message
    if state == 'anomaly' and core.suspects.finding is not None:
        finding = core.suspects.finding
        names = finding.evidence
        if not any(joint in names for joint in robot.joints):
            names = f'{robot.muscles[finding.muscle]} {names}'
        steps = parse(values.get(REMEDY_STEPS, ''))
        yield 'estimator', finding.kind.value, report.level, text, steps, names
    elif state != 'isolated' and report.level != 'ok':
        yield 'estimator', state, report.level, text, (), text
    if isolated := values.get('isolated muscles'):  # the status line shows them in any state
        steps = (*REPAIR[:1] * bool(core.suspects.faults), Step.RESTORE_MUSCLES)
        if core.suspects.verification is not None:
            steps = ()
        text = f'isolated: {values.get("isolated muscles with faults", isolated)}'
        yield 'estimator', 'muscle_isolated', 'warn', text, steps, isolated


def _of_controller(core: Controller, estimator: Estimator, now: float) -> Iterator[Row]:
    report = status.report(core, now)
    values = report.values
    steps = parse(values.get(REMEDY_STEPS, ''))
    if estimator.suspects.finding is not None:
        # As in the status line, the estimator knows the remedy of its finding better.
        steps = tuple(step for step in steps if step not in REPAIR)
        if estimator.suspects.verification is not None:
            steps = ()
    if causes := stops.parse(values.get(stops.STOP_CAUSES, '')):
        texts = report.message.split('; also ')  # one for each cause, in their order
        for number, (cause, text) in enumerate(zip(causes, texts)):
            mine = steps if number == 0 else ()
            yield 'controller', cause.identifier, report.level, text, mine, text
    elif waiting := values.get(WAITS_FOR):
        yield 'controller', waiting, report.level, report.message, (), ''
    elif report.level != 'ok':
        for text in report.message.split('; '):
            known = (name for start, name in _WARNINGS.items() if text.startswith(start))
            # A text may itself contain a semicolon; its second part is no further statement.
            if identifier := next(known, ''):
                mine = steps if identifier == 'not_exploring' else ()
                yield 'controller', identifier, report.level, text, mine, text


def _of_learner(core: Learner) -> Iterator[Row]:
    report = core.report()
    if report.level == 'ok':
        return
    text = report.message
    known = (name for start, name in _LEARNER.items() if text.startswith(start))
    identifier = next(known, 'training_failed')
    if core.offset_check.problem and identifier == 'training_failed':
        identifier = 'offsets_not_believed'
    yield 'learner', identifier, report.level, text, (), text
