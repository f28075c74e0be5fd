# SPDX-License-Identifier: Apache-2.0
"""Estimate joint angles and learn an arm in plain Python, without ROS.

    . .venv/bin/activate                     # if you have run bringup.sh; otherwise see below
    python examples/learn_in_python.py       # in the repository; takes about 40 s on an idle core

Ctrl-C ends it after the current posture, and saves what has been learned. Replace `EmulatedArm` by
the interface to your muscles. If you have not run bringup.sh, install the package without ROS:

    python -m venv arm && . arm/bin/activate
    pip install --extra-index-url https://download.pytorch.org/whl/cpu .      # in the repository
"""

import argparse
import os
import signal

if __name__ == '__main__':  # Ctrl-C or SIGTERM ends the program at once, until it learns
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(130))

import sys
from pathlib import Path
from time import perf_counter

import numpy as np

from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.process_signals import STOP, Reaction
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
    type=Path,
    default='learned.safetensors',
    help='file to which the learned network is written',
)
options = parser.parse_args()


def show_progress(step: int, *_: object) -> None:
    """Print a line after every hundredth step of the initial training."""
    if step % 100 == 0:
        print(f'training on the geometric model: step {step} of {options.steps}', flush=True)


robot = Robot.load('arm26')  # or the directory of your robot.urdf and muscles.yaml
initial = initial_mae(robot, steps=options.steps, progress=show_progress)
arm = EmulatedArm(robot, seed=1)
learner = Learner(robot, initial)

rng, time = np.random.default_rng(0), 0.0
errors = []  # errors of the initial and of the newest network [rad], at each rest
begun = perf_counter()
STOP.install(Reaction.REMEMBER)  # from now on, Ctrl-C or SIGTERM ends the loop
for theta in robot.random_postures(options.postures, rng):
    if STOP.received:
        break
    tension = rng.uniform(40.0, 120.0, robot.muscle_count)
    goal = robot.muscle_lengths(theta[None], tension[None])[0]
    direction, start = FrictionDirection(), arm.sense().muscles.length
    for step in range(150):  # move for 0.5 s, then rest for 1 s
        time += PERIOD
        arm.command_length(start + (goal - start) * min(1.0, step / 50))
        arm.step(PERIOD)
        read = arm.sense()
        muscles = read.muscles
        sliding = direction.step(muscles.length)
        learner.step(time, read.theta, muscles.tension, muscles.length)
    estimates = [
        # Bone-side tension: T minus the tendon friction that the network has learned.
        mae.estimate(mae.transmission.end(muscles.tension, sliding), muscles.length).theta
        for mae in (initial, learner.mae)
    ]
    errors.append([np.linalg.norm(estimate - read.theta) for estimate in estimates])
    done = len(errors)
    count = f'posture {done} of {options.postures}'
    left = (perf_counter() - begun) / done * (options.postures - done)
    # The first postures take longer, so they are no basis for an estimate.
    note = f', about {left:.0f} s left' if 10 * done >= options.postures else ''
    print(f'{count}: error {errors[-1][1]:.3f} rad, {learner.updates} updates{note}', flush=True)

print(f'{len(learner.samples)} samples, {learner.updates} updates')
if errors:
    before, after = np.mean(errors[-10:], axis=0)
    print(f'error in the last postures: {before:.3f} rad before learning, {after:.3f} rad after')
if STOP.received:
    out = options.out.with_name(f'{options.out.stem}.interrupted{options.out.suffix}')
    checkpoint.save(learner.mae, out)
    print(f'interrupted: {out} has the network learned so far', file=sys.stderr)
    sys.exit(130)
checkpoint.save(learner.mae, options.out)
