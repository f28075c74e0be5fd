# SPDX-License-Identifier: Apache-2.0
"""Learns emulated recordings of an arm that never rests, and of one that rests in each posture.

    python -m bench moving [--robot arm26] [--reality kin] [--seeds 0,1]

Each recording has random postures. The arm that never rests moves for 2 s from one to the next; the
other one moves for 1 s, and then rests for 1 s. Both networks are tested on a minute of other
postures, with rests. The table in doc/explanation/learning.md comes from this bench.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.bags.streams import Pairs
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.experiments.workers import workers
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.recordings import errors, learn
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

PERIOD = 0.01  # record a reading at this interval [s]
TENSIONS = 40.0, 120.0  # draw the tensions at the postures from this range [N]


def record(
    robot: Robot, reality: str, seed: int, seconds: float, motion: float, rest: float, order: int
) -> Pairs:
    """Record an arm that moves to random postures; return the recording.

    Args:
        robot: The geometric model, which commands the lengths.
        reality: The emulator model of the individual.
        seed: Seed of the emulated individual.
        seconds: Duration of the recording [s].
        motion: Duration of each motion [s].
        rest: Duration of the rest after each motion [s].
        order: Seed of the postures.
    """
    arm, rng = make_arm(robot, seed, reality), np.random.default_rng([order, 7])
    rows, start = list[tuple[Array, Array, Array]](), arm.sense().muscles.length
    while len(rows) * PERIOD < seconds:
        posture = robot.random_postures(1, rng)
        pull = rng.uniform(*TENSIONS, (1, robot.muscle_count))
        goal = robot.muscle_lengths(posture, pull)[0]
        for step in range(1, round((motion + rest) / PERIOD) + 1):
            share = min(1.0, step * PERIOD / motion)
            if rest:  # the motion begins and ends slowly
                share *= share * (3.0 - 2.0 * share)
            arm.command_length(start + (goal - start) * share)
            arm.step(PERIOD)
            now = arm.sense()
            rows.append((now.theta.copy(), now.muscles.length, now.muscles.tension))
        start = goal
    theta, length, tension = (np.array(part, float) for part in zip(*rows, strict=True))
    unknown = np.full(length.shape, -1)
    return Pairs(PERIOD * np.arange(len(rows), dtype=float), theta, length, tension, unknown)


def measure(robot: Robot, mae: Mae, reality: str, seed: int, seconds: float) -> list[str]:
    """Return the errors of one individual after learning, as lines of text.

    `reality` and `seed` name the individual. Each recording takes `seconds` [s].
    """
    held_out = record(robot, reality, seed, 60.0, 1.0, 1.0, order=9)
    before = robot.units.error_text(errors(mae, held_out))
    lines = [f'{reality} {seed}: initial network {before}']
    for name, motion, rest in (('without a rest', 2.0, 0.0), ('with rests', 1.0, 1.0)):
        recording = record(robot, reality, seed, seconds, motion, rest, order=0)
        learner = Learner(robot, mae, from_motion=not rest)
        stop = learn(learner, recording)
        after = robot.units.error_text(errors(learner.mae, held_out))
        count = f'{len(learner.samples)} samples'
        lines.append(f'{reality} {seed}: {name} {after} ({count}) {stop}')
    return lines


def main(argv: list[str]) -> int:
    """Record each individual, learn from the recordings, and print the errors."""
    parser = Parser('moving', 'Learns emulated recordings with and without rests.')
    parser.add_robot(default='arm26')
    parser.add_reality()
    parser.add_seeds((0, 1))
    parser.add_argument('--seconds', type=float, default=150.0, help='duration of a recording [s]')
    parser.add_workers()
    args = parser.parse_args(argv)
    robot = Robot.load(args.robot)
    mae = initial_mae(robot)
    calls = [(robot, mae, args.reality, seed, args.seconds) for seed in args.seeds]
    with workers(args.jobs, args.scheduler) as processes:
        for lines in processes.in_order(measure, calls):
            print(*lines, sep='\n', flush=True)
    return 0
