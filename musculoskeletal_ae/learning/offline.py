# SPDX-License-Identifier: Apache-2.0
"""The learner's procedure on recordings, faster than real time."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.bags.streams import Pairs
from musculoskeletal_ae.estimation.anomaly import AnomalyDetector
from musculoskeletal_ae.learning.online import OnlineLearner
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

# Between two recordings, and over a hole in one, the arm may have gone anywhere.
HOLE = 0.5  # [s]


class Outcome(NamedTuple):
    """What learning brought on one recording.

    Attributes:
        before: Mean ‖θ_est − θ‖₂ against the joint sensors before learning [rad].
        after: The same after learning.
    """

    before: float
    after: float


def learn(
    robot: Robot,
    learner: OnlineLearner,
    recording: Pairs,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Feed a recording to a learner, message by message, as if the arm were moving now.

    Args:
        robot: Whose arm was recorded.
        learner: Is taught.
        recording: θ, T, l in the order of time.
        progress: Told the recorded seconds that have passed since it was last told.
    """
    detector = AnomalyDetector(robot)
    detector.use(learner.mae)
    learner.collector.reset()
    learner.collector.set_anomaly(False)
    before = recording.time[0] if len(recording.time) else 0.0
    for time, theta, length, tension in zip(*recording, strict=True):
        dt = time - before
        before = time
        if dt > HOLE:
            learner.collector.reset()
        # The estimator gates live learning; here its detector does the same.
        verdict = detector.step(learner.mae.estimate(tension, length), tension, length, dt)
        if verdict.cause:
            learner.collector.set_anomaly(True)
        if learner.step(tension, length, min(dt, HOLE), theta) is not None:
            detector.use(learner.mae)
        if progress is not None:
            progress(dt)


def error(mae: Mae, recording: Pairs) -> float:
    """Return the mean over all messages of ‖θ_est − θ‖₂ against the joint sensors [rad]."""
    estimate = mae.estimate(recording.tension, recording.length).theta
    return float(np.linalg.norm(estimate - recording.theta, axis=1).mean())
