# SPDX-License-Identifier: Apache-2.0
"""Does the torque balance at rest, g(θ) + G(θ)ᵀ T = 0, hold for what was learned, and add to it?

python -m bench torque_residual [--robot …] [--seeds 0,1] [--minutes 10]

(PIMBS learns a body image from this residual at rest.) For the samples of an exploration it prints
the residual with the true G, with that of the learned body and with the geometric model's, and how
far the last two are from the truth. What the true body leaves is friction, and joints that lean on
their limits. Where the learned body leaves as little, the residual is met and has no more to say:
the lengths have told G already, and far more exactly than the torques could.
"""

from pathlib import Path

import numpy as np
import torch

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.experiments.least_squares import learned
from musculoskeletal_ae.experiments.online_learning import teach
from musculoskeletal_ae.experiments.recording import EXPLORATION_STREAM, record
from musculoskeletal_ae.learning.body import CorrectedBody, fit_body
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

FITS = 3  # each goes on fitting from where the last one ended


def rms(values: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def table(robot: Robot, mae: Mae, seed: int, minutes: float) -> str:
    """Return the lines of one individual."""
    stream = record(EmulatedArm(robot, seed), mae, EXPLORATION_STREAM + seed, 60.0 * minutes)
    learner = Learner(robot, seed=seed)
    teach(learner, zip(*stream, strict=True))
    seen, body = learner.samples.observations(), CorrectedBody(robot, seed=seed)
    for _ in range(FITS):
        fit_body(body, seen)
    holding = np.array([robot.kinematics.holding_torque(theta) for theta in seen.theta])
    true = Individual(robot, seed).muscle_jacobian(seen.theta)
    fitted = learned(robot, body).muscle_jacobian(seen.theta)
    nominal = np.array([robot.routes.muscle_jacobian(theta) for theta in seen.theta])
    lines = [f'individual {seed}, {len(seen)} samples, holding torque {rms(holding):.2f} N·m']
    for name, jacobian in (('true', true), ('learned', fitted), ('geometric', nominal)):
        residual = holding + np.einsum('nmd,nm->nd', jacobian, seen.tension)
        lines.append(
            f'  {name:10s} residual {rms(residual):.3f} N·m, '
            f'error of G {1e3 * rms(jacobian - true):.2f} mm/rad'
        )
    return '\n'.join(lines)


def main(argv: list[str]) -> None:
    """Print the table."""
    parser = Parser('torque_residual', 'The torque balance at rest of what was learned.')
    parser.add_robot()
    parser.add_seeds((0,))
    parser.add_minutes('duration of the exploration', 10.0)
    parser.add_argument('--initial', type=Path, help='checkpoint, instead of training one')
    args = parser.parse_args(argv)
    torch.set_num_threads(1)

    robot = Robot.load(args.robot)
    mae = checkpoint.load(args.initial, robot) if args.initial else initial_mae(robot).mae
    for seed in args.seeds:
        print(table(robot, mae, seed, args.minutes), flush=True)
