# SPDX-License-Identifier: Apache-2.0
"""Simulation under external forces and constraints.

Paper (§IV-D). The elbow is bent to 90°, −50 N in z and 50 N in y act on the hand, then S-p is
forced to 30°.

Here. The elbow is flexed to 90°. A force of −50 N in z acts on the hand, then one of 50 N in y.
Then the shoulder is forced to 30° and released. `proposed` computes the command that holds the
posture, with the learned network. The same forces act on the emulated arm. Its joints cannot be
forced, so only the simulator runs the last two phases. On robots without elbow_pitch and
shoulder_pitch, joints named elbow and shoulder take their roles, or else the last and the first
joint.
"""

from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.methods import proposed
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.recording import Motion, columns
from musculoskeletal_ae.experiments.roles import elbow, flexed, plot_unit, shoulder, within
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
from musculoskeletal_ae.robot.tension import least_tension
from musculoskeletal_ae.simulation.simulation import Simulation

STEP = 0.02  # [s]
FORCED = 30.0  # [deg]


class Phase(NamedTuple):
    """One phase of the experiment: its duration, and the force and constraint that act."""

    name: str
    duration: float  # [s]
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)  # on the hand [N]
    forced: bool = False  # whether the shoulder is forced to `FORCED`


PHASES = (
    Phase('elbow flexed', 4.0),
    Phase('−50 N in z', 3.0, (0.0, 0.0, -50.0)),
    Phase('50 N in y', 3.0, (0.0, 50.0, 0.0)),
    Phase('shoulder forced', 3.0, forced=True),
    Phase('released', 3.0),
)
SETTLING = Phase('settling', 5.0)  # of the emulated arm
SHARED = PHASES[:3]  # phases that the emulated arm goes through as well
ENDS = np.cumsum([round(phase.duration / STEP) for phase in PHASES]) - 1  # steps


def measure(study: Study, seed: int) -> Measured:
    """Return the results and traces of one individual."""
    robot, networks = study.robot, study.networks(seed)
    theta = np.clip(np.zeros(robot.joint_count), robot.lower, robot.upper)
    theta[elbow(robot)] = flexed(robot)
    command = _command(robot, networks['after'], theta)
    traces = {'arm': _run_arm(study.arm(seed), command)}
    for when, mae in networks.items():
        traces[when] = _run_simulator(Simulation(robot, mae, study.preset), robot, command)
    numbers: dict[str, Any] = {
        'flexed_joint': robot.joints[elbow(robot)],
        'flexed_rad': float(theta[elbow(robot)]),
        'forced_joint': robot.joints[shoulder(robot)],
        'forced_rad': within(robot, shoulder(robot), FORCED),
    }
    for phase, end in zip(PHASES, ENDS, strict=True):
        numbers[phase.name] = {
            who: {
                'theta_rad': trace.theta[end].tolist(),
                'tension_n': float(np.linalg.norm(trace.tension[end])),
            }
            for who, trace in traces.items()
            if who != 'arm' or phase in SHARED
        }
    return Measured(numbers, traces)


def _command(robot: Robot, mae: Mae, theta: Array) -> Array:
    """Return the lengths with which `proposed` holds a posture, by a network."""
    limits, torque = robot.tension, robot.kinematics.holding_torque(theta)
    if (limits.limit <= limits.bias).any():
        return robot.muscle_lengths(theta, np.full(robot.muscle_count, robot.tension.bias))
    start = least_tension(robot.routes.muscle_jacobian(theta), torque, limits.bias, limits.limit)
    return proposed(robot, mae, theta, torque, start.tension, limits.limit).length


def _run_simulator(simulated: Simulation, robot: Robot, command: Array) -> Motion:
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
    return Motion(*columns(rows))


def _run_arm(arm: Arm, command: Array) -> Motion:
    rows = []
    for phase in (SETTLING, *PHASES):
        arm.set_wrench(np.array([*phase.force, 0.0, 0.0, 0.0]))
        for _ in range(round(phase.duration / STEP)):
            arm.command_length(command)
            arm.step(STEP)
            rows.append((arm.theta, arm.tension))
    return Motion(*columns(rows[round(SETTLING.duration / STEP) :]))


def _phases(numbers: dict[str, Any]) -> list[str]:
    """Return the names of the phases, with the joints and angles of this robot."""
    flexed_deg, forced_deg = np.degrees([numbers['flexed_rad'], numbers['forced_rad']])
    names = [phase.name for phase in PHASES]
    names[0] = f'{numbers["flexed_joint"]}\n{flexed_deg:.0f}°'
    names[3] = f'{numbers["forced_joint"]}\nforced to {forced_deg:.0f}°'
    return [name.replace('-', '−') for name in names]


def loss_change(study: Study, rows: Rows) -> Plot:
    """Draw joint angles and tensions over time."""
    (seed, row), robot = first_individual(rows), study.robot
    figure, panels = plots.new_figure(12.0, 7.4, 2, sharex=True)
    after, arm = row.traces['after'], row.traces['arm']
    time = STEP * np.arange(len(after.theta))
    edges = np.cumsum([0.0, *(phase.duration for phase in PHASES)])
    shared = time < edges[len(SHARED)] - 1e-9
    degrees = [(*plot_unit(robot, joint), name) for joint, name in enumerate(robot.joints)]
    newtons = [(1.0, 'N', name) for name in robot.muscles]
    for panel, key, lines in zip(panels, Motion._fields, (degrees, newtons), strict=True):
        for i, (factor, unit, name) in enumerate(lines):
            label = name if unit in ('deg', 'N') else f'{name} [{unit}]'
            simulated = factor * getattr(after, key)[:, i]
            panel.plot(time, simulated, color=f'C{i}', lw=1.6, label=label)
            emulated = np.where(shared, factor * getattr(arm, key)[:, i], np.nan)
            panel.plot(time, emulated, color=f'C{i}', lw=1.0, ls='--')
        panel.plot([], [], color=plots.TRUE, lw=1.6, label='simulator after learning')
        panel.plot([], [], color=plots.TRUE, lw=1.0, ls='--', label='emulated arm')
        for edge in edges[1:-1]:
            panel.axvline(edge, color='#BBBBBB', lw=1)
        panel.set_xlim(0.0, edges[-1])
    plots.tidy(panels[0], '', 'joint angle [deg]', legend='right')
    plots.tidy(panels[1], 'time [s]', 'muscle tension [N]', legend='right')
    style = {'ha': 'center', 'va': 'bottom', 'fontsize': 9}
    for at, name in zip(0.5 * (edges[:-1] + edges[1:]), _phases(row.numbers), strict=True):
        panels[0].text(at, 1.02, name, transform=panels[0].get_xaxis_transform(), **style)
    figure.suptitle(f'individual {seed}')
    return figure, (
        'The simulator after learning while forces act on the hand and a joint is forced. '
        'Dashed: the emulated arm under the same forces (its joints cannot be forced).'
    )


def loss_change_pictures(study: Study, rows: Rows) -> Plot:
    """Draw the arm at the end of each phase."""
    seed, (numbers, traces) = first_individual(rows)
    names = [name.replace('\n', ' ') for name in _phases(numbers)[:4]]
    moments = dict(zip(names, map(int, ENDS[:4]), strict=True))
    motions = {f'{when} learning': traces[when] for when in plots.WHEN}
    return plots.pictures(study.robot, motions, moments, f'simulator of individual {seed}'), (
        'The simulator at the end of each phase, before and after learning.'
    )


EXPERIMENT = Experiment(__doc__, measure, (loss_change, loss_change_pictures), 0.5)
