# SPDX-License-Identifier: Apache-2.0
"""Numbers of the anomaly: how high A and d stand, how soon and how rightly a cut is found."""

from __future__ import annotations

from typing import Any

import numpy as np

from musculoskeletal_ae.estimation.anomaly import DISTANCE
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, Recording
from musculoskeletal_ae.experiments.suite.detection import Watched, alarms_begun, anomaly, auroc
from musculoskeletal_ae.experiments.suite.scenario import (
    CARRYING,
    CUT_TIME,
    GraspAndCut,
    message_rows,
)
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot


def anomaly_levels(
    plan: GraspAndCut, watched: dict[str, Watched], well: dict[str, Watched]
) -> dict[str, Any]:
    """Return A and d: the largest of the healthy messages, the smallest level of a cut.

    The level of a cut is the median over the messages between cut and mending.
    """
    numbers: dict[str, Any] = {}
    motion_only = message_rows(0.0, 2.0 * plan.grasp)
    counted = [m for m in plan.order if plan.carried[m]] or plan.order
    for when, prefix in (('before', '_before'), ('after', '')):
        for name, letter in (('anomaly', 'a'), ('distance', 'd')):
            calm = np.concatenate(
                [getattr(watched[when], name)[motion_only], getattr(well[when], name)]
            )
            cuts = [plan.while_cut(getattr(watched[when], name), m) for m in range(len(plan.cut))]
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


def slack_auroc(robot: Robot, mae: Mae, taken: Recording, plan: GraspAndCut) -> float:
    """Return how well A tells a muscle switched off from healthy messages, as AUROC.

    The paper switches a muscle off, so that it goes slack while l follows the joints on; here cut
    wires let the module wind in, which no network can overlook. So what the paper did is judged
    on messages of the loaded motion in which one muscle's tension is replaced by none.
    """
    rows = slice(round(plan.grasp / SAMPLE_TIME), round(2.0 * plan.grasp / SAMPLE_TIME), 10)
    tension, length = taken.tension[rows], taken.length[rows]
    slack = []
    for muscle in range(robot.muscle_count):
        carried = tension[:, muscle] > robot.tension.bias + CARRYING
        off = tension[carried].copy()
        off[:, muscle] = 0.0
        slack.append(anomaly(mae, off, length[carried]))
    return auroc(anomaly(mae, tension, length), np.concatenate(slack))


def detection(
    robot: Robot, plan: GraspAndCut, seen: Watched, well: Watched, mae: Mae
) -> dict[str, Any]:
    """Return how fast and how rightly cuts were found, and what was found that was none.

    A cut that was not found counts with the time it lasted.
    """
    delay = np.full(len(plan.cut), CUT_TIME)
    named = np.zeros(len(plan.cut), dtype=bool)
    found = np.zeros(len(plan.cut), dtype=bool)
    for muscle, cut in enumerate(plan.cut):
        rows = message_rows(float(cut), float(cut) + CUT_TIME)
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
        'false_alarms_beside_cuts': alarms_begun(seen.alarm & ~plan.disturbed(len(seen.alarm))),
        'healthy_s': SAMPLE_TIME * len(well.alarm),
    }
