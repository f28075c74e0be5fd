# SPDX-License-Identifier: Apache-2.0
"""Checks the calibrated detector of a candidate network, or gives it the detector in use.

A calibrated detector must stay below its threshold on the recent messages, and must respond to
a ruptured muscle. The measure is the median over the messages of d divided by its threshold.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.detectors.residual_distance import DISTANCE
from musculoskeletal_ae.estimation.validation.recent_messages import LEAST, RecentMessages
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import AnomalyStatistics, residuals

#: smallest permitted measure with a ruptured muscle; the muscle with the largest measure counts
LEAST_RUPTURED = 0.1
WIDENED = 3.5  # smallest ratio of an inherited threshold to the highest d of the messages


def measures(mae: Mae, messages: RecentMessages, isolated: Iterable[int]) -> Iterator[float]:
    """Yield the measure of the messages, and then of the messages with each muscle ruptured.

    A rupture is imitated by setting the tension of the muscle to 0.

    Nothing is yielded for a network without a calibrated detector, or with too few messages.
    """
    statistics = mae.anomaly
    if statistics is None or not statistics.calibrated or not messages.are_enough:
        return
    threshold = statistics.thresholds.get(DISTANCE, np.inf)
    tension, length = messages.readings(mae)

    def measure(tension: Array, length: Array) -> float:
        state = mae.estimate(tension, length)
        error = residuals(state, tension, length, mae.isolated)
        return float(np.median(statistics.distances(error) / threshold))

    yield measure(tension, length)
    # For each ruptured muscle, LEAST messages suffice.
    rows = np.linspace(0, len(length) - 1, LEAST).astype(int)
    is_intact = 1.0 - np.eye(tension.shape[1])
    for factors in np.delete(is_intact, tuple(isolated), axis=0):
        yield measure(tension[rows] * factors, length[rows])


def faults(mae: Mae, messages: RecentMessages, isolated: Iterable[int]) -> Iterator[str | None]:
    """Yield each fault of a candidate's detector, or None after each piece of work."""
    values = list[float]()
    for value in measures(mae, messages, isolated):
        values.append(value)
        yield None
    if not values:
        return
    healthy, ruptured = values[0], max(values[1:], default=np.inf)
    if healthy > 1.0:
        yield f'detector: d is {healthy:.2g} times its threshold on recent messages, limit 1'
    if ruptured < LEAST_RUPTURED:
        yield (
            f'detector: d is {ruptured:.2g} times its threshold with a ruptured muscle, '
            f'required {LEAST_RUPTURED:g}'
        )


def with_detector_of(
    statistics: AnomalyStatistics, mae: Mae, messages: RecentMessages, isolated: tuple[int, ...]
) -> Mae:
    """Return the network that takes over, with the detector of the network in use.

    The threshold is at least WIDENED times the highest d of the recent messages.

    Args:
        statistics: The calibrated detector of the network in use.
        mae: The network that takes over.
        messages: The recent messages.
        isolated: Indices of the isolated muscles.
    """
    if len(messages):
        reduced = mae.without(isolated)
        tension, length = messages.readings(reduced)
        error = residuals(reduced.estimate(tension, length), tension, length, isolated)
        highest = float(statistics.without(isolated).distances(error).max())
        threshold = statistics.thresholds.get(DISTANCE, math.inf)
        raised = {DISTANCE: max(threshold, WIDENED * highest)}
        statistics = replace(statistics, thresholds={**statistics.thresholds, **raised})
    return replace(mae, anomaly=statistics)
