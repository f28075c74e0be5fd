# SPDX-License-Identifier: Apache-2.0
"""What the estimator's own detector says of a recording, message by message."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.anomaly import AnomalyDetector
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, Recording
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import residuals
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.robot.robot import Robot


class Watched(NamedTuple):
    """The detector's answers to N messages.

    Attributes:
        theta: Estimated [rad], shape (N, D).
        anomaly: A, scaled units, shape (N,).
        distance: d, in healthy standard deviations, shape (N,).
        suspect: Index of the most suspect muscle, shape (N,).
        alarm: Whether the message completes a detection, shape (N,).
    """

    theta: Array
    anomaly: Array
    distance: Array
    suspect: NDArray[np.int_]
    alarm: NDArray[np.bool_]


def watch(robot: Robot, mae: Mae, recording: Recording) -> Watched:
    """Run estimator and detector over a recording as the node does; nothing is latched."""
    detector = AnomalyDetector(robot)
    detector.use(mae)
    estimated = mae.estimate(recording.tension, recording.length)
    count = len(recording.theta)
    anomaly, distance = np.empty(count), np.empty(count)
    suspect, alarm = np.empty(count, dtype=int), np.empty(count, dtype=bool)
    for n in range(count):
        detector.commanded_length(recording.command[n])
        restored = State(*(part[n] for part in estimated))
        verdict = detector.step(restored, recording.tension[n], recording.length[n], SAMPLE_TIME)
        anomaly[n], distance[n], suspect[n] = verdict.anomaly, verdict.distance, verdict.suspect
        alarm[n] = bool(verdict.cause)
    return Watched(estimated.theta, anomaly, distance, suspect, alarm)


def anomaly(mae: Mae, tension: Array, length: Array) -> Array:
    """Return A of messages (N, M), scaled units, shape (N,)."""
    halves = np.split(residuals(mae.estimate(tension, length), tension, length), 2, axis=1)
    total: Array = sum((np.linalg.norm(half, axis=1) for half in halves), np.zeros(len(tension)))
    return total


def alarms_begun(alarm: NDArray[np.bool_]) -> int:
    """Return how often a detection began: what an operator would have had to reset."""
    return int(np.count_nonzero(alarm[1:] & ~alarm[:-1]) + (len(alarm) > 0 and alarm[0]))


def auroc(healthy: Array, faulty: Array) -> float:
    """Return the chance that a faulty message scores above a healthy one (ties count half)."""
    from scipy.stats import rankdata

    if not len(healthy) or not len(faulty):
        return 0.5
    ranks = rankdata(np.concatenate([healthy, faulty]))
    faulty_ranks = ranks[len(healthy) :].sum() - len(faulty) * (len(faulty) + 1) / 2
    return float(faulty_ranks / (len(healthy) * len(faulty)))
