# SPDX-License-Identifier: Apache-2.0
"""State estimation and anomaly detection.

Paper (§IV-B). The joint angles of the same motions are estimated before and after learning. The
error falls from 0.414 to 0.186 rad. It hardly rises when the arm grasps a 3.6 kg dumbbell. When
muscle #2 is deactivated, the anomaly A rises after learning, but hardly before.

Here. The networks of both presets, before and after learning, process the same recordings. Messages
pass one by one through the detector of the estimator node. The first recording is the held-out
motion, with 3.6 kg in the hand from its middle on. Then every muscle in turn ruptures for 3 s and
is repaired, still with the payload. After a random wait of up to 5 s, a muscle ruptures as soon as
it carries more than 10 N above T_bias. A muscle that carries less until 14 s have passed ruptures
then; plots show it in grey, and it is not counted. In the second recording, every muscle in turn is
switched off for 3 s instead, as in the paper: its module is commanded zero tension, and its tendon
stays intact. Healthy messages are those of the held-out motion, and of one hour of motion (shared
by the individuals) in which the payload is grasped or released every minute. The default preset
detects faults by the distance d, and preset `paper` by the anomaly A. The node's detectors of
frozen sensors and of thermal drift find nothing in these recordings.

- detected: an alarm starts during the fault; if none does, the delay counts as 3 s
- named: the muscle is the most suspect one in the message that completes the detection
- false alarms: alarms that start during the hour of healthy motion
- AUROC: of d, for healthy messages against messages from 0.1 s after a rupture until the repair
- threshold: the detector’s threshold of d (preset `paper`: of A)
- ruptured min: smallest level of A or d that a ruptured muscle caused (median over its rupture)
- switched off: the same measures for the second recording
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.baselines import baseline_errors
from musculoskeletal_ae.experiments.detection import (
    PAYLOAD,
    RUPTURE_TIME,
    SLOT,
    DetectorOutput,
    GraspAndRupture,
    anomaly_levels,
    detection,
    grasp_and_release,
    run_detector,
)
from musculoskeletal_ae.experiments.recording import (
    HELD_OUT_STREAM,
    SAMPLE_TIME,
    Motion,
    Recording,
    estimation_error,
    mean_error,
    record,
    rows_between,
    times,
)
from musculoskeletal_ae.experiments.roles import plot_unit
from musculoskeletal_ae.experiments.study import (
    Experiment,
    Measured,
    Plot,
    Rows,
    Study,
    first_individual,
)
from musculoskeletal_ae.signals.friction import directions

HEALTHY_STREAM = 9500
#: count false alarms over this duration of healthy motion, shared by the individuals [s]
HEALTHY_TIME = 3600.0
PLOT_START = 60.0  # begin plots this long before the grasp [s]
PLOT_TAIL = 3.0  # end plots this long after the repair [s]
OFF_TIME = 40.0  # let the arm move for this time before its muscles are switched off one by one [s]
#: draw pictures of these times [s], at ends of the motion's cycles without and with the payload; a
#: shortened run draws only those that its motion reaches
MOMENTS = {'after 10 s': 9.9, 'after 20 s': 19.9, 'payload grasped': 29.9, 'payload, 40 s': 39.9}
OFF = 'switched_off'
#: measures that are also reported for switched-off muscles
OFF_KEYS = 'detection_s', 'detected_share', 'named_share'


def measure(study: Study, seed: int) -> Measured:
    """Measure the estimates of one individual, and the detection of its ruptured muscles."""
    robot = study.robot
    # Even in a shortened run, a muscle needs half of its usual time.
    most, slot = (1, 0.5 * SLOT) if study.quick else (None, SLOT)
    plan = GraspAndRupture(robot, study.held_out_time, seed, most=most, slot=slot)
    driven_by = study.network(None, 'default')
    faulty = record(study.arm(seed), driven_by, HELD_OUT_STREAM, plan.duration, plan)
    duration = study.seconds(HEALTHY_TIME / len(study.seeds))
    stream = HEALTHY_STREAM + seed
    healthy = record(study.arm(seed), driven_by, stream, duration, grasp_and_release)
    off_time = study.seconds(OFF_TIME)
    plan_off = GraspAndRupture(robot, off_time, seed, switched_off=True, most=most, slot=slot)
    switched_off = record(study.arm(seed), driven_by, HELD_OUT_STREAM, plan_off.duration, plan_off)
    sliding = [directions(each.length) for each in (faulty, healthy, switched_off)]
    recordings = Recordings(plan, faulty, healthy, plan_off, switched_off, sliding)
    numbers, outputs, off_outputs = dict[str, Any](), dict[str, Any](), dict[str, Any]()
    for preset in study.presets:
        values, outputs[preset], off_outputs[preset] = _preset(study, seed, preset, recordings)
        numbers |= study.with_prefix(preset, values)
    held_out = study.stream(seed, 'held_out')
    for when, mae in study.networks(seed).items():
        numbers[f'{when}_held_out_rad'] = estimation_error(mae, held_out)
    exploring = study.stream(seed, 'exploring')
    numbers['baselines'] = baseline_errors(robot, study.rests(seed), exploring, held_out)
    second = plan_off.order[0]
    at = float(plan_off.rupture[second]) + 0.9 * RUPTURE_TIME
    moments = {name: time for name, time in MOMENTS.items() if time < off_time}
    moments[f'#{second + 1} switched off'] = at
    steps = [round(time / SAMPLE_TIME) for time in moments.values()]
    postures = {'arm': switched_off.theta}
    for preset, by_time in off_outputs.items():
        postures |= {f'{preset}, {when} learning': out.theta for when, out in by_time.items()}
    tension = switched_off.tension[steps]
    end = rows_between(0.0, float(plan_off.rupture[second]) + RUPTURE_TIME + PLOT_TAIL)
    traces = {
        'moments': list(moments),
        'motions': {name: Motion(theta[steps], tension) for name, theta in postures.items()},
        'theta': faulty.theta,
        'outputs': outputs[study.preset],
        'grasp': plan.grasp,
        'first_ruptured': robot.muscles[plan.order[0]],
        'rupture': float(plan.rupture[plan.order[0]]),
        'off': {
            'theta': switched_off.theta[end],
            'outputs': {
                preset: {when: (out.theta[end], out.anomaly[end]) for when, out in by_time.items()}
                for preset, by_time in off_outputs.items()
            },
            'grasp': plan_off.grasp,
            'muscle': f'#{second + 1} {robot.muscles[second]}',
            'start': float(plan_off.rupture[second]),
        },
    }
    return Measured(numbers, traces)


class Recordings(NamedTuple):
    """The recordings that the networks of both presets process."""

    plan: GraspAndRupture
    faulty: Recording  # recording of the ruptures that `plan` describes
    healthy: Recording
    plan_off: GraspAndRupture
    switched_off: Recording  # recording of the switched-off muscles of `plan_off`
    sliding: list[Array]  # sliding directions of the tendons in each of the three recordings


def _preset(
    study: Study, seed: int, preset: str, recordings: Recordings
) -> tuple[dict[str, Any], dict[str, DetectorOutput], dict[str, DetectorOutput]]:
    """Evaluate the networks of a preset before and after learning.

    Returns:
        The numbers of the preset, the detector's outputs for the recording with ruptures, and
        those for the recording with switched-off muscles. The outputs have the keys 'before' and
        'after', which name the network.
    """
    robot, networks = study.robot, study.networks(seed, preset)
    plan, faulty, healthy, plan_off, switched_off, _ = recordings
    outputs, healthy_outputs, off_outputs = (
        {when: run_detector(robot, mae, recording, sliding) for when, mae in networks.items()}
        for recording, sliding in zip(
            (faulty, healthy, switched_off), recordings.sliding, strict=True
        )
    )
    numbers: dict[str, Any] = {}
    for when, output in outputs.items():
        for key, rows in (('', plan.free), ('payload_', plan.loaded)):
            numbers[f'{when}_{key}rad'] = mean_error(output.theta[rows], faulty.theta[rows])
        difference = output.theta - faulty.theta
        errors = np.concatenate([difference[plan.while_ruptured(m)] for m in plan.order])
        numbers[f'{when}_ruptured_rad'] = mean_error(errors, np.zeros_like(errors))
    numbers |= anomaly_levels(plan_off, off_outputs, healthy_outputs, OFF)
    numbers |= anomaly_levels(plan, outputs, healthy_outputs, 'ruptured')
    numbers['auroc'] = numbers['d_ruptured_auroc']
    for prefix in ('a_before', 'a'):  # the muscle that the paper deactivated
        level = numbers[f'{prefix}_{OFF}'][plan_off.muscles.index(plan_off.order[0])]
        numbers[f'{prefix}_{OFF}_second'] = level
        numbers[f'{prefix}_{OFF}_second_ratio'] = level / numbers[f'{prefix}_healthy_median']
    mae, healthy_after = networks['after'], healthy_outputs['after']
    off_numbers = detection(robot, plan_off, off_outputs['after'], healthy_after, mae)
    numbers |= {f'{OFF}_{key}': off_numbers[key] for key in OFF_KEYS}
    numbers |= detection(robot, plan, outputs['after'], healthy_after, mae)
    return numbers, outputs, off_outputs


def _plot_range(trace: Mapping[str, Any]) -> tuple[slice, Any]:
    """Return the range of messages that plots show, as a slice, and their times [s].

    The messages extend from PLOT_START before the grasp to PLOT_TAIL after the first repair.
    """
    start = max(0.0, trace['grasp'] - PLOT_START)
    rows = rows_between(start, trace['rupture'] + RUPTURE_TIME + PLOT_TAIL)
    return rows, start + times(len(trace['theta'][rows]))


def _mark(axes: Any, trace: Mapping[str, Any]) -> None:
    axes.axvline(trace['grasp'], color=plots.MARK, ls='--', lw=1)
    start = trace['rupture']
    axes.axvspan(start, start + RUPTURE_TIME, color='#F0E442', alpha=0.5, lw=0)


def grasp_and_cut(_: Study, rows: Rows) -> Plot:
    """Draw the estimation error, A and d before and after the grasp and the first rupture.

    A is the anomaly, and d the distance by which the default preset detects faults.
    """
    seed, (numbers, trace) = first_individual(rows)
    shown, time = _plot_range(trace)
    figure, panels = plots.new_figure(12.0, 8.0, 3, sharex=True)
    for panel in panels:
        panel.set_yscale('log')
        _mark(panel, trace)
    for when, colour in plots.WHEN.items():
        output = trace['outputs'][when]
        free, loaded = numbers[f'{when}_rad'], numbers[f'{when}_payload_rad']
        label = f'{when} learning ({free:.3f} rad,\nwith payload {loaded:.3f} rad)'
        error = np.linalg.norm(output.theta - trace['theta'], axis=1)[shown]
        plots.line(panels[0], time, error, 50, color=colour, lw=1, label=label)
        for panel, values in zip(panels[1:], (output.anomaly, output.distance), strict=True):
            plots.line(panel, time, values[shown], color=colour, lw=1, label=f'{when} learning')
    panels[2].axhline(numbers['threshold'], color=plots.TRUE, ls=':', label="detector's threshold")
    ruptured = trace['first_ruptured']
    for at, text in ('grasp', f'grasps {PAYLOAD:g} kg'), ('rupture', f'{ruptured} ruptures'):
        place = {'transform': panels[0].get_xaxis_transform(), 'ha': 'center'}
        panels[0].text(trace[at], 1.02, text, **place)
    plots.tidy(panels[0], '', '‖θ_est − θ‖ [rad], 0.5 s mean', legend='right')
    plots.tidy(panels[1], '', 'A [scaled units]', legend='right')
    plots.tidy(panels[2], 'time [s]', 'd [healthy std. dev.]', legend='right')
    figure.suptitle(f'individual {seed}')
    return figure, (
        'Estimation error, anomaly A, and the distance d that the detector compares with its '
        'threshold, for the same recording before and after learning. The arm grasps '
        f'{PAYLOAD:g} kg (dashed); then {ruptured} ruptures (yellow) and is repaired.'
    )


def deactivated(_: Study, rows: Rows) -> Plot:
    """Draw the error and the anomaly A while a muscle is switched off, a column for each preset."""
    seed, row = first_individual(rows)
    off = row.traces['off']
    theta, by_preset = off['theta'], off['outputs']
    figure, panels = plots.new_figure(
        6.0 * len(by_preset), 5.4, 2, len(by_preset), sharex=True, sharey='row'
    )
    time, start = times(len(theta)), off['start']
    for column, (preset, outputs) in enumerate(by_preset.items()):
        upper, lower = both = panels[column :: len(by_preset)]
        for panel in both:
            panel.set_yscale('log')
            panel.axvline(off['grasp'], color=plots.MARK, ls='--', lw=1)
            panel.axvspan(start, start + RUPTURE_TIME, color='#F0E442', alpha=0.5, lw=0)
        for when, (estimated, anomaly) in outputs.items():
            style: dict[str, Any] = {
                'color': plots.WHEN[when],
                'lw': 1,
                'label': f'{when} learning',
            }
            error = np.linalg.norm(estimated - theta, axis=1)
            plots.line(upper, time, error, 25, **style)
            plots.line(lower, time, anomaly, **style)
        ylabels = ('‖θ_est − θ‖ [rad], 0.25 s mean', 'A [scaled units]')
        plots.tidy(upper, '', '' if column else ylabels[0], f'preset {preset}')
        plots.tidy(lower, 'time [s]', '' if column else ylabels[1])
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside lower center', ncols=2, fontsize=9)
    figure.suptitle(f'individual {seed}')
    return figure, (
        f'Estimation error and anomaly score A, measured as in the paper: the arm grasps '
        f'{PAYLOAD:g} kg (dashed line), then {off["muscle"]} is switched off (yellow).'
    )


def appearance(study: Study, rows: Rows) -> Plot:
    """Draw the true and the estimated postures at several times of the experiment."""
    seed, (_, trace) = first_individual(rows)
    moments = {name: step for step, name in enumerate(trace['moments'])}
    title = f'individual {seed}, estimated from lengths and tensions'
    return plots.pictures(study.robot, trace['motions'], moments, title), (
        'The arm (true posture) and its estimates during the experiment: it moves, grasps '
        f'{PAYLOAD:g} kg, and one muscle is switched off. Colours: measured tensions.'
    )


def tracking(study: Study, rows: Rows) -> Plot:
    """Draw the true and estimated joint angles during the grasp and the first rupture."""
    (seed, (_, trace)), robot = first_individual(rows), study.robot
    shown, time = _plot_range(trace)
    count = robot.joint_count
    figure, panels = plots.new_figure(12.0, 1.6 * count + 0.8, count, sharex=True)
    for joint, panel in enumerate(panels):
        factor, unit = plot_unit(robot, joint)
        for when, colour in plots.WHEN.items():
            theta = factor * trace['outputs'][when].theta[shown, joint]
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
        'True joint angles, and their estimates before and after learning, in the same period. '
        'Dashed: grasp; yellow: ruptured muscle.'
    )


def cuts(_: Study, rows: Rows) -> Plot:
    """Draw the anomaly A, the distance d and the detection delay of every rupture."""
    numbers = [row.numbers for row in rows.values()]
    ruptured = list(numbers[0]['cuts'])
    figure, panels = plots.new_figure(12.0, 0.42 * len(ruptured) + 1.9, 1, 3, sharey=True)
    place = np.arange(len(ruptured))
    labels = 'A [scaled units]', 'd [healthy std. dev.]'
    for letter, panel, label in zip('ad', panels, labels):
        for when, prefix, shift in (('before', '_before', -0.18), ('after', '', 0.18)):
            colour = plots.WHEN[when]
            for each in numbers:
                level = each[f'{letter}{prefix}_ruptured']
                panel.plot(level, place + shift, 'o', color=colour, alpha=0.6, ms=5)
            largest = max(each[f'{letter}{prefix}_healthy_max'] for each in numbers)
            panel.plot([], [], 'o', color=colour, label=f'ruptured, {when} learning')
            panel.axvline(largest, color=colour, ls='--', lw=1, label=f'largest healthy, {when}')
        # Begin and end the logarithmic axis at labelled ticks.
        low, high = panel.dataLim.intervalx
        panel.set_xscale('log')
        panel.set_xlim(10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high)))
        plots.tidy(panel, label, legend='below')
    panel = panels[2]
    for each in numbers:
        for m, rupture in enumerate(each['cuts'].values()):
            marker = 'o' if rupture['named'] else 'x'
            colour = plots.AFTER if rupture['carried'] else plots.MARK
            panel.plot(rupture['detection_s'], m, marker, color=colour, ms=6, mfc='none')
    panel.axvline(0.5, color=plots.TRUE, ls=':', label='goal: 0.5 s')
    panel.axvline(RUPTURE_TIME, color=plots.BEFORE, ls=':', label='not detected')
    for marker, colour, label in (
        ('o', plots.AFTER, 'correct muscle named'),
        ('x', plots.AFTER, 'other muscle named'),
        ('o', plots.MARK, 'slack when ruptured'),
    ):
        panel.plot([], [], marker, color=colour, mfc='none', label=label)
    panel.set(xscale='log', xlim=(0.008, 1.3 * RUPTURE_TIME))
    plots.tidy(panel, 'time to detection [s]', legend='below')
    panels[0].set_yticks(place, ruptured)
    panels[0].invert_yaxis()
    figure.suptitle('one muscle ruptured after another, one point per individual')
    return figure, (
        'Left and middle: median of A and of d while each muscle is ruptured. Points to the right '
        'of the dashed line of their colour exceed every value of healthy motion. Right: the time '
        'until the calibrated detector reported the rupture.'
    )


def baselines(study: Study, rows: Rows) -> Plot:
    """Draw the errors of earlier estimators and of the autoencoder."""
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
        'Joint-angle error of the autoencoder and of earlier estimators on the held-out motion. '
        'All learn from the same rest samples, or, with "whole stream", from all messages at '
        '10 Hz. Dots: individuals. Least squares on the geometric model has nothing to learn.'
    )


PLOTS = (appearance, deactivated, grasp_and_cut, tracking, cuts, baselines)
EXPERIMENT = Experiment(__doc__, measure, PLOTS, 11.0)
