# SPDX-License-Identifier: Apache-2.0
"""Print how far the emulated arms are from their model: the calibration table.

calibrate_emulator [--robot NAME|DIR] [--seeds 0,1,…] [--minutes 5]
"""

from __future__ import annotations

import argparse
import sys

from tqdm import tqdm

from bench.calibration import calibration, table
from musculoskeletal_ae import options
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.network import to_mae
from musculoskeletal_ae.mae.training import initial_training
from musculoskeletal_ae.robot.robot import Robot


def _trained(robot: Robot, preset: str) -> Mae:
    network, _ = initial_training(robot, preset)
    return to_mae(network, robot.joints, robot.muscles, preset, 'initial, on geometry')


def main() -> None:
    """Train both presets, record the motion on every individual and print the errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--robot', default='musashi_left_arm', help='name or directory')
    parser.add_argument('--seeds', type=options.seeds, default=tuple(range(10)), help='individuals')
    parser.add_argument('--minutes', type=options.minutes, default=5.0, help='of held-out motion')
    arguments = parser.parse_args()
    try:
        robot = Robot.load(arguments.robot)
        default, paper = _trained(robot, 'default'), _trained(robot, 'paper')
        total = 60.0 * arguments.minutes * len(arguments.seeds)
        with tqdm(total=total, unit=' robot s', unit_scale=True) as bar:
            rows = calibration(
                robot, default, paper, arguments.seeds, arguments.minutes, bar.update
            )
    except MusculoskeletalError as error:
        print(f'error: {error}', file=sys.stderr)
        sys.exit(1)
    print(table(rows))
