# SPDX-License-Identifier: Apache-2.0
"""Estimation before and after learning: with a weight, every muscle cut in turn, an hour healthy.

Before and after see one recording: the held-out motion, with 3.6 kg from its middle on; then,
weight in hand, one muscle after the other is cut while it carries tension (more than 10 N above
T_bias), stays cut for 3 s and is mended. False alarms are counted in another motion, an hour over
all individuals, in which the weight is grasped and released every minute.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from musculoskeletal_ae.experiments.least_squares import mean_error
from musculoskeletal_ae.experiments.online_learning import HELD_OUT_STREAM, held_out_error
from musculoskeletal_ae.experiments.recording import Recording, motion, record
from musculoskeletal_ae.experiments.suite.alarms import anomaly_levels, detection, slack_auroc
from musculoskeletal_ae.experiments.suite.detection import Watched, watch
from musculoskeletal_ae.experiments.suite.learning import HELD_OUT
from musculoskeletal_ae.experiments.suite.rivals import rivals
from musculoskeletal_ae.experiments.suite.scenario import (
    GraspAndCut,
    ScriptedArm,
    grasping,
    message_rows,
)
from musculoskeletal_ae.experiments.suite.study import Measured, Progress, Study

HEALTHY_STREAM = 9500


def measure(study: Study, seed: int, progress: Progress) -> Measured:
    """Return the numbers and traces of one individual."""
    robot = study.body()
    before, after = study.initial(robot), study.learnt(robot, seed)
    plan = GraspAndCut(robot, study.held_out_time, seed)
    driven_by = study.initial(robot, 'default')
    goals = motion(robot, driven_by, HELD_OUT_STREAM, plan.duration)
    taken = record(ScriptedArm(robot, seed, plan), goals)
    progress(0.3)
    goals = motion(robot, driven_by, HEALTHY_STREAM + seed, study.healthy_time)
    healthy = record(ScriptedArm(robot, seed, grasping), goals)
    progress(0.4)
    watched = {'before': watch(robot, before, taken), 'after': watch(robot, after, taken)}
    well = {'before': watch(robot, before, healthy), 'after': watch(robot, after, healthy)}
    progress(0.1)
    numbers: dict[str, Any] = dict(_errors(plan, taken, watched))
    numbers.update(anomaly_levels(plan, watched, well))
    for when, mae in (('before_', before), ('', after)):
        numbers[f'a_{when}slack_auroc'] = slack_auroc(robot, mae, taken, plan)
    numbers.update(detection(robot, plan, watched['after'], well['after'], after))
    held_out = study.stream(seed, HELD_OUT)
    numbers['before_held_out_rad'] = held_out_error(before, held_out)
    numbers['after_held_out_rad'] = held_out_error(after, held_out)
    numbers['baselines'] = rivals(study, seed, held_out)
    traces = {
        'theta': taken.theta,
        'before': watched['before']._asdict(),
        'after': watched['after']._asdict(),
        'grasp': plan.grasp,
        'cut': plan.cut,
        'first_cut': plan.order[0],
        'threshold': numbers['threshold'],
    }
    return Measured(numbers, traces)


def _errors(plan: GraspAndCut, taken: Recording, watched: dict[str, Watched]) -> dict[str, float]:
    free, loaded = message_rows(0.0, plan.grasp), message_rows(plan.grasp, 2.0 * plan.grasp)
    numbers = {}
    for when, seen in watched.items():
        numbers[f'{when}_rad'] = mean_error(seen.theta[free], taken.theta[free])
        numbers[f'{when}_payload_rad'] = mean_error(seen.theta[loaded], taken.theta[loaded])
        cut = np.concatenate([plan.while_cut(seen.theta - taken.theta, m) for m in plan.order])
        numbers[f'{when}_ruptured_rad'] = float(np.linalg.norm(cut, axis=1).mean())
    return numbers
