# SPDX-License-Identifier: Apache-2.0
"""What the nodes state about the arm, as one list of values for benches.

`statements` is the only place that knows how the cores report. With `Estimator.conditions`, it
passes the conditions of the cores on. Without, it reads the reports of the cores as a user reads
/diagnostics, so that a statement that one report hides is missing here, too.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

from musculoskeletal_ae.control import stops
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.remedy import REMEDY_STEPS, REPAIR, Step, parse
from musculoskeletal_ae.report import WAITS_FOR
from musculoskeletal_ae.robot.robot import Robot


class Statement(NamedTuple):
    """One statement of a node.

    Attributes:
        owner: The node.
        identifier: What is stated.
        level: 'ok', 'warn' or 'error'.
        text: The statement as users read it.
        steps: What users are advised to do.
        subjects: The muscles and joints that the statement names.
    """

    owner: str
    identifier: str
    level: str
    text: str
    steps: tuple[Step, ...] = ()
    subjects: frozenset[str] = frozenset()


#: identifiers of the controller's warnings, by the beginning of their texts
_WARNINGS = {
    'not exploring': 'not_exploring',
    'target clamped': 'target_clamped',
    'method `': 'effort_ignored',
    'trajectory ': 'trajectory_slowed',
    'the target needs more torque': 'missing_torque',
    'out of reach': 'out_of_reach',
    'the arm has fallen': 'arm_has_fallen',
    'the length offsets are unknown': 'length_offsets_unknown',
    'too much tension': 'too_much_tension',
    'heat limits': 'heat_limits_tension',
}
#: identifiers of the learner's messages, by their beginnings
_LEARNER = {
    'learning is paused because lengths have jumped': 'learning_paused_lengths_jumped',
    'waiting for a checkpoint': 'no_checkpoint',
    'stopped by learner/enable': 'learning_disabled',
    'waiting for a length calibration': 'learning_waits_for_calibration',
    'checking new length offsets': 'checking_offsets',
    'paused by an anomaly': 'learning_paused_by_anomaly',
    'no usable data': 'no_usable_data',
}


def statements(
    estimator: Estimator, controller: Controller, learner: Learner, now: float
) -> list[Statement]:
    """Return what the nodes state at the time `now` of the steady clock [s]."""
    if hasattr(estimator, 'conditions'):
        cores: dict[str, Any] = {
            'estimator': estimator,
            'controller': controller,
            'learner': learner,
        }
        robot = estimator.robot
        return [
            Statement(
                owner,
                each.identifier,
                each.level,
                each.text,
                tuple(each.steps),
                frozenset(each.subjects) or named(robot, each.text),
            )
            for owner, core in cores.items()
            for each in core.conditions(now)
        ]
    of_estimator = list(_of_estimator(estimator, now))
    return [*of_estimator, *_of_controller(controller, estimator, now), *_of_learner(learner)]


def troubles(all_statements: Iterable[Statement]) -> list[Statement]:
    """Return the statements that are warnings or errors."""
    return [each for each in all_statements if each.level != 'ok']


def named(robot: Robot, text: str) -> frozenset[str]:
    """Return the muscles and joints that a text names."""
    names = (*robot.muscles, *robot.joints)
    return frozenset(
        name for name in names if re.search(rf'(?<![\w-]){re.escape(name)}(?![\w-])', text)
    )


def _of_estimator(core: Estimator, now: float) -> Iterable[Statement]:
    report = core.report(now)
    values, robot = report.values, core.robot
    state, text = values.get('state', ''), report.message
    if state == 'anomaly' and core.suspects.finding is not None:
        finding = core.suspects.finding
        subjects = named(robot, finding.evidence)
        if not subjects & {*robot.joints}:  # the muscle is only affected by a joint sensor
            subjects |= {robot.muscles[finding.muscle]}
        steps = parse(values.get(REMEDY_STEPS, ''))
        yield Statement('estimator', finding.kind.value, report.level, text, steps, subjects)
    elif state != 'isolated' and report.level != 'ok':
        yield Statement('estimator', state, report.level, text, (), named(robot, text))
    if isolated := values.get('isolated muscles'):  # the status line shows them in any state
        steps = (*REPAIR[:1] * bool(core.suspects.faults), Step.RESTORE_MUSCLES)
        if core.suspects.verification is not None:
            steps = ()
        text = f'isolated: {values.get("isolated muscles with faults", isolated)}'
        subjects = frozenset(isolated.split(', '))
        yield Statement('estimator', 'muscles_isolated', 'warn', text, steps, subjects)


def _of_controller(core: Controller, estimator: Estimator, now: float) -> Iterable[Statement]:
    report = core_report(core, now)
    values, robot = report.values, core.robot
    steps = parse(values.get(REMEDY_STEPS, ''))
    if estimator.suspects.finding is not None:
        # As in the status line, the estimator knows the remedy of its finding better.
        steps = tuple(step for step in steps if step not in REPAIR)
        if estimator.suspects.verification is not None:
            steps = ()
    if causes := stops.parse(values.get(stops.STOP_CAUSES, '')):
        for number, cause in enumerate(causes):
            text = report.message if number == 0 else f'also {cause.text}'
            subjects = named(robot, report.message if len(causes) == 1 else '')
            yield Statement(
                'controller', cause.identifier, report.level, text, steps * (number == 0), subjects
            )
        return
    if cause := values.get(WAITS_FOR):
        yield Statement('controller', cause, report.level, report.message)
    elif report.level != 'ok':
        for text in report.message.split('; '):
            known = (name for start, name in _WARNINGS.items() if text.startswith(start))
            # A text may itself contain a semicolon; its second part is no further statement.
            if identifier := next(known, ''):
                mine = steps if identifier == 'not_exploring' else ()
                subjects = named(robot, text)
                yield Statement('controller', identifier, report.level, text, mine, subjects)


def core_report(core: Controller, now: float) -> Any:
    """Return the report of a controller."""
    from musculoskeletal_ae.control import status  # replaced by `conditions`

    return status.report(core, now)


def _of_learner(core: Learner) -> Iterable[Statement]:
    report = core.report()
    if report.level != 'ok':
        text = report.message
        known = (name for start, name in _LEARNER.items() if text.startswith(start))
        identifier = next(known, 'learner_trouble')
        if core.offset_check.problem and identifier == 'learner_trouble':
            identifier = 'offsets_disagree'
        yield Statement('learner', identifier, report.level, text, (), named(core.robot, text))
