# SPDX-License-Identifier: Apache-2.0
"""Draws the simulated arm at rest, and with a weight in the hand.

    python -m bench sim_pictures --checkpoint FILE [--out doc]

The bench writes sim_at_rest.png and sim_loaded.png. `render --topic sim/markers` draws a running
simulator in the same way.
"""

from pathlib import Path

import numpy as np

from musculoskeletal_ae.control.methods import first_command
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.drawing import draw_arm, save_picture
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension
from musculoskeletal_ae.simulation.simulation import Simulation

LOAD = -50.0  # vertical force on the hand [N], as in the paper's simulation


def save_both(robot: Robot, mae: Mae, folder: Path) -> list[Path]:
    """Draw the simulated arm in mid-range, at rest and with a loaded hand; return both files."""
    simulated = Simulation(robot, mae)
    theta = 0.5 * (robot.lower + robot.upper)
    tension, _ = least_tension(
        mae.muscle_jacobian(theta, np.full(robot.muscle_count, robot.tension.bias)),
        robot.kinematics.holding_torque(theta),
        robot.tension.bias,
        robot.tension.limit,
    )
    simulated.command = first_command(robot, mae, theta, tension)[None]
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name, force, load in (
        ('at_rest', 0.0, 'nothing in the hand'),
        ('loaded', LOAD, f'{LOAD:g} N in z at the hand'),
    ):
        simulated.wrench = np.array([[0.0, 0.0, force, 0.0, 0.0, 0.0]])
        state = simulated.settle()
        lines = draw_arm(robot, state.theta[0], state.tension[0])
        title = (
            f'simulated arm, {load}: '
            f'{state.tension.min():.0f} to {state.tension.max():.0f} N '
            '(green at bias, red at the limit)'
        )
        files.append(folder / f'sim_{name}.png')
        save_picture(lines, files[-1], title)
    return files


def main(argv: list[str]) -> None:
    """Write both pictures."""
    parser = Parser('sim_pictures', 'Pictures of the simulated arm: at rest, and loaded.')
    parser.add_robot()
    parser.add_argument('--checkpoint', required=True, help='checkpoint of a trained network')
    parser.add_out('DIR', default=Path('doc/images'))
    args = parser.parse_args(argv)

    robot = Robot.load(args.robot)
    print(*save_both(robot, checkpoint.load(args.checkpoint, robot), args.out), sep='\n')
