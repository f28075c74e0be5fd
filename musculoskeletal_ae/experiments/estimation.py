# SPDX-License-Identifier: Apache-2.0
"""State estimation and anomaly.

Paper (§IV-B). The same motions before and after learning, 0.414 → 0.186 rad; the error did not rise
much when a 3.6 kg dumbbell was grasped; when muscle #2 was deactivated, A rose after learning but
hardly before.

Here. One recording, seen by the networks before and after learning: the held-out motion, with 3.6
kg in the hand from its middle on; then, weight in hand, every muscle in turn is cut for 3 s and
mended. A cut comes when the muscle carries more than 10 N above T_bias (waiting up to 14 s; a
muscle that never does is cut all the same, shown in grey, and not counted). Messages go one by one
through the detector of the estimator node; detection is the first alarm that begins after the cut,
and a cut that is not noticed counts 3 s. The right muscle is named if it is the suspect in that
message. In a second recording, with 20 s of motion before and 20 s after the grasp, every muscle in
turn is switched off instead, as printed: its module is commanded no tension for 3 s, the wire is
whole ("switched off"). Healthy messages: the held-out motion and another one with the weight
grasped and released every minute, an hour over all individuals; false alarms are alarms that begin
in the latter. AUROC compares d of those with d of cut messages from 0.1 s after the cut.
"Threshold" is the detector’s, for d; A and d "ruptured min" are the smallest, over muscles, of the
median while cut. The preset as printed decides on A alone.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.baselines import baseline_errors
from musculoskeletal_ae.experiments.detection import (
    CUT_TIME,
    PAYLOAD,
    GraspAndCut,
    anomaly_levels,
    detection,
    grasp_and_release,
    watch,
)
from musculoskeletal_ae.experiments.recording import (
    HELD_OUT_STREAM,
    SAMPLE_TIME,
    Motion,
    estimation_error,
    mean_error,
    record,
    rows_between,
    times,
)
from musculoskeletal_ae.experiments.roles import plotted
from musculoskeletal_ae.experiments.study import Experiment, Measured, Plot, Rows, Study, first
from musculoskeletal_ae.presets.registry import AS_PRINTED

HEALTHY_STREAM = 9500
HEALTHY_TIME = 3600.0  # [s] of motion for false alarms, over all individuals
SHOWN = 60.0  # [s] before the grasp
TAIL = 3.0  # [s] after the mending
OFF_TIME = 40.0  # [s] of motion before muscles are switched off
#: moments of the appearance [s]: ends of the motion's cycles, without weight and with it
MOMENTS = {'after 10 s': 9.9, 'after 20 s': 19.9, 'weight grasped': 29.9, 'weight, 40 s': 39.9}
OFF = 'switched_off'
NOTICED = ('detection_s', 'detected_share', 'named_share')  # of muscles switched off


def measure(study: Study, seed: int) -> Measured:
    """Return the numbers and traces of one individual."""
    robot, networks = study.robot, study.networks(seed)
    printed = study.network(seed, AS_PRINTED)
    plan = GraspAndCut(robot, study.held_out_time, seed)
    driven_by = study.network(None, 'default')
    taken = record(study.arm(seed), driven_by, HELD_OUT_STREAM, plan.duration, plan)
    duration = 10.0 if study.quick else HEALTHY_TIME / len(study.seeds)
    stream = HEALTHY_STREAM + seed
    healthy = record(study.arm(seed), driven_by, stream, duration, grasp_and_release)
    plan_idle = GraspAndCut(robot, OFF_TIME, seed, switched_off=True)
    idle = record(study.arm(seed), driven_by, HELD_OUT_STREAM, plan_idle.duration, plan_idle)
    watched, well, watched_idle = (
        {when: watch(robot, mae, recording) for when, mae in networks.items()}
        for recording in (taken, healthy, idle)
    )
    numbers: dict[str, Any] = {}
    for when, seen in watched.items():
        for key, rows in (('', plan.free), ('payload_', plan.loaded)):
            numbers[f'{when}_{key}rad'] = mean_error(seen.theta[rows], taken.theta[rows])
        off = np.concatenate([(seen.theta - taken.theta)[plan.while_cut(m)] for m in plan.order])
        numbers[f'{when}_ruptured_rad'] = mean_error(off, np.zeros_like(off))
    numbers |= anomaly_levels(plan_idle, watched_idle, well, OFF)
    numbers |= anomaly_levels(plan, watched, well, 'ruptured')
    numbers['auroc'] = numbers['d_ruptured_auroc']
    noticed = detection(robot, plan_idle, watched_idle['after'], well['after'], networks['after'])
    numbers |= {f'{OFF}_{key}': noticed[key] for key in NOTICED}
    numbers |= detection(robot, plan, watched['after'], well['after'], networks['after'])
    by_a, well_by_a = (watch(robot, printed, each) for each in (taken, healthy))
    numbers |= study.keyed(AS_PRINTED, detection(robot, plan, by_a, well_by_a, printed))
    held_out = study.stream(seed, 'held_out')
    for when, mae in networks.items():
        numbers[f'{when}_held_out_rad'] = estimation_error(mae, held_out)
    exploring = study.stream(seed, 'exploring')
    numbers['baselines'] = baseline_errors(robot, study.rests(seed), exploring, held_out)
    second = plan_idle.order[0]
    at = float(plan_idle.cut[second]) + 0.9 * CUT_TIME
    moments = MOMENTS | {f'#{second + 1} switched off': at}
    steps = [round(time / SAMPLE_TIME) for time in moments.values()]
    postures = {'arm': idle.theta}
    postures |= {f'{when} learning': seen.theta for when, seen in watched_idle.items()}
    pulls = idle.tension[steps]
    traces = {
        'moments': list(moments),
        'seen': {name: Motion(theta[steps], pulls) for name, theta in postures.items()},
        'theta': taken.theta,
        'watched': watched,
        'grasp': plan.grasp,
        'first_cut': robot.muscles[plan.order[0]],
        'cut': float(plan.cut[plan.order[0]]),
    }
    return Measured(numbers, traces)


def _shown(trace: Mapping[str, Any]) -> tuple[slice, Any]:
    """Return the messages round grasp and first cut, and their times [s]."""
    start = max(0.0, trace['grasp'] - SHOWN)
    rows = rows_between(start, trace['cut'] + CUT_TIME + TAIL)
    return rows, start + times(len(trace['theta'][rows]))


def _mark(axes: Any, trace: Mapping[str, Any]) -> None:
    axes.axvline(trace['grasp'], color=plots.MARK, ls='--', lw=1)
    axes.axvspan(trace['cut'], trace['cut'] + CUT_TIME, color='#F0E442', alpha=0.5, lw=0)


def grasp_and_cut(_: Study, rows: Rows) -> Plot:
    """Draw error, A and d through grasp and cut."""
    seed, (numbers, trace) = first(rows)
    shown, time = _shown(trace)
    figure, panels = plots.new_figure(12.0, 8.0, 3, sharex=True)
    for panel in panels:
        panel.set_yscale('log')
        _mark(panel, trace)
    for when, colour in plots.WHEN.items():
        seen = trace['watched'][when]
        free, loaded = numbers[f'{when}_rad'], numbers[f'{when}_payload_rad']
        label = f'{when} learning ({free:.3f} rad,\nwith weight {loaded:.3f} rad)'
        error = np.linalg.norm(seen.theta - trace['theta'], axis=1)[shown]
        plots.line(panels[0], time, error, 50, color=colour, lw=1, label=label)
        for panel, values in zip(panels[1:], (seen.anomaly, seen.distance), strict=True):
            plots.line(panel, time, values[shown], color=colour, lw=1, label=f'{when} learning')
    panels[2].axhline(numbers['threshold'], color=plots.TRUE, ls=':', label="detector's threshold")
    for at, text in ('grasp', f'grasps {PAYLOAD:g} kg'), ('cut', f'{trace["first_cut"]} cut'):
        place = {'transform': panels[0].get_xaxis_transform(), 'ha': 'center'}
        panels[0].text(trace[at], 1.02, text, **place)
    plots.tidy(panels[0], '', '‖θ_est − θ‖ [rad], 0.5 s mean', legend='right')
    plots.tidy(panels[1], '', 'A [scaled units]', legend='right')
    plots.tidy(panels[2], 'time [s]', 'd [healthy std. dev.]', legend='right')
    figure.suptitle(f'individual {seed}')
    return figure, (
        'Estimation error, the anomaly A, and the distance d that the detector judges, on '
        f'the same recording before and after learning: the arm grasps {PAYLOAD:g} kg (dashed), '
        f'then {trace["first_cut"]} is cut (yellow) and mended.'
    )


def appearance(study: Study, rows: Rows) -> Plot:
    """Draw arm and estimates at some moments of the experiment."""
    seed, (_, trace) = first(rows)
    moments = {name: step for step, name in enumerate(trace['moments'])}
    title = f'individual {seed}, estimated from lengths and tensions'
    return plots.pictures(study.robot, trace['seen'], moments, title), (
        f'The arm (true posture) and its estimates along the experiment: it moves, grasps '
        f'{PAYLOAD:g} kg, and loses a muscle that is switched off. Colours: measured tensions.'
    )


def tracking(study: Study, rows: Rows) -> Plot:
    """Draw the joint angles through grasp and cut."""
    (seed, (_, trace)), robot = first(rows), study.robot
    shown, time = _shown(trace)
    count = robot.joint_count
    figure, panels = plots.new_figure(12.0, 1.6 * count + 0.8, count, sharex=True)
    for joint, panel in enumerate(panels):
        factor, unit = plotted(robot, joint)
        for when, colour in plots.WHEN.items():
            theta = factor * trace['watched'][when].theta[shown, joint]
            plots.line(panel, time, theta, color=colour, lw=0.8, label=f'{when} learning')
        true = factor * trace['theta'][shown, joint]
        plots.line(panel, time, true, color=plots.TRUE, lw=1.2, label='true')
        span = np.ptp(true) + 1.0
        panel.set_ylim(true.min() - 0.4 * span, true.max() + 0.4 * span)
        _mark(panel, trace)
        plots.tidy(panel, '', f'{robot.joints[joint]}\n[{unit}]')
    plots.tidy(panels[0], '', panels[0].get_ylabel(), f'individual {seed}', legend='above')
    panels[-1].set_xlabel('time [s]')
    return figure, (
        'Joint angles of the same minutes: true, and estimated before and after learning. Dashed: '
        'grasp; yellow: muscle cut.'
    )


def cuts(study: Study, rows: Rows) -> Plot:
    """Draw level and detection of every muscle's cut."""
    robot, numbers = study.robot, [row.numbers for row in rows.values()]
    figure, panels = plots.new_figure(12.0, 0.42 * robot.muscle_count + 1.9, 1, 3, sharey=True)
    place = np.arange(robot.muscle_count)
    labels = 'A [scaled units]', 'd [healthy std. dev.]'
    for letter, panel, label in zip('ad', panels, labels):
        for when, prefix, shift in (('before', '_before', -0.18), ('after', '', 0.18)):
            colour = plots.WHEN[when]
            for each in numbers:
                level = each[f'{letter}{prefix}_ruptured']
                panel.plot(level, place + shift, 'o', color=colour, alpha=0.6, ms=5)
            calm = max(each[f'{letter}{prefix}_healthy_max'] for each in numbers)
            panel.plot([], [], 'o', color=colour, label=f'cut, {when} learning')
            panel.axvline(calm, color=colour, ls='--', lw=1, label=f'largest healthy, {when}')
        # A logarithmic axis that begins and ends with a labelled tick.
        low, high = panel.dataLim.intervalx
        panel.set_xscale('log')
        panel.set_xlim(10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high)))
        plots.tidy(panel, label, legend='below')
    panel = panels[2]
    for each in numbers:
        for m, cut in enumerate(each['cuts'].values()):
            marker = 'o' if cut['named'] else 'x'
            colour = plots.AFTER if cut['carried'] else plots.MARK
            panel.plot(cut['detection_s'], m, marker, color=colour, ms=6, mfc='none')
    panel.axvline(0.5, color=plots.TRUE, ls=':', label='aim: 0.5 s')
    panel.axvline(CUT_TIME, color=plots.BEFORE, ls=':', label='not noticed')
    for marker, colour, label in (
        ('o', plots.AFTER, 'named'),
        ('x', plots.AFTER, 'other muscle named'),
        ('o', plots.MARK, 'slack when cut'),
    ):
        panel.plot([], [], marker, color=colour, mfc='none', label=label)
    panel.set(xscale='log', xlim=(0.008, 1.3 * CUT_TIME))
    plots.tidy(panel, 'time to detection [s]', legend='below')
    panels[0].set_yticks(place, robot.muscles)
    panels[0].invert_yaxis()
    figure.suptitle('every muscle cut in turn, one point per individual')
    return figure, (
        'Median of A and of d while each muscle is cut, beside the largest value in healthy '
        'motion (points right of the dashed line of their colour can be told from it), and how '
        'long the calibrated detector took.'
    )


def baselines(study: Study, rows: Rows) -> Plot:
    """Draw the errors of older estimators beside the autoencoder's."""
    numbers = [row.numbers for row in rows.values()]
    names = [f'autoencoder, preset {study.preset}', *numbers[0]['baselines']]
    groups = {}
    for when, colour in plots.WHEN.items():
        ours = [each[f'{when}_held_out_rad'] for each in numbers]
        older = [[row[f'{when}_rad'] for row in each['baselines'].values()] for each in numbers]
        groups[f'{when} learning'] = colour, np.column_stack([ours, older])
    figure, (panel,) = plots.new_figure(9.0, 0.62 * len(names) + 1.3)
    title = 'estimators on the same data'
    plots.bars(panel, names, groups, 'mean error [rad], held-out motion', title)
    return figure, (
        'Joint angle error of the autoencoder and of older estimators on the held-out motion. '
        'Learning: from the same samples at rest; "whole stream": from all messages at 10 Hz. '
        'Dots: individuals. The geometric model has nothing to learn.'
    )


PLOTS = (appearance, grasp_and_cut, tracking, cuts, baselines)
EXPERIMENT = Experiment(__doc__, measure, PLOTS, 7.0)
