# SPDX-License-Identifier: Apache-2.0
"""Simulation with another loss.

The elbow is flexed to 90°; the hand is pushed with −50 N in z, then with 50 N in y; then the
shoulder is forced to 30° and let go. The command holds the posture by `proposed` on the learned
network. The emulated arm is pushed alike; its joints cannot be forced, so that the last two phases
are the simulator’s alone. On robots without elbow_pitch and shoulder_pitch, joints called elbow and
shoulder, or else the last and the first, play their parts.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.methods import geometric_command, proposed
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.roles import elbow, flexed, plotted, shoulder, within
from musculoskeletal_ae.experiments.study import Experiment, Individuals, Measured, Progress, Study
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension
from musculoskeletal_ae.simulation.simulation import Simulation

STEP = 0.02  # [s]
SETTLING = 5.0  # [s]
FORCE = 50.0  # [N]
FORCED = 30.0  # [deg]


class Phase(NamedTuple):
    """What is done for how long.

    Attributes:
        name: For plots.
        duration: [s].
        force: On the hand [N], shape (3,).
        forced: Whether the shoulder is held.
    """

    name: str
    duration: float
    force: tuple[float, float, float]
    forced: bool


PHASES = (
    Phase('elbow flexed', 4.0, (0.0, 0.0, 0.0), False),
    Phase('−50 N in z', 3.0, (0.0, 0.0, -FORCE), False),
    Phase('50 N in y', 3.0, (0.0, FORCE, 0.0), False),
    Phase('shoulder forced', 3.0, (0.0, 0.0, 0.0), True),
    Phase('released', 3.0, (0.0, 0.0, 0.0), False),
)
SHARED = PHASES[:3]  # with the emulated arm
ENDS = np.cumsum([round(phase.duration / STEP) for phase in PHASES]) - 1


def measure(study: Study, seed: int, progress: Progress) -> Measured:
    """Return the numbers and traces of one individual."""
    robot = study.body()
    after = study.learned(robot, seed)
    theta = np.clip(np.zeros(robot.joint_count), robot.lower, robot.upper)
    theta[elbow(robot)] = flexed(robot)
    command = _command(robot, after, theta)
    traces: dict[str, Any] = {'arm': _arm(EmulatedArm(robot, seed), command)}
    progress(0.4)
    for when, mae in (('before', study.initial(robot)), ('after', after)):
        traces[when] = _simulated(robot, mae, study.preset, command)
        progress(0.3)
    numbers: dict[str, Any] = {
        'flexed_joint': robot.joints[elbow(robot)],
        'flexed_rad': float(theta[elbow(robot)]),
        'forced_joint': robot.joints[shoulder(robot)],
        'forced_rad': within(robot, shoulder(robot), FORCED),
    }
    for phase, end in zip(PHASES, ENDS, strict=True):
        numbers[phase.name] = {
            who: {
                'theta_rad': trace['theta'][end].tolist(),
                'tension_n': float(np.linalg.norm(trace['tension'][end])),
            }
            for who, trace in traces.items()
            if who != 'arm' or phase in SHARED
        }
    return Measured(numbers, traces)


def _command(robot: Robot, mae: Mae, theta: Array) -> Array:
    """Return the lengths that hold a posture, by `proposed` on the learned network."""
    limits, torque = robot.tension, robot.kinematics.holding_torque(theta)
    if limits.limit <= limits.bias:
        return geometric_command(robot, theta)
    start = least_tension(robot.routes.muscle_jacobian(theta), torque, limits.bias, limits.limit)
    return proposed(robot, mae, theta, torque, start.tension, limits.limit).length


def _simulated(robot: Robot, mae: Mae, preset: str, command: Array) -> dict[str, Array]:
    simulated = Simulation(robot, mae, preset)
    simulated.command = command[None]
    simulated.settle()
    rows = []
    for phase in PHASES:
        simulated.wrench = np.array([[*phase.force, 0.0, 0.0, 0.0]])
        fixed = np.full((1, robot.joint_count), np.nan)
        if phase.forced:
            fixed[0, shoulder(robot)] = within(robot, shoulder(robot), FORCED)
        simulated.fixed = fixed
        for _ in range(round(phase.duration / STEP)):
            state = simulated.step(STEP)
            rows.append((state.theta[0], state.tension[0]))
    return _stacked(rows)


def _arm(arm: EmulatedArm, command: Array) -> dict[str, Array]:
    settling = Phase('settling', SETTLING, (0.0, 0.0, 0.0), False)
    rows = []
    for phase in (settling, *PHASES):
        arm.set_wrench(np.array([*phase.force, 0.0, 0.0, 0.0]))
        for _ in range(round(phase.duration / STEP)):
            arm.command_length(command)
            arm.step(STEP)
            rows.append((arm.theta, arm.tension))
    return _stacked(rows[round(SETTLING / STEP) :])


def _stacked(rows: list[tuple[Array, Array]]) -> dict[str, Array]:
    theta, tension = (np.array(column) for column in zip(*rows, strict=True))
    return {'theta': theta, 'tension': tension}


def plot(individuals: Individuals) -> list[plots.Plot]:
    """Draw angles and tensions over time, and pictures at the end of each phase."""
    _, first = individuals.first
    numbers = first.numbers
    names = [phase.name for phase in PHASES]
    names[0] = f'{numbers["flexed_joint"]}\n{np.degrees(numbers["flexed_rad"]):.0f}°'
    names[3] = f'{numbers["forced_joint"]}\nforced to {np.degrees(numbers["forced_rad"]):.0f}°'
    return [_traces(individuals, names), _pictures(individuals, names)]


def _traces(individuals: Individuals, names: list[str]) -> plots.Plot:
    (seed, row), robot = individuals.first, individuals.robot
    figure, axes = plots.new_figure(12.0, 7.4, 2, 1, sharex=True)
    time = STEP * np.arange(len(row.traces['after']['theta']))
    edges = np.cumsum([0.0, *(phase.duration for phase in PHASES)])
    shared = time < edges[len(SHARED)] - 1e-9
    for panel, key, labels in (
        (axes[0, 0], 'theta', robot.joints),
        (axes[1, 0], 'tension', robot.muscles),
    ):
        for i, name in enumerate(labels):
            factor, unit = plotted(robot, i) if key == 'theta' else (1.0, 'N')
            label = name if unit in ('deg', 'N') else f'{name} [{unit}]'
            simulated = factor * row.traces['after'][key][:, i]
            arm = np.where(shared, factor * row.traces['arm'][key][:, i], np.nan)
            panel.plot(time, simulated, color=f'C{i}', lw=1.6, label=label)
            panel.plot(time, arm, color=f'C{i}', lw=1.0, ls='--')
        panel.plot([], [], color=plots.TRUE, lw=1.6, label='simulator after learning')
        panel.plot([], [], color=plots.TRUE, lw=1.0, ls='--', label='emulated arm')
        for edge in edges[1:-1]:
            panel.axvline(edge, color='#BBBBBB', lw=1)
        panel.legend(fontsize=8, loc='center left', bbox_to_anchor=(1.0, 0.5))
        panel.set_xlim(0.0, edges[-1])
    plots.tidy(axes[0, 0], '', 'joint angle [deg]')
    plots.tidy(axes[1, 0], 'time [s]', 'muscle tension [N]')
    above = axes[0, 0].get_xaxis_transform()
    for start, end, name in zip(edges[:-1], edges[1:], names, strict=True):
        style = {'ha': 'center', 'va': 'bottom', 'fontsize': 9, 'transform': above}
        axes[0, 0].text(0.5 * (start + end), 1.02, name, **style)
    figure.suptitle(f'individual {seed}')
    caption = (
        'The simulator after learning while the hand is pushed and a joint is forced, beside the '
        'emulated arm under the same pushes (dashed; its joints cannot be forced).'
    )
    return plots.Plot('loss_change', figure, caption)


def _pictures(individuals: Individuals, names: list[str]) -> plots.Plot:
    seed, row = individuals.first
    moments = ENDS[:4]
    rows = [
        (f'{when} learning', trace['theta'][moments], trace['tension'][moments])
        for when, trace in row.traces.items()
        if when != 'arm'
    ]
    columns = [name.replace('\n', ' ') for name in names[: len(moments)]]
    figure = plots.picture_rows(individuals.robot, rows, columns, f'simulator of individual {seed}')
    caption = 'The simulator at the end of each phase, before and after learning.'
    return plots.Plot('loss_change_pictures', figure, caption)


EXPERIMENT = Experiment(
    description=__doc__,
    paper='Elbow bent to 90°, −50 N in z and 50 N in y at the hand, then S-p forced to 30°.',
    weight=0.5,
    measure=measure,
    plot=plot,
)
