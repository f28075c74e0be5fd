# SPDX-License-Identifier: Apache-2.0
"""Tests the estimated covariance over many individuals, with and without joint sensors.

python -m bench covariance [--robot …] [--seeds 20,…,29] [--realities kin,foreign] [--minutes 5]

Each individual explores, driven by the network of the geometric model. At the end one network
learns from the rest samples and messages with the readings of the joint sensors, and one without
them, in a few long updates. The bench prints the error [rad] of both on a held-out minute of
motion, and the share of messages whose true angles lie in the 95 % confidence ellipsoid. Most of an
individual's error is one constant offset, so nearly all of its motion lies inside or outside. Only
the mean over individuals is meaningful.
"""

from collections import defaultdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from bench.learned_arm import initial
from musculoskeletal_ae.emulator.reality import FOREIGN, KIN, make_arm
from musculoskeletal_ae.experiments.online_learning import JointView, teach
from musculoskeletal_ae.experiments.recording import (
    EXPLORATION_STREAM,
    HELD_OUT_STREAM,
    Recording,
    estimation_error,
    record,
)
from musculoskeletal_ae.experiments.sensors import ellipsoid_share
from musculoskeletal_ae.learning.collector import NONE, SENSOR
from musculoskeletal_ae.learning.job import Job
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.trainer import Trainer
from musculoskeletal_ae.learning.update import BodyUpdater
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser, names
from musculoskeletal_ae.robot.robot import Robot

HELD_OUT = 60.0  # duration of the held-out motion [s]
STEPS = 400, 1200  # number of training steps of each update
#: function that returns the joint angles which the learner receives, by its source of θ
VIEWS: dict[str, JointView] = {
    SENSOR: lambda _learner, _n, _true, read: read,
    NONE: lambda *_: None,
}


class Never(Trainer):
    """A trainer that never updates."""

    ready = False


def learned(robot: Robot, driver: Mae, exploring: Recording, seed: int, source: str) -> Mae:
    """Return the network that learns from the exploration `exploring`, with one source of θ."""
    learner = Learner(robot, driver, seed=seed, trainer=Never, joint_source=source)
    teach(learner, zip(*exploring, strict=True), VIEWS[source])
    observed, healthy = learner.samples.observations(), learner.collector.healthy.healthy()
    updater, mae = BodyUpdater(robot, driver, seed), driver
    for steps in STEPS:
        mae = updater.update(Job(observed, healthy, True, steps)).mae
    return mae


def main(argv: list[str]) -> None:
    """Print a line for each individual, and the means."""
    parser = Parser('covariance', (__doc__ or '').partition('\n')[0])
    parser.add_robot()
    parser.add_seeds(tuple(range(20, 30)))
    parser.add_minutes('duration of the exploration', 5.0)
    parser.add_argument(
        '--realities', type=names, default=(KIN, FOREIGN), help='emulator models or MJCF files'
    )
    parser.add_argument(
        '--folder', type=Path, help='folder that keeps the initial network for the next run'
    )
    args = parser.parse_args(argv)
    torch.set_num_threads(1)

    robot = Robot.load(args.robot)
    rows = defaultdict[tuple[str, str], list[tuple[float, float]]](list)
    with TemporaryDirectory() as scratch:
        folder = args.folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        driver = initial(robot, folder)
    print(
        'estimation error [rad], and share of errors inside the 95 % ellipsoid, with and without '
        'joint sensors'
    )
    for reality in args.realities:
        for seed in args.seeds:
            arm = make_arm(robot, seed, reality)
            exploring = record(arm, driver, EXPLORATION_STREAM + seed, 60.0 * args.minutes)
            held_out = record(arm, driver, HELD_OUT_STREAM, HELD_OUT)
            texts = []
            for source in VIEWS:
                mae = learned(robot, driver, exploring, seed, source)
                row = estimation_error(mae, held_out), ellipsoid_share(mae, held_out)
                rows[reality, source].append(row)
                texts.append('{:.3f} rad, {:.3f} inside'.format(*row))
            print(f'{reality} {seed}: {"; ".join(texts)}', flush=True)
        means = (np.mean(rows[reality, source], axis=0) for source in VIEWS)
        texts = ['{:.3f} rad, {:.3f} inside'.format(*mean) for mean in means]
        print(f'{reality}, mean: {"; ".join(texts)} (goal: 0.93 to 0.97)', flush=True)
