# SPDX-License-Identifier: Apache-2.0
"""Simulation under external forces and constraints.

Paper (§IV-D). The elbow is bent to 90°. A force of −50 N in z acts on the hand, then one of 50 N
in y. Then the shoulder pitch S-p is forced to 30°.

Here. The elbow is flexed to 90°. A force of −50 N in z acts on the hand, then one of 50 N in y.
Then the shoulder is held at 30° and released. Each preset runs its own simulator on its networks
before and after learning. Preset `paper` minimises the paper's loss L_sim,2 while the shoulder is
held, and L_sim,1 in all other phases. The command that holds the flexed posture comes from method
`proposed` of each preset, with its learned network. The same forces act on an emulated arm with the
same command. The joints of the emulated arm cannot be held at an angle, so it is compared in the
first three phases only. On robots without joints named elbow_pitch and shoulder_pitch, joints named
elbow and shoulder replace them, or else the last and the first revolute joint.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
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
from musculoskeletal_ae.motion.tension_plan import plan_at_rest
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension
from musculoskeletal_ae.simulation.simulation import Simulation

STEP = 0.02  # simulate in steps of this duration [s]
FORCED = 30.0  # hold the shoulder at this angle in the phase `shoulder forced` [deg]


class Phase(NamedTuple):
    """One phase of the experiment: its duration, and the force and constraint that act."""

    name: str
    duration: float  # duration of the phase [s]
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)  # external force on the hand [N]
    forced: bool = False  # whether the shoulder is forced to `FORCED`


PHASES = (
    Phase('elbow flexed', 4.0),
    Phase('−50 N in z', 3.0, (0.0, 0.0, -50.0)),
    Phase('50 N in y', 3.0, (0.0, 50.0, 0.0)),
    Phase('shoulder forced', 3.0, forced=True),
    Phase('released', 3.0),
)
SETTLING = Phase('settling', 5.0)  # the emulated arm comes to rest before the experiment
SHARED = PHASES[:3]  # phases in which the simulator is compared with the emulated arm
#: index of the last step of each phase
ENDS = np.cumsum([round(phase.duration / STEP) for phase in PHASES]) - 1


def measure(study: Study, seed: int) -> Measured:
    """Simulate all phases with the networks of one individual; compare with its emulated arm."""
    robot = study.robot
    theta = np.clip(np.zeros(robot.joint_count), robot.lower, robot.upper)
    theta[elbow(robot)] = flexed(robot)
    traces, numbers = dict[str, Any](), dict[str, Any]()
    for preset in study.presets:
        networks = study.networks(seed, preset)
        command = _command(robot, networks['after'], theta, preset)
        motions = {'arm': _run_arm(study.arm(seed), command)}
        for when, mae in networks.items():
            motions[when] = _run_simulator(Simulation(robot, mae, preset), robot, command)
        traces[preset] = motions
        numbers |= study.with_prefix(preset, _numbers(robot, motions))
    numbers |= {
        'flexed_joint': robot.joints[elbow(robot)],
        'flexed_rad': float(theta[elbow(robot)]),
        'forced_joint': robot.joints[shoulder(robot)],
        'forced_rad': within(robot, shoulder(robot), FORCED),
    }
    return Measured(numbers, traces)


def _numbers(robot: Robot, motions: Mapping[str, Motion]) -> dict[str, Any]:
    """Return the final states of the arm and of the simulators, by name of the phase.

    `flexed_rad` is the angle of the flexed joint (the elbow), and `forced_rad` that of the forced
    joint (the shoulder). `error_rad` and `error_n` are the distances between a simulator and the
    arm, in θ and in T. In the phases in which the arm does not take part, its values and these
    distances are missing.
    """
    numbers = dict[str, Any]()
    for phase, end in zip(PHASES, ENDS, strict=True):
        numbers[phase.name] = {}
        for who, motion in motions.items():
            theta, tension = motion.theta[end], motion.tension[end]
            if who == 'arm' and phase not in SHARED:
                continue
            values = {
                'theta_rad': theta.tolist(),
                'flexed_rad': float(theta[elbow(robot)]),
                'forced_rad': float(theta[shoulder(robot)]),
                'tension_n': float(np.linalg.norm(tension)),
            }
            if who != 'arm' and phase in SHARED:
                arm = motions['arm']
                values['error_rad'] = float(np.linalg.norm(theta - arm.theta[end]))
                values['error_n'] = float(np.linalg.norm(tension - arm.tension[end]))
            numbers[phase.name][who] = values
    return numbers


def _command(robot: Robot, mae: Mae, theta: Array, preset: str) -> Array:
    """Return the length command [m] (M,) by which a preset's method `proposed` holds θ [rad] (D,).

    If T_limit does not exceed T_bias for a muscle, the command holds the lengths of the geometric
    model at T_bias instead.
    """
    limits, torque = robot.tension, robot.kinematics.holding_torque(theta)
    if (limits.limit <= limits.bias).any():
        return robot.muscle_lengths(theta, np.full(robot.muscle_count, robot.tension.bias))
    start = least_tension(robot.routes.muscle_jacobian(theta), torque, limits.bias, limits.limit)
    method = preset_named(preset).length_methods().get('proposed')
    if method is not None:
        return method.command(robot, mae, theta, torque, start.tension).length
    return plan_at_rest(robot, mae, theta).length(mae, theta)


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
    """Return plot labels of the phases, with the joints and angles of the robot of `numbers`."""
    flexed_deg, forced_deg = np.degrees([numbers['flexed_rad'], numbers['forced_rad']])
    names = [phase.name for phase in PHASES]
    names[0] = f'{numbers["flexed_joint"]}\n{flexed_deg:.0f}°'
    names[3] = f'{numbers["forced_joint"]}\nforced to {forced_deg:.0f}°'
    return [name.replace('-', '−') for name in names]


def loss_change(study: Study, rows: Rows) -> Plot:
    """Draw joint angles and tensions of simulator and arm over time, a column for each preset."""
    (seed, row), robot = first_individual(rows), study.robot
    presets = list(row.traces)
    figure, panels = plots.new_figure(
        5.6 * len(presets) + 2.4, 7.4, 2, len(presets), sharex=True, sharey='row'
    )
    time = STEP * np.arange(len(row.traces[presets[0]]['after'].theta))
    edges = np.cumsum([0.0, *(phase.duration for phase in PHASES)])
    shared = time < edges[len(SHARED)] - 1e-9
    degrees = [(*plot_unit(robot, joint), name) for joint, name in enumerate(robot.joints)]
    newtons = [(1.0, 'N', name) for name in robot.muscles]
    for column, preset in enumerate(presets):
        after, arm = row.traces[preset]['after'], row.traces[preset]['arm']
        both = panels[column], panels[len(presets) + column]
        for panel, key, lines in zip(both, Motion._fields, (degrees, newtons), strict=True):
            for i, (factor, unit, name) in enumerate(lines):
                label = name if unit in ('deg', 'N') else f'{name} [{unit}]'
                simulated = factor * getattr(after, key)[:, i]
                panel.plot(time, simulated, color=f'C{i}', lw=1.6, label=label)
                emulated = np.where(shared, factor * getattr(arm, key)[:, i], np.nan)
                panel.plot(time, emulated, color=f'C{i}', lw=1.0, ls='--')
            panel.plot([], [], color=plots.TRUE, lw=1.6, label='simulator')
            panel.plot([], [], color=plots.TRUE, lw=1.0, ls='--', label='emulated arm')
            for edge in edges[1:-1]:
                panel.axvline(edge, color='#BBBBBB', lw=1)
            panel.set_xlim(0.0, edges[-1])
        legend = 'right' if preset == presets[-1] else ''
        ylabels = ('joint angle [deg]', 'muscle tension [N]') if column == 0 else ('', '')
        plots.tidy(both[0], '', ylabels[0], f'preset {preset}\n\n', legend=legend)
        plots.tidy(both[1], 'time [s]', ylabels[1], legend=legend)
        style = {'ha': 'center', 'va': 'bottom', 'fontsize': 7}
        for at, name in zip(0.5 * (edges[:-1] + edges[1:]), _phases(row.numbers), strict=True):
            both[0].text(at, 1.02, name, transform=both[0].get_xaxis_transform(), **style)
    figure.suptitle(f'individual {seed}: response of the simulator after learning')
    return figure, (
        'The simulator after learning: first, forces act on the hand; then a joint is held at a '
        'given angle. Dashed: the emulated arm under the same forces (its joints cannot be held at '
        'an angle).'
    )


def loss_change_pictures(study: Study, rows: Rows) -> Plot:
    """Draw the simulated arm at the end of each phase."""
    seed, (numbers, traces) = first_individual(rows)
    names = [name.replace('\n', ' ') for name in _phases(numbers)[:4]]
    moments = dict(zip(names, map(int, ENDS[:4]), strict=True))
    motions = {
        f'{preset}, {when} learning': motions[when]
        for preset, motions in traces.items()
        for when in plots.WHEN
    }
    return plots.pictures(study.robot, motions, moments, f'simulator of individual {seed}'), (
        'The simulator of each preset at the end of each phase, before and after learning.'
    )


EXPERIMENT = Experiment(__doc__, measure, (loss_change, loss_change_pictures), 1.0)
