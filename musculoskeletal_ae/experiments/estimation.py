# SPDX-License-Identifier: Apache-2.0
"""State estimation and anomaly.

One recording, seen by the networks before and after learning: the held-out motion, with 3.6 kg in
the hand from its middle on; then, weight in hand, every muscle in turn is cut for 3 s and mended. A
cut comes when the muscle carries more than 10 N above T_bias (waiting up to 14 s; a muscle that
never does is cut all the same, shown in grey, and not counted). Messages go one by one through the
detector of the estimator node; detection is the first alarm that begins after the cut, and a cut
that is not noticed counts 3 s. The right muscle is named if it is the suspect in that message.
Healthy messages: the held-out motion and another one with the weight grasped and released every
minute, an hour over all individuals; false alarms are alarms that begin in the latter. AUROC
compares d of those with d of cut messages from 0.1 s after the cut. "Threshold" is the detector’s,
for d; A and d "ruptured min" are the smallest, over muscles, of the median while cut.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.baselines import baseline_errors
from musculoskeletal_ae.experiments.detection import (
    CUT_TIME,
    PAYLOAD,
    GraspAndCut,
    Watched,
    anomaly_levels,
    detection,
    grasp_and_release,
    slack_auroc,
    watch,
)
from musculoskeletal_ae.experiments.recording import (
    HELD_OUT_STREAM,
    Recording,
    estimation_error,
    mean_error,
    record,
    rows_between,
    times,
)
from musculoskeletal_ae.experiments.roles import plotted
from musculoskeletal_ae.experiments.study import Experiment, Individuals, Measured, Progress, Study

HEALTHY_STREAM = 9500
SHOWN = 60.0  # [s] before the grasp
TAIL = 3.0  # [s] after the mending


def measure(study: Study, seed: int, progress: Progress) -> Measured:
    """Return the numbers and traces of one individual."""
    robot = study.body()
    networks = {'before': study.initial(robot), 'after': study.learned(robot, seed)}
    plan = GraspAndCut(robot, study.held_out_time, seed)
    driven_by = study.initial(robot, 'default')
    taken = record(EmulatedArm(robot, seed), driven_by, HELD_OUT_STREAM, plan.duration, plan)
    progress(0.3)
    arm, stream = EmulatedArm(robot, seed), HEALTHY_STREAM + seed
    healthy = record(arm, driven_by, stream, study.healthy_time, grasp_and_release)
    progress(0.4)
    watched = {when: watch(robot, mae, taken) for when, mae in networks.items()}
    well = {when: watch(robot, mae, healthy) for when, mae in networks.items()}
    progress(0.1)
    numbers: dict[str, Any] = {}
    for when, seen in watched.items():
        numbers.update(_errors(when, plan, taken, seen))
    numbers.update(anomaly_levels(plan, watched, well))
    for when, prefix in (('before', 'before_'), ('after', '')):
        numbers[f'a_{prefix}slack_auroc'] = slack_auroc(robot, networks[when], taken, plan)
    numbers.update(detection(robot, plan, watched['after'], well['after'], networks['after']))
    held_out = study.stream(seed, 'held_out')
    for when, mae in networks.items():
        numbers[f'{when}_held_out_rad'] = estimation_error(mae, held_out)
    exploring = study.stream(seed, 'exploring')
    numbers['baselines'] = baseline_errors(robot, study.rests(seed), exploring, held_out)
    traces = {
        'theta': taken.theta,
        **{when: seen._asdict() for when, seen in watched.items()},
        'grasp': plan.grasp,
        'first_cut': plan.order[0],
        'cut': float(plan.cut[plan.order[0]]),
        'threshold': numbers['threshold'],
    }
    return Measured(numbers, traces)


def _errors(when: str, plan: GraspAndCut, taken: Recording, seen: Watched) -> dict[str, float]:
    cut = np.concatenate([(seen.theta - taken.theta)[plan.while_cut(m)] for m in plan.order])
    return {
        f'{when}_rad': mean_error(seen.theta[plan.free], taken.theta[plan.free]),
        f'{when}_payload_rad': mean_error(seen.theta[plan.loaded], taken.theta[plan.loaded]),
        f'{when}_ruptured_rad': float(np.linalg.norm(cut, axis=1).mean()),
    }


def plot(individuals: Individuals) -> list[plots.Plot]:
    """Draw estimate and anomaly through grasp and cut, every muscle's cut, older estimators."""
    return [draw(individuals) for draw in (_course, _tracking, _cuts, _baselines)]


