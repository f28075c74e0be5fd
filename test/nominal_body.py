# SPDX-License-Identifier: Apache-2.0
"""Measures control of the nominal body, where all errors are those of the network.

1. posture: the arm settles under the lengths that each method commands. The error of the posture
   and the norm of the tensions, ‖T‖, are compared with a lower bound: lengths computed from the
   true body for the least tensions that hold the posture.
2. stiffness: deflections by a push at a low and at a high stiffness (the lower and the upper
   quarter of the reported reachable range). Their ratio is compared with the predicted one.
"""

from collections.abc import Sequence

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.emulator.kin.individual import NOMINAL, Individual
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion import methods
from musculoskeletal_ae.motion.explored_postures import TRIES, holdable_postures
from musculoskeletal_ae.motion.methods import stiffness_command
from musculoskeletal_ae.motion.tension_plan import plan_at_rest
from musculoskeletal_ae.paper.control import proposed as proposed_as_printed
from musculoskeletal_ae.robot.robot import Robot

SETTLING, PERIOD = 3.0, 0.02  # time until the arm rests, and between two commands [s]
#: low and high stiffness, as shares of the reachable range: middles of its outer quarters
QUARTERS = (0.125, 0.875)
PUSH = 1.0  # torque of the push at the joint [N·m]


def nominal_arm(robot: Robot) -> EmulatedArm:
    """Return an emulated arm that behaves exactly as the geometric model."""
    return EmulatedArm(robot, 0, Individual(robot, 0, NOMINAL))


def settle(arm: EmulatedArm, length: Array) -> None:
    """Run until the arm rests under a command [m] (M,)."""
    for _ in range(round(SETTLING / PERIOD)):
        arm.command_length(length)
        arm.step(PERIOD)


def posture_table(robot: Robot, mae: Mae, paper: Mae, count: int) -> dict[str, Array]:
    """Return the results of each control method by its name, (N, 3), for N holdable postures.

    A row has the error of the reached posture [rad], the norm of its tensions [N], and the norm of
    the least tensions that hold the target [N].
    """
    arm = nominal_arm(robot)
    rows: dict[str, list[tuple[float, float, float]]] = {}
    bias = np.full(robot.muscle_count, robot.tension.bias)
    postures = robot.random_postures(TRIES, np.random.default_rng(5))
    for theta, least in holdable_postures(robot, postures, count):
        torque = robot.kinematics.holding_torque(theta)
        bound = robot.muscle_lengths(theta, least) + methods.msc_compensation(robot, least)

        def measure(name: str, command: Array, theta: Array = theta, least: Array = least) -> None:
            settle(arm, command)
            error, tension = np.linalg.norm(arm.theta - theta), np.linalg.norm(arm.tension)
            row = float(error), float(tension), float(np.linalg.norm(least))
            rows.setdefault(name, []).append(row)

        for name, command in {
            'bound: QP on the true body': bound,
            'QP on the true G, l from ①': methods.first_command(robot, mae, theta, least),
            'proposed': plan_at_rest(robot, mae, theta).length(mae, theta),
            'proposed, paper': proposed_as_printed(robot, paper, theta, torque, bias).length,
            'geometric': robot.muscle_lengths(theta, bias),
        }.items():
            arm.reset(theta)
            measure(name, command)
        for network, suffix in ((mae, ''), (paper, ', paper')):
            arm.reset(theta)
            measure(f'first{suffix}', methods.first_command(robot, network, theta, bias))
            current = methods.first_command(robot, network, theta, arm.tension)
            measure(f'second{suffix}', current)
    return {name: np.array(values) for name, values in rows.items()}


def push_deflection(robot: Robot, theta: Array, stiffness: Array, wrench: Array) -> Array:
    """Return the deflection by a small push, (K_θ + ∂g/∂θ)⁻¹ Jᵀ F [rad], shape (D,).

    Args:
        robot: The geometric model.
        theta: θ at which the arm rests [rad], shape (D,).
        stiffness: K_θ [N·m/rad], shape (D, D).
        wrench: F on the end effector [N, N·m], axes of the root link, shape (6,).
    """
    torque = robot.kinematics.end_effector_jacobian(theta).T @ wrench
    turn: Array = np.linalg.inv(stiffness + robot.kinematics.holding_gradient(theta)) @ torque
    return turn


def stiffness_ratios(
    robot: Robot,
    mae: Mae,
    chosen: Sequence[int],
    arm: EmulatedArm | None = None,
    push: float = PUSH,
) -> Array:
    """Return by how much more the arm yields to a push at low than at high stiffness, (N, 2).

    Each row has the measured and the predicted ratio of the two deflections.

    Args:
        robot: The geometric model.
        mae: The network.
        chosen: Numbers of random holdable postures; in each, another joint is stiffened, in turn.
        arm: The emulated arm; by default a nominal one.
        push: The push is the wrench that comes nearest to this torque [N·m] on that joint alone.
    """
    arm = arm or nominal_arm(robot)
    ratios = []
    postures = robot.random_postures(TRIES, np.random.default_rng(8))
    held = [*holdable_postures(robot, postures, max(chosen) + 1, arm.individual.muscle_jacobian)]
    for n in chosen:
        (theta, _), joint = held[n], n % robot.joint_count
        torque = robot.kinematics.holding_torque(theta)
        desired = np.zeros(robot.joint_count)
        free = stiffness_command(robot, mae, theta, torque, desired, robot.tension.limit).stiffness
        low, high = free.lowest[joint], free.highest[joint]
        jacobian = robot.kinematics.end_effector_jacobian(theta)
        wrench = np.asarray(push * np.linalg.pinv(jacobian.T)[:, joint], dtype=np.float64)
        deflections = []
        for quarter in QUARTERS:
            desired[joint] = low + quarter * (high - low)
            solution = stiffness_command(robot, mae, theta, torque, desired, robot.tension.limit)
            expected = push_deflection(robot, theta, solution.stiffness.expected, wrench)[joint]
            moved = _pushed(arm, theta, solution.length, wrench)[joint]
            deflections.append((moved, expected))
        (soft, soft_expected), (stiff, stiff_expected) = deflections
        ratios.append((soft / stiff, soft_expected / stiff_expected))
    return np.array(ratios)


def _pushed(arm: EmulatedArm, theta: Array, length: Array, wrench: Array) -> Array:
    """Return half the difference between the postures under a push and its opposite [rad], (D,)."""
    arm.reset(theta)
    settle(arm, length)
    ends = []
    for sign in (1.0, -1.0):
        arm.set_wrench(sign * wrench)
        settle(arm, length)
        ends.append(arm.theta)
    arm.set_wrench(np.zeros(6))
    turned: Array = 0.5 * (ends[0] - ends[1])
    return turned
