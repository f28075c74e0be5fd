# SPDX-License-Identifier: Apache-2.0
"""Simulation.

Paper (§IV-D). Arm and simulator under the same commands: 0.335 → 0.162 rad and 105 → 92.2 N by
learning.

Here. Arm and simulator follow the commands of the held-out motion, and all messages are compared;
the simulator starts in the arm’s first posture and sees nothing else of it. θ beside the true
angles, T beside the measured tensions. The bound is the emulated individual itself without any
friction: what a perfect simulator without hysteresis would be left with.
"""

from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, Motion, Recording, columns, times
from musculoskeletal_ae.experiments.study import Experiment, Measured, Plot, Rows, Study, first
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.presets.registry import AS_PRINTED
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation

PRINTED = {'rad': (0.335, 0.162), 'n': (105.0, 92.2)}
CYCLE = 10.0  # [s] of the exploration's three steps
MOMENTS = 5


def measure(study: Study, seed: int) -> Measured:
    """Return the numbers and traces of one individual."""
    recording = study.stream(seed, 'held_out')
    arm = Motion(recording.theta, recording.tension)
    numbers, traces = dict[str, Any](), {'arm': arm}
    for preset in dict.fromkeys([study.preset, AS_PRINTED]):
        for when, mae in study.networks(seed, preset).items():
            moved = simulate(study.robot, mae, preset, recording)
            numbers |= study.keyed(preset, _errors(when, moved, arm))
            if preset == study.preset:
                traces[when] = moved
    body, rows = study.arm(seed, friction=False), []
    for command in recording.command:
        body.command_length(command)
        body.step(SAMPLE_TIME)
        rows.append((body.theta, body.tension))
    numbers |= _errors('frictionless', Motion(*columns(rows)), arm)
    return Measured(numbers, traces)


def simulate(robot: Robot, mae: Mae, preset: str, recording: Recording) -> Motion:
    """Let a network's simulator follow the commands of a recording, from its first posture."""
    simulated, rows = Simulation(robot, mae, preset), []
    simulated.start_from(recording.theta[:1])
    for command in recording.command:
        simulated.command = command[None]
        state = simulated.step(SAMPLE_TIME)
        rows.append((state.theta[0], state.tension[0]))
    return Motion(*columns(rows))


def _distances(moved: Motion, arm: Motion) -> dict[str, Array]:
    """Return how far a motion is from the arm's, in θ [rad] and T [N], message by message."""
    return {
        'rad': np.linalg.norm(moved.theta - arm.theta, axis=1),
        'n': np.linalg.norm(moved.tension - arm.tension, axis=1),
    }


def _errors(name: str, moved: Motion, arm: Motion) -> dict[str, float]:
    return {f'{name}_{unit}': float(far.mean()) for unit, far in _distances(moved, arm).items()}


def simulation_pictures(study: Study, rows: Rows) -> Plot:
    """Draw arm and simulator at some moments."""
    seed, (_, traces) = first(rows)
    # The ends of as many cycles: at rest, with the random tensions of the third step.
    cycles = np.arange(len(traces['arm'].theta) * SAMPLE_TIME // CYCLE)
    chosen = np.linspace(0, len(cycles) - 1, min(MOMENTS, len(cycles))).round().astype(int)
    steps = ((cycles[chosen] * CYCLE + 9.9) / SAMPLE_TIME).astype(int)
    moments = {f'{SAMPLE_TIME * n:.0f} s': int(n) for n in steps}
    motions = {'arm': traces['arm']}
    motions |= {f'simulator {when} learning': traces[when] for when in plots.WHEN}
    title = f'individual {seed}, the same commands'
    return plots.pictures(study.robot, motions, moments, title), (
        'The emulated arm (true posture, measured tensions, drawn with the model’s routes) and '
        'the simulator before and after learning, at the same moments of the same commands.'
    )


def simulation_errors(_: Study, rows: Rows) -> Plot:
    """Draw the errors over time."""
    seed, (numbers, traces) = first(rows)
    figure, panels = plots.new_figure(12.0, 5.6, 2, sharex=True)
    far = {when: _distances(traces[when], traces['arm']) for when in plots.WHEN}
    for panel, key, unit, symbol in zip(panels, PRINTED, ('rad', 'N'), 'θT', strict=True):
        for when, colour in plots.WHEN.items():
            values = far[when][key]
            label = f'{when} learning: mean {numbers[f"{when}_{key}"]:.3g} {unit}'
            plots.line(panel, times(len(values)), values, 25, color=colour, lw=0.9, label=label)
        before, after = PRINTED[key]
        label = f'printed: {before:g} → {after:g} {unit}'
        panel.axhline(after, color=plots.MARK, ls=':', lw=1, label=label)
        panel.set_ylim(bottom=0.0)
        plots.tidy(panel, '', f'‖{symbol}_sim − {symbol}‖ [{unit}]', legend='above')
    panels[0].set_title(f'individual {seed}', loc='left')
    panels[1].set_xlabel('time [s]')
    return figure, (
        'Distance of the simulator from the arm under the same commands (0.25 s running mean). '
        'Dotted: the printed mean after learning.'
    )


EXPERIMENT = Experiment(__doc__, measure, (simulation_pictures, simulation_errors), 3.0)
