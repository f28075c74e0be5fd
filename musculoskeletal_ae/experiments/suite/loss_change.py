# SPDX-License-Identifier: Apache-2.0
"""What the simulator does when its loss changes: pushed, pushed aside, a joint forced.

The elbow is flexed to 90°; the hand is pushed with −50 N in z, then with 50 N in y; then the
shoulder is forced to 30° and let go. The emulated arm is pushed alike; joints of it cannot be
forced, so that phase is the simulator's alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.methods import geometric_command, proposed
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.experiments.suite.roles import elbow, flexed, shoulder, within
from musculoskeletal_ae.experiments.suite.study import Measured, Progress, Study
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension
from musculoskeletal_ae.simulation.simulation import Simulation

STEP = 0.02  # [s]
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


def measure(study: Study, seed: int, progress: Progress) -> Measured:
    """Return the numbers and traces of one individual."""
    robot = study.body()
    after = study.learnt(robot, seed)
    theta = np.clip(np.zeros(robot.joint_count), robot.lower, robot.upper)
    theta[elbow(robot)] = flexed(robot)
    command = _command(robot, after, theta)
    arm = _arm(EmulatedArm(robot, seed), command)
    progress(0.4)
    traces: dict[str, Any] = {'arm': arm}
    for when, mae in (('before', study.initial(robot)), ('after', after)):
        traces[when] = _simulated(robot, mae, study.preset, command)
        progress(0.3)
    elbow_name, shoulder_name = robot.joints[elbow(robot)], robot.joints[shoulder(robot)]
    numbers: dict[str, Any] = {
        'flexed_joint': elbow_name,
        'flexed_rad': float(theta[elbow(robot)]),
        'forced_joint': shoulder_name,
        'forced_rad': within(robot, shoulder(robot), FORCED),
    }
    ends = np.cumsum([round(phase.duration / STEP) for phase in PHASES]) - 1
    for phase, end in zip(PHASES, ends, strict=True):
        row: dict[str, Any] = {}
        for who, trace in traces.items():
            if who == 'arm' and (phase.forced or phase.name == 'released'):
                continue
            row[who] = {
                'theta_rad': trace['theta'][end].tolist(),
                'tension_n': float(np.linalg.norm(trace['tension'][end])),
            }
        numbers[phase.name] = row
    return Measured(numbers, traces)


def _command(robot: Robot, mae: Mae, theta: Array) -> Array:
    """Return the lengths that hold a posture, by `proposed` on the learnt network."""
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
    for _ in range(round(5.0 / STEP)):
        arm.command_length(command)
        arm.step(STEP)
    rows = []
    for phase in PHASES:
        arm.set_wrench(np.array([*phase.force, 0.0, 0.0, 0.0]))
        for _ in range(round(phase.duration / STEP)):
            arm.command_length(command)
            arm.step(STEP)
            rows.append((arm.theta, arm.tension))
    return _stacked(rows)


def _stacked(rows: list[tuple[Array, Array]]) -> dict[str, Array]:
    theta, tension = (np.array(column) for column in zip(*rows, strict=True))
    return {'theta': theta, 'tension': tension}
