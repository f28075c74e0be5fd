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
from numpy.typing import NDArray

from musculoskeletal_ae.experiments.least_squares import mean_error
from musculoskeletal_ae.experiments.online_learning import HELD_OUT_STREAM, held_out_error
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, Recording, motion, record
from musculoskeletal_ae.experiments.suite.detection import Watched, alarms_begun, auroc, watch
from musculoskeletal_ae.experiments.suite.learning import HELD_OUT
from musculoskeletal_ae.experiments.suite.rivals import rivals
from musculoskeletal_ae.experiments.suite.scenario import (
    CUT_TIME,
    GraspAndCut,
    ScriptedArm,
    grasping,
)
from musculoskeletal_ae.experiments.suite.study import Measured, Progress, Study
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tasks.anomaly import DISTANCE

Array = NDArray[np.float64]

HEALTHY_STREAM = 9500
#: after a cut the tension falls within a few messages; A is judged from then until the mending
SETTLED = 0.1  # [s]
RECOVERED = 2.0  # [s] after the mending, while the arm swings back


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
    numbers.update(_anomalies(plan, watched, well))
    numbers.update(_detection(robot, plan, watched['after'], well['after'], after))
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


def _rows(start: float, end: float) -> slice:
    return slice(round(start / SAMPLE_TIME), round(end / SAMPLE_TIME))


def _errors(plan: GraspAndCut, taken: Recording, watched: dict[str, Watched]) -> dict[str, float]:
    free, loaded = _rows(0.0, plan.grasp), _rows(plan.grasp, 2.0 * plan.grasp)
    numbers = {}
    for when, seen in watched.items():
        numbers[f'{when}_rad'] = mean_error(seen.theta[free], taken.theta[free])
        numbers[f'{when}_payload_rad'] = mean_error(seen.theta[loaded], taken.theta[loaded])
        cut = np.concatenate([_after_cut(plan, seen.theta - taken.theta, m) for m in plan.order])
        numbers[f'{when}_ruptured_rad'] = float(np.linalg.norm(cut, axis=1).mean())
    return numbers


def _after_cut(plan: GraspAndCut, values: Array, muscle: int) -> Array:
    cut = float(plan.cut[muscle])
    return values[_rows(cut + SETTLED, cut + CUT_TIME)]


def _disturbed(plan: GraspAndCut, count: int) -> NDArray[np.bool_]:
    """Return in which messages a muscle is cut, or was until a moment ago."""
    disturbed = np.zeros(count, dtype=bool)
    for cut in plan.cut:
        disturbed[_rows(float(cut), float(cut) + CUT_TIME + RECOVERED)] = True
    return disturbed


def _anomalies(
    plan: GraspAndCut, watched: dict[str, Watched], well: dict[str, Watched]
) -> dict[str, Any]:
    """Return A and d: the largest of the healthy messages, the smallest level of a cut.

    The level of a cut is the median over the messages between cut and mending.
    """
    numbers: dict[str, Any] = {}
    motion_only = _rows(0.0, 2.0 * plan.grasp)
    counted = [m for m in plan.order if plan.carried[m]] or plan.order
    for when, prefix in (('before', '_before'), ('after', '')):
        for name, letter in (('anomaly', 'a'), ('distance', 'd')):
            calm = np.concatenate(
                [getattr(watched[when], name)[motion_only], getattr(well[when], name)]
            )
            cuts = [_after_cut(plan, getattr(watched[when], name), m) for m in range(len(plan.cut))]
            levels = [float(np.median(cut)) for cut in cuts]
            numbers[f'{letter}{prefix}_healthy_max'] = float(calm.max())
            numbers[f'{letter}{prefix}_healthy_median'] = float(np.median(calm))
            numbers[f'{letter}{prefix}_ruptured_min'] = min(levels[m] for m in counted)
            numbers[f'{letter}{prefix}_ruptured'] = levels
            numbers[f'{letter}{prefix}_auroc'] = auroc(
                calm, np.concatenate([cuts[m] for m in counted])
            )
    numbers['auroc'] = numbers['d_auroc']
    return numbers


def _detection(
    robot: Robot, plan: GraspAndCut, seen: Watched, well: Watched, mae: Mae
) -> dict[str, Any]:
    """Return how fast and how rightly cuts were found, and what was found that was none.

    A cut that was not found counts with the time it lasted.
    """
    delay = np.full(len(plan.cut), CUT_TIME)
    named = np.zeros(len(plan.cut), dtype=bool)
    found = np.zeros(len(plan.cut), dtype=bool)
    for muscle, cut in enumerate(plan.cut):
        rows = _rows(float(cut), float(cut) + CUT_TIME)
        # An alarm that was on before the cut has found nothing: only one that begins counts.
        before = np.append(False, seen.alarm)[rows]
        alarms = np.flatnonzero(seen.alarm[rows] & ~before)
        if len(alarms):
            found[muscle] = True
            delay[muscle] = SAMPLE_TIME * (alarms[0] + 1)
            named[muscle] = seen.suspect[rows][alarms[0]] == muscle
    counted = plan.carried if plan.carried.any() else np.ones_like(plan.carried)
    statistics = mae.anomaly
    threshold = statistics.thresholds.get(DISTANCE, 0.0) if statistics else 0.0
    return {
        'threshold': float(threshold),
        'calibrated': bool(statistics and statistics.calibrated),
        'detection_s': float(delay[counted].mean()),
        'detection_worst_s': float(delay[counted].max()),
        'detected_share': float(found[counted].mean()),
        'named_share': float(named[counted].mean()),
        'counted_cuts': int(counted.sum()),
        'cuts': {
            name: {
                'carried': bool(plan.carried[m]),
                'detected': bool(found[m]),
                'detection_s': float(delay[m]),
                'named': bool(named[m]),
            }
            for m, name in enumerate(robot.muscles)
        },
        'false_alarms': alarms_begun(well.alarm),
        'false_alarms_beside_cuts': alarms_begun(seen.alarm & ~_disturbed(plan, len(seen.alarm))),
        'healthy_s': SAMPLE_TIME * len(well.alarm),
    }
