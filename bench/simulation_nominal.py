# SPDX-License-Identifier: Apache-2.0
"""Does the simulator rest where the nominal body rests, and give way to pushes as it does?

    python -m bench simulation_nominal --checkpoint FILE [--robot NAME|DIR] [--preset …] [--quick]

(Paper, section "Simulation".) On a network trained on the geometric model, against that model as a
body: the emulated arm without individual differences and friction. `compare` puts simulator and any
emulated arm under the same commands.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bench.sim_responses import FLEXED, FORCED, print_responses
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.methods import msc_compensation
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.emulator.individual import NOMINAL, Individual
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser, exit_status
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension
from musculoskeletal_ae.simulation.simulation import Simulation

STEP = 0.01  # [s]
STILL = 1e-4  # [rad/s]
LONGEST_WAIT = 20.0  # [s]


class Distance(NamedTuple):
    """Mean over samples of ‖θ_sim − θ‖₂ [rad] and ‖T_sim − T‖₂ [N]."""

    theta: float
    tension: float


def random_commands(robot: Robot, count: int, seed: int) -> Array:
    """Return l_target [m] (count, M) of random postures that can be held, at random tensions."""
    rng = np.random.default_rng(seed)
    low, high = robot.tension.bias, robot.tension.limit
    commands: list[Array] = []
    while len(commands) < count:
        theta = robot.random_postures(1, rng)[0]
        jacobian = robot.routes.muscle_jacobian(theta)
        torque = robot.kinematics.holding_torque(theta)
        desired = rng.uniform(low, 0.6 * high)
        try:
            tension = holding_tension(jacobian, torque, low, high, desired)
        except InfeasibleError:
            continue
        commands.append(robot.muscle_lengths(theta, tension) + msc_compensation(robot, tension))
    return np.array(commands)


def settle_arm(arm: EmulatedArm, command: Array) -> tuple[Array, Array]:
    """Hold a command until the emulated arm is still; return true θ [rad] and T [N]."""
    for _ in range(round(LONGEST_WAIT / 0.1)):
        arm.command_length(command)
        arm.step(0.1)
        if np.abs(arm.velocity).max() < STILL:
            break
    return arm.theta.copy(), arm.tension


def rest_errors(
    robot: Robot, mae: Mae, preset: str, commands: Array
) -> tuple[Array, Array, Array, Array]:
    """Return how far the simulator rests from the nominal body and drifts in 1000 steps.

    Returns:
        |Δθ| of the rest [rad] (N, D), |ΔT| of the rest [N] (N, M), and the largest departure of θ
        [rad] and T [N] from the simulator's own rest, each (N,).
    """
    body = Individual(robot, 0, NOMINAL)
    simulated = Simulation(robot, mae, preset, len(commands))
    true = []
    for command in commands:
        arm = EmulatedArm(robot, 0, body)
        true.append(settle_arm(arm, command))
    theta, tension = (np.stack(part) for part in zip(*true, strict=True))
    # As the emulated arms: from hanging, under the command of the posture.
    simulated.command = commands
    rest = simulated.settle()
    drift, tension_drift = np.zeros((2, len(commands)))
    for _ in range(1000):
        state = simulated.step(STEP)
        drift = np.maximum(drift, np.abs(state.theta - rest.theta).max(axis=1))
        moved = np.abs(state.tension - rest.tension).max(axis=1)
        tension_drift = np.maximum(tension_drift, moved)
    return np.abs(rest.theta - theta), np.abs(rest.tension - tension), drift, tension_drift


def compare(
    arm: EmulatedArm, simulated: Simulation, commands: Sequence[Array], duration: float
) -> Distance:
    """Return how far the simulator is from an arm under the same commands, moving and resting.

    Args:
        arm: Any individual.
        simulated: One simulated arm.
        commands: l_target [m], each shape (M,).
        duration: How long each is held [s].
    """
    theta, tension = [], []
    for command in commands:
        simulated.command = command[None]
        for _ in range(round(duration / STEP)):
            arm.command_length(command)
            arm.step(STEP)
            state = simulated.step(STEP)
            theta.append(np.linalg.norm(state.theta[0] - arm.theta))
            tension.append(np.linalg.norm(state.tension[0] - arm.tension))
    return Distance(float(np.mean(theta)), float(np.mean(tension)))


def report(robot: Robot, mae: Mae, preset: str, quick: bool) -> None:
    """Print the measurements."""
    commands = random_commands(robot, 8 if quick else 50, seed=0)
    theta, tension, drift, tension_drift = rest_errors(robot, mae, preset, commands)
    worst = theta.max(axis=1)
    print(f'{len(commands)} commands over the range, preset {preset}:')
    print(
        f'  rest, from the nominal body: largest joint error {worst.mean():.4f} rad mean, '
        f'{worst.max():.4f} rad max, within 0.05 rad {np.mean(worst <= 0.05):.0%}; '
        f'tension {tension.mean():.2f} N mean, {tension.max():.1f} N max'
    )
    print(f'  held for 1000 steps: {drift.max():.2e} rad, {tension_drift.max():.2e} N at most')
    if {FLEXED, FORCED} <= set(robot.joints):
        print_responses(robot, mae, preset)


def main(argv: list[str] | None = None) -> int:
    """Print the measurements for a checkpoint."""
    parser = Parser('simulation_nominal', 'The simulator beside the nominal body.')
    parser.add_robot()
    parser.add_checkpoint(required=True)
    parser.add_preset('of the simulator')
    parser.add_quick('fewer commands')
    args = parser.parse_args(argv)

    def work() -> None:
        robot = Robot.load(args.robot)
        report(robot, checkpoint.load(args.checkpoint, robot), args.preset, args.quick)

    return exit_status(work)


if __name__ == '__main__':
    sys.exit(main())
