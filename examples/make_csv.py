# SPDX-License-Identifier: Apache-2.0
"""Write a CSV file as somebody's own program might: other names, units and zeros.

    python examples/make_csv.py arm.csv                  # 150 resting postures of an emulated arm26
    python examples/make_csv.py --moving moving.csv      # readings in 60 s that never rest

The tutorial doc/tutorials/train_from_csv.md learns from these files. Replace them by yours.
"""

import argparse
from pathlib import Path

import numpy as np

from musculoskeletal_ae.emulator.faults import ArmReadings
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.robot.robot import Robot

PERIOD = 0.01  # time between two readings [s]

parser = argparse.ArgumentParser(description='Write readings of an emulated arm as a CSV file.')
parser.add_argument('file', type=Path, help='where to write')
parser.add_argument('--moving', action='store_true', help='write a motion instead of rests')
parser.add_argument('--postures', type=int, default=150, help='number of postures (default: 150)')
parser.add_argument('--seed', type=int, default=0, help='random seed of postures (default: 0)')
options = parser.parse_args()

robot = Robot.load('arm26')
arm = EmulatedArm(robot, seed=1)  # an arm that deviates from its model
rng = np.random.default_rng(options.seed)
encoder_zero = 1e-3 * np.array([212.0, 180.5, 95.0, 301.0, 388.2, 402.7])  # [m]
names = [f'enc{i + 1} [mm]' for i in range(robot.muscle_count)]
names += [f'load cell {i + 1} [N]' for i in range(robot.muscle_count)]
lines = [';'.join(['t [ms]'] * options.moving + ['shoulder (deg)', 'q2', *names])]
time = 0.0


def write(read: ArmReadings) -> None:
    """Append a line with the readings, in degrees, millimetres and newtons."""
    angles = np.degrees(read.theta)
    length = 1e3 * (read.muscles.length + encoder_zero)
    cells = [*angles, *length, *read.muscles.tension]
    text = [f'{cell:.3f}' for cell in cells]
    lines.append(';'.join([f'{1e3 * time:.0f}'] * options.moving + text))


start = arm.sense().muscles.length
count = 60 if options.moving else options.postures
for theta in robot.random_postures(count, rng):
    tension = rng.uniform(40.0, 120.0, robot.muscle_count)
    goal = robot.muscle_lengths(theta[None], tension[None])[0]
    steps = 100 if options.moving else 150
    for step in range(steps):  # move for 1 s; or for 0.5 s, then rest for 1 s
        time += PERIOD
        share = (step + 1) / 100 if options.moving else min(1.0, (step + 1) / 50)
        arm.command_length(start + (goal - start) * share)
        arm.step(PERIOD)
        if options.moving:
            write(arm.sense())
    if not options.moving:
        write(arm.sense())
    start = goal
options.file.write_text('\n'.join(lines) + '\n', encoding='utf-8')
print(f'{options.file}: {len(lines) - 1} rows')
