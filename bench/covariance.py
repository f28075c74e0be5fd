# SPDX-License-Identifier: Apache-2.0
"""Tests the estimated covariance over many individuals, with and without joint sensors.

python -m bench covariance [--robot …] [--seeds 20,…,29] [--realities kin,foreign] [--minutes 5]

Each individual explores as in preset `default`; the network of the geometric model computes its
commands. With `--exploration paper` it explores as in preset `paper`, which has no targets at the
limits of the joints. Two networks then learn from this exploration in a few long updates: one with
the readings of the joint sensors, and one without them. On 40 s of held-out motion, the bench
prints for both networks

    rad     the mean error of the estimate
    inside  the share of messages whose true angles lie in the 95 % confidence ellipsoid
    NEES    the mean of eᵀ Σ⁻¹ e / D, with the error e of D joints and the covariance Σ

A last line for each emulator model shows the means over the individuals with their standard errors.
With the right covariance, 0.95 of the messages lie inside and the NEES is 1. A NEES below 1 means
that the covariance is too large.

Without joint sensors, most of an individual's error is one constant offset, so nearly all of its
motion lies inside or outside. Even if the covariance is right, the mean share over ten individuals
therefore has a standard error of up to √(0.95 · 0.05 / 10) = 0.07.
"""

from collections import defaultdict
from typing import NamedTuple

import numpy as np

from bench.learned_arm import Never, add_initial, initial_network
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.covariance import ellipsoids
from musculoskeletal_ae.control.settings import Settings, Setup
from musculoskeletal_ae.emulator.reality import FOREIGN, KIN, make_arm
from musculoskeletal_ae.experiments.online_learning import JointView, teach
from musculoskeletal_ae.experiments.recording import (
    EXPLORATION_STREAM,
    HELD_OUT_STREAM,
    Recording,
    end_tensions,
    record,
)
from musculoskeletal_ae.experiments.workers import workers
from musculoskeletal_ae.learning.body_updater import BodyUpdater
from musculoskeletal_ae.learning.collector import NONE, SENSOR
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.scheduler import Job
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.exploration import Exploration
from musculoskeletal_ae.options import Parser, names, number
from musculoskeletal_ae.presets.registry import PRESETS
from musculoskeletal_ae.robot.robot import Robot

HELD_OUT = 40.0  # test on a held-out motion of this duration [s]
STEPS = 400, 1200  # make one update with each of these numbers of training steps
#: for each source of θ: the function that returns the joint angles for the learner
VIEWS: dict[str, JointView] = {
    SENSOR: lambda _learner, _n, _true, read: read,
    NONE: lambda *_: None,
}


class Honesty(NamedTuple):
    """How well the covariance of a network describes its errors on a recording."""

    error: float  # mean error ‖θ_est − θ‖ [rad]
    inside: float  # share of the errors within the 95 % confidence ellipsoid
    nees: float  # mean of eᵀ Σ⁻¹ e / D (NEES); above 1, the covariance is too small

    def text(self) -> str:
        """Return the mean error, the share inside the ellipsoid and the NEES as text."""
        return f'{self.error:.3f} rad, {self.inside:.3f} in the ellipsoid, NEES {self.nees:.2f}'


def errors(mae: Mae, recording: Recording) -> Array:
    """Return the errors of a network on a recording [rad], (N, D)."""
    estimate: Array = mae.estimate(end_tensions(mae, recording), recording.length).theta
    return estimate - recording.theta


def honesty(covariance: Array, error: Array) -> Honesty:
    """Return how well a covariance [rad²] (D, D) describes the errors [rad] (N, D) of a network."""
    squares = np.einsum('ni,ni->n', error, np.linalg.solve(covariance, error.T).T)
    return Honesty(
        float(np.linalg.norm(error, axis=1).mean()),
        float((ellipsoids(covariance, error) <= 1.0).mean()),
        float(squares.mean()) / error.shape[1],
    )


