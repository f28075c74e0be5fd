# SPDX-License-Identifier: Apache-2.0
"""How body and simulator give way to a push and to a joint moved by force (paper, "loss_change").

−50 N in z at the hand, 50 N in y, shoulder pitch forced to 30°, each from the same rest with the
elbow flexed to 90°.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.nominal_rest import nominal_rest
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.methods import msc_compensation
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension
from musculoskeletal_ae.simulation.simulation import Simulation

FLEXED, FLEXION = 'elbow_pitch', np.radians(-90.0)
FORCED, FORCED_TO = 'shoulder_pitch', np.radians(30.0)
#: a joint has to move this far in the body before its direction and size are judged
NOTICEABLE = 0.05  # [rad]


class Response(NamedTuple):
    """How body and simulator answer a push or a forced joint, from the same rest.

    Attributes:
        name: What was done.
        body: Δθ of the body [rad], shape (D,).
        simulated: Δθ of the simulator [rad], shape (D,).
        body_tension: ΔT of the body [N], shape (M,).
        simulated_tension: ΔT of the simulator [N], shape (M,).
    """

    name: str
    body: Array
    simulated: Array
    body_tension: Array
    simulated_tension: Array


def responses(robot: Robot, mae: Mae, preset: str) -> list[Response]:
    """Return the answers of the geometric model as a body, and of the simulator."""
    theta = np.clip(np.zeros(robot.joint_count), robot.lower, robot.upper)
    theta[robot.joints.index(FLEXED)] = FLEXION
    jacobian = robot.routes.muscle_jacobian(theta)
    torque = robot.kinematics.holding_torque(theta)
    limits = robot.tension
    tension = holding_tension(jacobian, torque, limits.bias, limits.limit, 2.0 * limits.bias)
    command = robot.muscle_lengths(theta, tension) + msc_compensation(robot, tension)
    simulated = Simulation(robot, mae, preset)
    simulated.start_from(theta[None])
    simulated.command = command[None]
    start = simulated.settle()
    result = []
    forced = np.full(robot.joint_count, np.nan)
    forced[robot.joints.index(FORCED)] = FORCED_TO
    free, none = np.full(robot.joint_count, np.nan), np.zeros(6)
    for name, wrench, fixed in (
        ('-50 N in z', np.array([0.0, 0.0, -50.0, 0.0, 0.0, 0.0]), free),
        ('50 N in y', np.array([0.0, 50.0, 0.0, 0.0, 0.0, 0.0]), free),
        (f'{FORCED} forced to 30°', none, forced),
    ):
        simulated.state = start
        simulated.wrench, simulated.fixed = wrench[None], fixed[None]
        after = simulated.settle()
        body = nominal_rest(robot, command, theta, tension, wrench, fixed)
        result.append(
            Response(
                name,
                body.theta - theta,
                (after.theta - start.theta)[0],
                body.tension - tension,
                (after.tension - start.tension)[0],
            )
        )
    return result


def print_responses(robot: Robot, mae: Mae, preset: str) -> None:
    """Print the answers side by side."""
    for answer in responses(robot, mae, preset):
        print(f'{answer.name}: Δθ [rad] of body and simulator')
        for name, body, simulated in zip(robot.joints, answer.body, answer.simulated):
            note = ''
            if abs(body) > NOTICEABLE:
                share = simulated / body
                note = f'  {share:.0%}' + ('' if 0.7 <= share <= 1.3 else '  beyond 30 %')
            print(f'  {name:<16}{body:>8.3f}{simulated:>8.3f}{note}')
        body_size = np.linalg.norm(answer.body_tension)
        apart = np.linalg.norm(answer.simulated_tension - answer.body_tension)
        print(f'  ‖ΔT‖ {body_size:.1f} N, {apart:.1f} N apart')