def _span(trace: Mapping[str, Any]) -> tuple[slice, Any]:
    start = max(0.0, trace['grasp'] - SHOWN)
    rows = rows_between(start, trace['cut'] + CUT_TIME + TAIL)
    return rows, start + times(len(trace['theta'][rows]))


def _events(axes: Any, trace: Mapping[str, Any]) -> None:
    axes.axvline(trace['grasp'], color=plots.MARK, ls='--', lw=1)
    axes.axvspan(trace['cut'], trace['cut'] + CUT_TIME, color='#F0E442', alpha=0.5, lw=0)


def _course(individuals: Individuals) -> plots.Plot:
    (seed, row), robot = individuals.first, individuals.robot
    trace = row.traces
    rows, time = _span(trace)
    figure, axes = plots.new_figure(12.0, 8.0, 3, 1, sharex=True)
    error_axes, a_axes, d_axes = axes[:, 0]
    for panel in axes[:, 0]:
        panel.set_yscale('log')
    for when, colour in plots.WHEN.items():
        seen = trace[when]
        style: dict[str, Any] = {'color': colour, 'lw': 1}
        error = np.linalg.norm(seen['theta'] - trace['theta'], axis=1)[rows]
        free, loaded = row.numbers[f'{when}_rad'], row.numbers[f'{when}_payload_rad']
        label = f'{when} learning ({free:.3f} rad, with weight {loaded:.3f} rad)'
        plots.line(error_axes, time, error, 50, label=label, **style)
        plots.line(a_axes, time, seen['anomaly'][rows], label=f'{when} learning', **style)
        plots.line(d_axes, time, seen['distance'][rows], label=f'{when} learning', **style)
    d_axes.axhline(trace['threshold'], color=plots.TRUE, ls=':', label="detector's threshold")
    name = robot.muscles[trace['first_cut']]
    above = error_axes.get_xaxis_transform()
    error_axes.text(trace['grasp'], 1.02, f'grasps {PAYLOAD:g} kg', transform=above, ha='center')
    error_axes.text(trace['cut'], 1.02, f'{name} cut', transform=above, ha='center')
    plots.tidy(error_axes, '', '‖θ_est − θ‖ [rad], 0.5 s mean')
    plots.tidy(a_axes, '', 'A [scaled units]')
    plots.tidy(d_axes, 'time [s]', 'd [healthy std. dev.]')
    for panel in axes[:, 0]:
        _events(panel, trace)
        panel.legend(loc='upper left', fontsize=9)
    figure.suptitle(f'individual {seed}')
    caption = (
        'Estimation error, the paper’s anomaly A, and the distance d that the detector judges, on '
        f'the same recording before and after learning: the arm grasps {PAYLOAD:g} kg (dashed), '
        f'then {name} is cut (yellow) and mended.'
    )
    return plots.Plot('grasp_and_cut', figure, caption)


def _tracking(individuals: Individuals) -> plots.Plot:
    (seed, row), robot = individuals.first, individuals.robot
    trace = row.traces
    rows, time = _span(trace)
    count = robot.joint_count
    figure, axes = plots.new_figure(12.0, 1.6 * count + 0.8, count, 1, sharex=True)
    for joint, panel in enumerate(axes[:, 0]):
        factor, unit = plotted(robot, joint)
        for when, colour in plots.WHEN.items():
            angle = factor * trace[when]['theta'][rows, joint]
            plots.line(panel, time, angle, color=colour, lw=0.8, label=f'{when} learning')
        true = factor * trace['theta'][rows, joint]
        plots.line(panel, time, true, color=plots.TRUE, lw=1.2, label='true')
        span = np.ptp(true) + 1.0
        panel.set_ylim(true.min() - 0.4 * span, true.max() + 0.4 * span)
        _events(panel, trace)
        plots.tidy(panel, '', f'{robot.joints[joint]}\n[{unit}]')
    axes[0, 0].legend(loc='lower left', ncols=3, fontsize=9)
    axes[0, 0].set_title(f'individual {seed}')
    axes[-1, 0].set_xlabel('time [s]')
    caption = (
        'Joint angles of the same minutes: true, and estimated before and after learning. Dashed: '
        'grasp; yellow: muscle cut.'
    )
    return plots.Plot('tracking', figure, caption)


