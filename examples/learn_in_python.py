# SPDX-License-Identifier: Apache-2.0
"""Estimate joint angles and learn an arm in plain Python, without ROS.

    python -m venv arm && . arm/bin/activate
    pip install --extra-index-url https://download.pytorch.org/whl/cpu .      # in the repository
    python examples/learn_in_python.py

Replace `EmulatedArm` by the interface to your muscles.
"""

import argparse
import os
import signal

if __name__ == '__main__':  # Ctrl-C or SIGTERM ends the program at once
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(130))

import numpy as np

from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.friction import FrictionDirection

PERIOD = 0.01  # time between two readings [s]

parser = argparse.ArgumentParser(description='Learn an emulated arm, and estimate its joints.')
parser.add_argument(
    '--postures', type=int, default=40, help='number of postures in which the arm rests'
)
parser.add_argument(
    '--steps', type=int, default=1000, help='number of steps of the initial training'
)
parser.add_argument(
    '--out',
    default='learned.safetensors',
    help='file to which the learned network is written',
)
options = parser.parse_args()


def show_progress(step: int, *_: object) -> None:
    """Print a line after every hundredth step of the initial training."""
    if step % 100 == 0:
        print(f'training on the geometric model: step {step} of {options.steps}', flush=True)


robot = Robot.load('arm26')  # or the directory of your robot.urdf and muscles.yaml
initial = initial_mae(robot, steps=options.steps, progress=show_progress).mae
arm = EmulatedArm(robot, seed=1)
learner = Learner(robot, initial)

rng, time = np.random.default_rng(0), 0.0
errors = []  # errors of the initial and of the newest network [rad], at each rest
for theta in robot.random_postures(options.postures, rng):
    tension = rng.uniform(40.0, 120.0, robot.muscle_count)
    goal = robot.muscle_lengths(theta[None], tension[None])[0]
    direction, start = FrictionDirection(), arm.sense().length
    for step in range(150):  # move for 0.5 s, then rest for 1 s
        time += PERIOD
        arm.command_length(start + (goal - start) * min(1.0, step / 50))
        arm.step(PERIOD)
        read = arm.sense()
        sliding = direction.step(read.length)
        learner.step(time, read.theta, read.tension, read.length)
    estimates = [
        # Bone-side tension: T minus the tendon friction that the network has learned.
        mae.estimate(mae.transmission.end(read.tension, sliding), read.length).theta
        for mae in (initial, learner.mae)
    ]
    errors.append([np.linalg.norm(estimate - read.theta) for estimate in estimates])
    count = f'posture {len(errors)} of {options.postures}'
    print(f'{count}: error {errors[-1][1]:.3f} rad, {learner.updates} updates', flush=True)

before, after = np.mean(errors[-10:], axis=0)
print(f'{len(learner.samples)} samples, {learner.updates} updates')
print(f'error in the last postures: {before:.3f} rad before learning, {after:.3f} rad after')
checkpoint.save(learner.mae, options.out)
