# SPDX-License-Identifier: Apache-2.0
"""Tests the estimated covariance of arms without joint sensors, over many individuals.

python -m bench covariance [--robot …] [--seeds 20,…,31] [--minutes 10] [--folder DIR]

Each individual explores, driven by the network of the geometric model. At the end the network
learns from its rest samples without joint angles, in a few long updates. The bench prints the error
[rad] on a held-out minute of motion, and the share of messages whose true angles lie in the 95 %
confidence ellipsoid. Most of an individual's error is one constant offset, so nearly all of its
motion lies inside or outside. Only the mean over individuals is meaningful.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from bench.learned_arm import initial
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.experiments.online_learning import teach
from musculoskeletal_ae.experiments.recording import (
    EXPLORATION_STREAM,
    HELD_OUT_STREAM,
    estimation_error,
    record,
)
from musculoskeletal_ae.experiments.sensors import ellipsoid_share
from musculoskeletal_ae.learning.calibration import Healthy
from musculoskeletal_ae.learning.collector import NONE
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.trainer import Job, Trainer
from musculoskeletal_ae.learning.update import BodyUpdater
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

HELD_OUT = 60.0  # [s]
UPDATES, STEPS = 3, 1500


class Never(Trainer):
    """A trainer that never updates."""

    ready = False


def learned(robot: Robot, driver: Mae, arm: EmulatedArm, seed: int, minutes: float) -> Mae:
    """Return the network learned from an individual's rest samples without joint angles."""
    learner = Learner(robot, driver, seed=seed, trainer=Never, joint_source=NONE)
    exploring = record(arm, driver, EXPLORATION_STREAM + seed, 60.0 * minutes)
    teach(learner, zip(*exploring, strict=True), lambda *_: None)
    nothing = Healthy(np.empty((0, 3 * robot.muscle_count), np.float32), 0.0, 0)
    job, mae = Job(learner.samples.observations(), nothing, True, STEPS), driver
    updater = BodyUpdater(robot, driver, seed)
    for _ in range(UPDATES):
        mae = updater.update(job).mae
    return mae


def main(argv: list[str]) -> None:
    """Print a line for each individual, and the means."""
    parser = Parser('covariance', 'Tests the estimated covariance of arms without joint sensors.')
    parser.add_robot()
    parser.add_seeds(tuple(range(20, 32)))
    parser.add_minutes('duration of the exploration', 10.0)
    parser.add_argument(
        '--folder', type=Path, help='folder that keeps the initial network for the next run'
    )
    args = parser.parse_args(argv)
    torch.set_num_threads(1)

    robot, rows = Robot.load(args.robot), list[tuple[float, float]]()
    with TemporaryDirectory() as scratch:
        folder = args.folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        driver = initial(robot, folder)
    for seed in args.seeds:
        arm = EmulatedArm(robot, seed)
        mae = learned(robot, driver, arm, seed, args.minutes)
        held_out = record(arm, driver, HELD_OUT_STREAM, HELD_OUT)
        rows.append((estimation_error(mae, held_out), ellipsoid_share(mae, held_out)))
        print(f'individual {seed}: {rows[-1][0]:.3f} rad, {rows[-1][1]:.3f} inside', flush=True)
    error, inside = np.mean(rows, axis=0)
    print(f'mean of {len(rows)}: {error:.3f} rad, {inside:.3f} inside (goal: 0.93 to 0.97)')
