# SPDX-License-Identifier: Apache-2.0
"""The learner's status on /diagnostics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from musculoskeletal_ae.learning.calibration import is_calibrated, is_learned
from musculoskeletal_ae.learning.collector import NO_MESSAGES
from musculoskeletal_ae.learning.job import Update
from musculoskeletal_ae.report import (
    ANOMALY,
    LENGTH_OFFSETS,
    MUSCLE_STATES,
    WAITS_FOR,
    Level,
    Report,
)
from musculoskeletal_ae.robot.robot import Robot

if TYPE_CHECKING:
    from musculoskeletal_ae.learning.learner import Learner

LONGEST_IDLE = 5.0  # time without a usable message after which the status is a warning [s]


def learner_report(learner: Learner) -> Report:
    """Return the status of a learner."""
    level: Level = 'warn'
    waits_for = {}
    if trouble := learner.trouble:
        level, message = 'error', trouble
    elif learner.checkpoint is None:
        message = 'waiting for a checkpoint: set the parameter `checkpoint`'
    elif not learner.enabled:
        message = 'stopped by learner/enable; call it with true to resume'
    elif not learner.body.offsets.known:
        message = 'waiting for a length calibration; if none is in progress, call estimator/zero'
        waits_for = {WAITS_FOR: LENGTH_OFFSETS}
    elif not learner.offset_check.is_believed:
        message = 'checking new length offsets against muscle_states'
    elif learner.collector.is_anomaly:
        message = 'paused by an anomaly until its suspect is verified or estimator/reset is called'
        waits_for = {WAITS_FOR: ANOMALY}
    elif (idle_time := learner.idle_time) > LONGEST_IDLE:
        message = f'no usable data for {idle_time:.0f} s: {learner.collector.obstacle}'
        if learner.collector.obstacle == NO_MESSAGES:
            waits_for = {WAITS_FOR: MUSCLE_STATES}
    else:
        level, message = 'ok', 'learning'
    return Report(level, message, {**_values(learner), 'state': message, **waits_for})


def _values(learner: Learner) -> dict[str, str]:
    keeper, collector = learner.keeper, learner.collector
    values = {
        'samples': str(len(learner.samples)),
        'accepted': str(learner.samples.accepted),
        'checkpoints': str(keeper.publication.count),
        'checkpoint version': str(0 if keeper.mae is None else keeper.mae.version),
        'network learned': str(keeper.mae is not None and is_learned(keeper.mae)),
        'samples to begin with': str(learner.scheduler.least_samples),
        'preset': learner.trainer.preset.name,
        'healthy time': f'{collector.healthy.time:.0f} s',
        **learner.trainer.values(),
    }
    history = learner.offset_history
    if history.dropped or history.corrected:
        values['samples dropped with wrong length offsets'] = str(history.dropped)
        values['samples corrected for wrong length offsets'] = str(history.corrected)
    if learner.isolated:
        values['isolated muscles'] = learner.robot.names(learner.isolated)
    values |= keeper.values()
    if learner.last_update is not None:
        values |= _update_values(learner.robot, learner.last_update)
    return values | {f'not learned: {reason}': str(n) for reason, n in collector.rejected.items()}


def _update_values(robot: Robot, update: Update) -> dict[str, str]:
    values = {
        'error at newest samples': f'{update.error:.4f} {robot.kinematics.distance_unit}',
        'loss': f'{update.loss:.4f}',
        'update': f'{update.seconds:.2f} s on {update.device}',
        'anomaly calibrated': str(is_calibrated(update.mae)),
    }
    if len(update.noise):
        worst = int(update.noise.argmax())
        values['length noise'] = f'{1e3 * update.noise[worst]:.2f} mm ({robot.muscles[worst]})'
    return values
