# SPDX-License-Identifier: Apache-2.0
"""The learner's status on /diagnostics."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.learning.detector_calibration import is_learned
from musculoskeletal_ae.learning.scheduler import Update
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.robot import Robot

if TYPE_CHECKING:
    from musculoskeletal_ae.learning.learner import Learner

#: Report that a learner has nothing to learn if it has received no usable message for this time
#: [s]. Shorter gaps are left to the estimator, which reports what makes messages unusable.
LONGEST_IDLE = 5.0


def learner_report(learner: Learner) -> Report:
    """Return the report on a learner for /diagnostics: its values and conditions."""
    present = learner_conditions(learner)
    return Report('' if present else 'learning', _values(learner), present)


def learner_conditions(learner: Learner) -> tuple[Condition, ...]:
    """Return a learner's conditions for users: why it does not learn, or what is not on disk."""
    return (*_failures(learner), *_obstacles(learner))


def _failures(learner: Learner) -> Iterator[Condition]:
    kind = ConditionKind
    if problem := learner.trainer.trouble:
        yield kind.TRAINING_FAILED.condition(problem)
    if problem := learner.keeper.trouble:
        yield kind.STATE_NOT_SAVED.condition(problem, ['learner'], level='error')
    if offsets := learner.impossible_offsets:
        detail = ', '.join(f'{joint} ({text})' for joint, text in offsets.items())
        yield kind.SENSOR_OFFSET_IMPOSSIBLE.condition(detail, offsets)


def _obstacles(learner: Learner) -> Iterator[Condition]:
    kind, offsets = ConditionKind, learner.body.offsets
    if learner.checkpoint is None:
        yield kind.NO_CHECKPOINT.condition(steps=[Step.PROVIDE_CHECKPOINT])
    if not learner.enabled:
        yield kind.LEARNING_DISABLED.condition()
    if not offsets.known:
        yield kind.LEARNING_WAITS.condition('the length offsets are unknown')
    if learner.body.has_anomaly:
        yield kind.LEARNING_WAITS.condition('there is an anomaly')
    can_learn = learner.enabled and offsets.known and not learner.body.has_anomaly
    if can_learn and learner.idle_time > LONGEST_IDLE:
        detail = f'no usable data for {learner.idle_time:.0f} s: {learner.collector.obstacle}'
        yield kind.NOTHING_TO_LEARN.condition(detail)


def _values(learner: Learner) -> dict[str, str]:
    keeper, collector = learner.keeper, learner.collector
    values = {
        'samples': str(len(learner.samples)),
        'accepted': str(learner.samples.accepted),
        'checkpoints': str(keeper.published),
        'checkpoint version': str(0 if keeper.mae is None else keeper.mae.version),
        'network learned': str(keeper.mae is not None and is_learned(keeper.mae)),
        'samples to begin with': str(learner.scheduler.least_samples),
        'preset': learner.trainer.preset.name,
        'healthy time': f'{collector.healthy.time:.0f} s',
        **learner.trainer.values(),
    }
    if learner.isolated:
        values['isolated muscles'] = learner.robot.names(learner.isolated)
    values |= keeper.values()
    if learner.last_update is not None:
        values |= _update_values(learner.robot, learner.last_update)
    return values | {f'not learned: {reason}': str(n) for reason, n in collector.rejected.items()}


def _update_values(robot: Robot, update: Update) -> dict[str, str]:
    values = {
        'error at newest samples': robot.units.errors_text(update.errors) or 'nan rad',
        'loss': f'{update.loss:.4f}',
        'update': f'{update.seconds:.2f} s',
        'anomaly calibrated': str(update.mae.is_calibrated),
    }
    if update.unchanged:
        values['network unchanged'] = update.unchanged
    if len(update.noise):
        worst = int(update.noise.argmax())
        values['length noise'] = f'{1e3 * update.noise[worst]:.2f} mm ({robot.muscles[worst]})'
    if len(update.remainder):
        worst = int(update.remainder.argmax())
        size = 1e3 * update.remainder[worst]
        values['not expressed by the body model'] = f'{size:.2f} mm ({robot.muscles[worst]})'
    return values