def learned(robot: Robot, driver: Mae, exploring: Recording, seed: int, source: str) -> Mae:
    """Return the network that has learned from the recorded exploration of an individual.

    Args:
        robot: The geometric model.
        driver: The network to start from, which also commanded the exploration.
        exploring: The recording of the exploration.
        seed: Seed of the learner.
        source: Whether the joint angles come from joint sensors or from nowhere, a key of VIEWS.
    """
    learner = Learner(robot, driver, seed=seed, trainer=Never, joint_source=source)
    teach(learner, zip(*exploring, strict=True), VIEWS[source])
    observed, healthy = learner.samples.observations(), learner.collector.healthy.healthy()
    updater, mae = BodyUpdater(robot, driver, seed), driver
    for steps in STEPS:
        mae = updater.update(Job(observed, healthy, True, steps)).mae
    return mae


def measure(
    robot: Robot,
    driver: Mae,
    reality: str,
    seed: int,
    exploration: str,
    minutes: float,
    scale: float,
) -> dict[str, Honesty]:
    """Let an individual learn; return how well its covariance fits its errors, by source of θ.

    Args:
        robot: The geometric model.
        driver: The network that commands the exploration, and from which learning starts.
        reality: Emulator model of the individual.
        seed: Seed of the individual and of the exploration.
        exploration: Preset that explores.
        minutes: Duration of the exploration [min].
        scale: Factor of each covariance before it is compared with the errors.
    """
    steps = Exploration(Setup(robot, Settings(preset=exploration)), EXPLORATION_STREAM + seed)
    exploring = record(make_arm(robot, seed, reality), driver, steps, 60.0 * minutes)
    held_out = record(make_arm(robot, seed, reality), driver, HELD_OUT_STREAM, HELD_OUT)
    results = {}
    for source in VIEWS:
        mae = learned(robot, driver, exploring, seed, source)
        assert mae.covariance is not None  # preset `default` has one
        results[source] = honesty(scale * mae.covariance, errors(mae, held_out))
    return results


def main(argv: list[str]) -> None:
    """Print a line for each individual, and a line of means for each emulator model."""
    parser = Parser('covariance', (__doc__ or '').partition('\n')[0])
    parser.add_robot()
    parser.add_seeds(tuple(range(20, 30)))
    parser.add_minutes('duration of the exploration', 5.0)
    parser.add_argument(
        '--realities', type=names, default=(KIN, FOREIGN), help='emulator models or MJCF files'
    )
    parser.add_argument(
        '--exploration', choices=PRESETS, default='default', help='preset whose exploration is used'
    )
    parser.add_argument(
        '--scale', type=number(0.01, 100.0), default=1.0, help='multiply each covariance by this'
    )
    add_initial(parser)
    parser.add_workers()
    args = parser.parse_args(argv)

    robot = Robot.load(args.robot)
    rows = defaultdict[tuple[str, str], list[Honesty]](list)
    driver = initial_network(robot, args.initial)
    print('with joint sensors; without joint sensors')
    cases = [(reality, seed) for reality in args.realities for seed in args.seeds]
    with workers(args.jobs, args.scheduler) as processes:
        calls = [
            (robot, driver, *case, args.exploration, args.minutes, args.scale) for case in cases
        ]
        for (reality, seed), results in zip(cases, processes.in_order(measure, calls), strict=True):
            for source, row in results.items():
                rows[reality, source].append(row)
            texts = [row.text() for row in results.values()]
            print(f'{reality} {seed}: {"; ".join(texts)}', flush=True)
    for reality in args.realities:
        texts = [summary(rows[reality, source]) for source in VIEWS]
        goal = 'goal: 0.93 to 0.97 inside, NEES 1'
        print(f'{reality}, mean: {"; ".join(texts)} ({goal})', flush=True)


def summary(rows: list[Honesty]) -> str:
    """Return the means over individuals with their standard errors."""
    mean, spread = np.mean(rows, axis=0), np.zeros(3)
    if len(rows) > 1:
        spread = np.std(rows, axis=0, ddof=1) / np.sqrt(len(rows))
    return (
        f'{mean[0]:.3f} rad, {mean[1]:.3f} ± {spread[1]:.3f} inside, '
        f'NEES {mean[2]:.2f} ± {spread[2]:.2f}'
    )
