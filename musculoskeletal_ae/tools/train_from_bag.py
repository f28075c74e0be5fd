# SPDX-License-Identifier: Apache-2.0
"""`train --from-bag`: learn the body from recordings instead of from a moving arm."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from tqdm import tqdm

from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.streams import Pairs, read_streams
from musculoskeletal_ae.estimation.anomaly import AnomalyDetector
from musculoskeletal_ae.exceptions import BagError
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot


def read(path: Path, robot: Robot) -> Pairs:
    """Return the paired messages of a bag, at least one, and say what was left out."""
    bag = Bag.open(path, unfinished=True)
    for reason in bag.unfinished:
        print(f'warning: {path}: unfinished: {reason}', file=sys.stderr)
    streams = read_streams(bag, robot)
    for reason, count in streams.rejected.items():
        print(f'warning: {path}: {count} messages rejected, {reason}', file=sys.stderr)
    pairs = streams.pairs()
    if not len(pairs.time):
        problem = 'holds no joint_states and muscle_states that belong together'
        raise BagError(path, problem, 'record both topics of this robot')
    return pairs


def learn(
    learner: Learner, recording: Pairs, progress: Callable[[float], None] | None = None
) -> None:
    """Feed a recording to a learner, message by message, as if the arm were moving now.

    `progress` is told the recorded seconds that have passed since it was last told.
    """
    detector = AnomalyDetector(learner.robot, preset=learner.training.preset.name)
    mae = learner.mae
    detector.use(mae)
    learner.reset()
    learner.anomaly(False)
    steps = np.diff(recording.time, prepend=recording.time[:1])
    for dt, time, theta, length, tension in zip(steps, *recording, strict=True):
        # The estimator gates live learning; here its detector does the same.
        verdict = detector.step(mae.estimate(tension, length), tension, length, dt)
        if verdict.cause:
            learner.anomaly(True)
        learner.step(time, theta, tension, length)
        if learner.mae is not mae:
            mae = learner.mae
            detector.use(mae)
        if progress is not None:
            progress(dt)


def error(mae: Mae, recording: Pairs) -> float:
    """Return the mean over all messages of ‖θ_est − θ‖₂ against the joint sensors [rad]."""
    estimate = mae.estimate(recording.tension, recording.length).theta
    return float(np.linalg.norm(estimate - recording.theta, axis=1).mean())


def train_from_bags(learner: Learner, recordings: dict[Path, Pairs], held_out: list[Path]) -> None:
    """Learn from recordings in their order, those held out judged only; print errors."""
    before = {path: error(learner.mae, pairs) for path, pairs in recordings.items()}
    for path, pairs in recordings.items():
        if path not in held_out:
            total = round(pairs.time[-1] - pairs.time[0], 1)
            with tqdm(total=total, unit=' s', desc=path.name, disable=None) as bar:
                learn(learner, pairs, bar.update)
    print(f'{len(learner.samples)} samples, {learner.updates} updates')
    for path, pairs in recordings.items():
        kind = 'held out' if path in held_out else 'learned from'
        after = error(learner.mae, pairs)
        print(f'{path} ({kind}): {before[path]:.4f} → {after:.4f} rad against its joint sensors')
