# SPDX-License-Identifier: Apache-2.0
"""Simulation.

Arm and simulator follow the commands of the held-out motion, and all messages are compared; the
simulator starts in the arm’s first posture and sees nothing else of it. θ beside the true angles, T
beside the measured tensions. The bound is the emulated individual itself without any friction: what
a perfect simulator without hysteresis would be left with.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, Recording, frictionless, times
from musculoskeletal_ae.experiments.study import Experiment, Individuals, Measured, Progress, Study
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation

PRINTED = {'rad': (0.335, 0.162), 'n': (105.0, 92.2)}
CYCLE = 10.0  # [s] of the exploration's three steps
MOMENTS = 5


def measure(study: Study, seed: int, progress: Progress) -> Measured:
    """Return the numbers and traces of one individual."""
    robot = study.body()
    arm = study.stream(seed, 'held_out')
    numbers: dict[str, Any] = {}
    traces: dict[str, Any] = {'arm': {'theta': arm.theta, 'tension': arm.tension}}
    presets = dict.fromkeys([study.preset, 'paper'])
    for preset in presets:
        for when, mae in (
            ('before', study.initial(robot, preset)),
            ('after', study.learned(robot, seed, preset)),
        ):
            trace = _beside(arm, *simulate(robot, mae, preset, arm.theta[0], arm.command))
            for prefix, named in (('', study.preset), ('paper_', 'paper')):
                if preset == named:
                    numbers[f'{prefix}{when}_rad'] = float(trace['rad'].mean())
                    numbers[f'{prefix}{when}_n'] = float(trace['n'].mean())
            if preset == study.preset:
                traces[when] = trace
            progress(0.5 / len(presets))
    body = frictionless(robot, seed)
    theta, tension = np.empty_like(arm.theta), np.empty_like(arm.tension)
    for n, command in enumerate(arm.command):
        body.command_length(command)
        body.step(SAMPLE_TIME)
        theta[n], tension[n] = body.theta, body.tension
    bound = _beside(arm, theta, tension)
    numbers['frictionless_rad'] = float(bound['rad'].mean())
    numbers['frictionless_n'] = float(bound['n'].mean())
    return Measured(numbers, traces)


def simulate(
    robot: Robot, mae: Mae, preset: str, start: Array, commands: Array
) -> tuple[Array, Array]:
    """Return θ [rad] (N, D) and T [N] (N, M) of a simulator given an arm's commands.

    Args:
        robot: The geometric model.
        mae: The body that is simulated.
        preset: Of the simulator.
        start: Posture of the arm [rad], shape (D,).
        commands: l_target at 100 Hz [m], shape (N, M).
    """
    simulated = Simulation(robot, mae, preset)
    simulated.start_from(start[None])
    theta, tension = np.empty((len(commands), len(start))), np.empty_like(commands)
    for n, command in enumerate(commands):
        simulated.command = command[None]
        state = simulated.step(SAMPLE_TIME)
        theta[n], tension[n] = state.theta[0], state.tension[0]
    return theta, tension


def _beside(arm: Recording, theta: Array, tension: Array) -> dict[str, Array]:
    """Return a simulated motion and how far it is from the arm's, message by message."""
    return {
        'theta': theta,
        'tension': tension,
        'rad': np.linalg.norm(theta - arm.theta, axis=1),
        'n': np.linalg.norm(tension - arm.tension, axis=1),
    }


def plot(individuals: Individuals) -> list[plots.Plot]:
    """Draw pictures of arm and simulator, and the errors over time."""
    return [_pictures(individuals), _errors(individuals)]


def _pictures(individuals: Individuals) -> plots.Plot:
    seed, row = individuals.first
    count = len(row.traces['arm']['theta'])
    # The ends of as many cycles: at rest, with the random tensions of the third step.
    ends = (np.arange(count * SAMPLE_TIME // CYCLE) * CYCLE + 9.9) / SAMPLE_TIME
    chosen = np.linspace(0, len(ends) - 1, min(MOMENTS, len(ends))).round().astype(int)
    moments = [int(at) for at in ends[chosen]]
    rows = []
    for name, source in (
        ('arm', 'arm'),
        ('simulator before learning', 'before'),
        ('simulator after learning', 'after'),
    ):
        trace = row.traces[source]
        rows.append((name, trace['theta'][moments], trace['tension'][moments]))
    columns = [f'{SAMPLE_TIME * n:.0f} s' for n in moments]
    caption = (
        'The emulated arm (true posture, measured tensions, drawn with the model’s routes) and '
        'the simulator before and after learning, at the same moments of the same commands.'
    )
    title = f'individual {seed}, the same commands'
    return plots.Plot(
        'simulation_pictures', plots.picture_rows(individuals.robot, rows, columns, title), caption
    )


def _errors(individuals: Individuals) -> plots.Plot:
    seed, row = individuals.first
    figure, axes = plots.new_figure(12.0, 5.6, 2, 1, sharex=True)
    for panel, key, unit in ((axes[0, 0], 'rad', 'rad'), (axes[1, 0], 'n', 'N')):
        for when, colour in plots.WHEN.items():
            values = row.traces[when][key]
            label = f'{when} learning: mean {row.numbers[f"{when}_{key}"]:.3g} {unit}'
            plots.line(panel, times(len(values)), values, 25, color=colour, lw=0.9, label=label)
        before, after = PRINTED[key]
        panel.plot([], [], ' ', label=f'paper: {before:g} → {after:g} {unit}')
        panel.axhline(after, color=plots.MARK, ls=':', lw=1)
        panel.set_ylim(bottom=0.0)
        panel.legend(fontsize=9, loc='upper right', ncols=3)
    plots.tidy(axes[0, 0], '', '‖θ_sim − θ‖ [rad]', f'individual {seed}')
    plots.tidy(axes[1, 0], 'time [s]', '‖T_sim − T‖ [N]')
    caption = (
        'Distance of the simulator from the arm under the same commands (0.25 s running mean). '
        'Dotted: the paper’s mean after learning.'
    )
    return plots.Plot('simulation_errors', figure, caption)


EXPERIMENT = Experiment(
    description=__doc__,
    paper=(
        'Arm and simulator under the same commands: 0.335 → 0.162 rad and 105 → 92.2 N by learning.'
    ),
    weight=3.0,
    measure=measure,
    plot=plot,
)
