# SPDX-License-Identifier: Apache-2.0
"""Simulation.

Paper (§IV-D). Arm and simulator follow the same commands. Learning reduces their difference from
0.335 to 0.162 rad and from 105 to 92.2 N.

Here. Arm and simulator follow the commands of the held-out motion, and all messages are compared: θ
with the true joint angles, T with the measured tensions. The simulator starts in the first posture
of the arm and receives nothing but commands after that. The reference is the emulated individual
itself without any friction, which has the error of a perfect simulator without hysteresis.
"""

from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, Motion, Recording, columns, times
from musculoskeletal_ae.experiments.study import (
    Experiment,
    Measured,
    Plot,
    Rows,
    Study,
    first_individual,
)
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation

#: the errors in the paper before and after learning
PUBLISHED = {'rad': (0.335, 0.162), 'n': (105.0, 92.2)}
CYCLE = 10.0  # one cycle of exploration, three steps, takes this time [s]
MOMENTS = 5  # draw the arm at this many instants of the motion


def measure(study: Study, seed: int) -> Measured:
    """Measure how far the simulators of one individual deviate from the emulated arm."""
    recording = study.stream(seed, 'held_out')
    arm = Motion(recording.theta, recording.tension)
    numbers, traces = dict[str, Any](), dict[str, Any]()
    for preset in study.presets:
        traces[preset] = {'arm': arm}
        for when, mae in study.networks(seed, preset).items():
            motion = simulate(study.robot, mae, preset, recording)
            numbers |= study.with_prefix(preset, _errors(when, motion, arm))
            traces[preset][when] = motion
    body, rows = study.arm(seed, friction=False), []
    for command in recording.command:
        body.command_length(command)
        body.step(SAMPLE_TIME)
        rows.append((body.theta, body.tension))
    numbers |= _errors('frictionless', Motion(*columns(rows)), arm)
    return Measured(numbers, traces)


def simulate(robot: Robot, mae: Mae, preset: str, recording: Recording) -> Motion:
    """Simulate the commands of a recording with a network, and return the motion.

    The simulator starts in the first posture of the recording.
    """
    simulated, rows = Simulation(robot, mae, preset), []
    simulated.start_from(recording.theta[:1])
    for command in recording.command:
        simulated.command = command[None]
        state = simulated.step(SAMPLE_TIME)
        rows.append((state.theta[0], state.tension[0]))
    return Motion(*columns(rows))


def _distances(motion: Motion, arm: Motion) -> dict[str, Array]:
    """Return the distances between a motion and that of the arm at each step, (N,) each.

    `rad` is the distance in θ [rad], and `n` the distance in T [N].
    """
    return {
        'rad': np.linalg.norm(motion.theta - arm.theta, axis=1),
        'n': np.linalg.norm(motion.tension - arm.tension, axis=1),
    }


def _errors(name: str, motion: Motion, arm: Motion) -> dict[str, float]:
    distances = _distances(motion, arm)
    return {f'{name}_{unit}': float(each.mean()) for unit, each in distances.items()}


def simulation_pictures(study: Study, rows: Rows) -> Plot:
    """Draw the arm and its simulators at several times."""
    seed, (_, traces) = first_individual(rows)
    arm = traces[study.preset]['arm']
    # Times near the ends of cycles, where the arm rests at the random tensions of the third step.
    cycles = np.arange(len(arm.theta) * SAMPLE_TIME // CYCLE)
    chosen = np.linspace(0, len(cycles) - 1, min(MOMENTS, len(cycles))).round().astype(int)
    steps = ((cycles[chosen] * CYCLE + 9.9) / SAMPLE_TIME).astype(int)
    moments = {f'{SAMPLE_TIME * n:.0f} s': int(n) for n in steps}
    motions = {'arm': arm}
    for preset, of_preset in traces.items():
        motions |= {f'{preset}, {when} learning': of_preset[when] for when in plots.WHEN}
    title = f'individual {seed}, same commands'
    return plots.pictures(study.robot, motions, moments, title), (
        'The emulated arm (true posture, measured tensions, drawn with the model’s routes), and '
        'the simulator of each preset before and after learning under the same commands.'
    )


def simulation_errors(_: Study, rows: Rows) -> Plot:
    """Draw the errors of the simulators over time, a column for each preset."""
    seed, row = first_individual(rows)
    traces = row.traces
    figure, panels = plots.new_figure(
        6.0 * len(traces), 5.6, 2, len(traces), sharex=True, sharey='row'
    )
    for column, (preset, motions) in enumerate(traces.items()):
        distances = {when: _distances(motions[when], motions['arm']) for when in plots.WHEN}
        both = panels[column :: len(traces)]
        for panel, key, unit, symbol in zip(both, PUBLISHED, ('rad', 'N'), 'θT', strict=True):
            for when, colour in plots.WHEN.items():
                values = distances[when][key]
                label = f'{when} learning: {values.mean():.3g} {unit}'
                time = times(len(values))
                plots.line(panel, time, values, 25, color=colour, lw=0.9, label=label)
            before, after = PUBLISHED[key]
            label = f'paper: {before:g} → {after:g} {unit}'
            panel.axhline(after, color=plots.MARK, ls=':', lw=1, label=label)
            panel.set_ylim(bottom=0.0)
            ylabel = f'‖{symbol}_sim − {symbol}‖ [{unit}]' if column == 0 else ''
            plots.tidy(panel, 'time [s]' if key == 'n' else '', ylabel)
            panel.legend(fontsize=8, loc='lower right', bbox_to_anchor=(1.0, 1.0), frameon=False)
        both[0].set_title(f'preset {preset}', loc='left')
    figure.suptitle(f'individual {seed}', x=0.01, ha='left')
    return figure, (
        'Distance of the simulator from the arm under the same commands (0.25 s running mean). '
        "Dotted: the paper's mean after learning."
    )


EXPERIMENT = Experiment(__doc__, measure, (simulation_pictures, simulation_errors), 3.0)