def _cuts(individuals: Individuals) -> plots.Plot:
    robot, numbers = individuals.robot, individuals.numbers
    figure, axes = plots.new_figure(12.0, 0.42 * robot.muscle_count + 1.9, 1, 3, sharey=True)
    place = np.arange(robot.muscle_count)
    for letter, panel, label in (
        ('a', axes[0, 0], 'A of the paper [scaled units]'),
        ('d', axes[0, 1], 'd [healthy std. dev.]'),
    ):
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
        plots.tidy(panel, label)
    panel = axes[0, 2]
    for each in numbers:
        for m, cut in enumerate(each['cuts'].values()):
            marker, colour = (
                'o' if cut['named'] else 'x',
                plots.AFTER if cut['carried'] else plots.MARK,
            )
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
    plots.tidy(panel, 'time to detection [s]')
    for panel in axes[0]:
        panel.legend(fontsize=8, loc='upper center', bbox_to_anchor=(0.5, -0.16), ncols=2)
    axes[0, 0].set_yticks(place, robot.muscles)
    axes[0, 0].invert_yaxis()
    figure.suptitle('every muscle cut in turn, one point per individual')
    caption = (
        'Median of A and of d while each muscle is cut, beside the largest value in healthy '
        'motion (points right of the dashed line of their colour can be told from it), and how '
        'long the calibrated detector took.'
    )
    return plots.Plot('cuts', figure, caption)


def _baselines(individuals: Individuals) -> plots.Plot:
    numbers = individuals.numbers
    names = [f'autoencoder, preset {individuals.study.preset}', *numbers[0]['baselines']]
    figure, axes = plots.new_figure(9.0, 0.62 * len(names) + 1.3)
    panel = axes[0, 0]
    place = np.arange(len(names))
    for when, shift in (('before', -0.2), ('after', 0.2)):
        values = np.array(
            [[n[f'{when}_held_out_rad'] for n in numbers]]
            + [[n['baselines'][name][f'{when}_rad'] for n in numbers] for name in names[1:]]
        )
        mean = values.mean(axis=1)
        panel.barh(place + shift, mean, 0.38, color=plots.WHEN[when], label=f'{when} learning')
        for at, number, furthest in zip(place + shift, mean, values.max(axis=1), strict=True):
            style = {'xytext': (6, 0), 'textcoords': 'offset points', 'va': 'center'}
            panel.annotate(f'{number:.3f}', (furthest, at), fontsize=9, **style)
        for each in values.T:
            panel.plot(each, place + shift, '.', color=plots.TRUE, ms=4)
    panel.set_yticks(place, names)
    panel.invert_yaxis()
    panel.margins(x=0.12)
    plots.tidy(panel, 'mean error [rad], held-out motion', '', 'estimators on the same data')
    panel.legend(fontsize=9)
    caption = (
        'Joint angle error of the autoencoder and of older estimators on the held-out motion. '
        'Learning: from the same samples at rest; "whole stream": from all messages at 10 Hz. '
        'Dots: individuals. The geometric model has nothing to learn.'
    )
    return plots.Plot('baselines', figure, caption)


EXPERIMENT = Experiment(
    description=__doc__,
    paper=(
        'The same motions before and after learning, 0.414 → 0.186 rad; the error did not rise '
        'much when a 3.6 kg dumbbell was grasped; when muscle #2 was deactivated, A rose after '
        'learning but hardly before.'
    ),
    weight=6.0,
    measure=measure,
    plot=plot,
)
