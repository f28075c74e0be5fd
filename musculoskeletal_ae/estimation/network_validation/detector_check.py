# SPDX-License-Identifier: Apache-2.0
"""Checks the calibrated anomaly detector of a candidate network, or replaces a missing one.

A calibrated detector must stay below its threshold on the recent messages, and must respond to a
ruptured muscle. The ratio of the residual distance d to its threshold, as the median over the
messages, measures both. A candidate without a calibrated detector inherits the detector in use.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.detectors.residual_distance import DISTANCE
from musculoskeletal_ae.estimation.network_validation.recent_messages import LEAST, RecentMessages
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import AnomalyStatistics, residuals

#: reject a network if no imitated rupture raises d to at least this share of its threshold
LEAST_RUPTURED = 0.1
#: raise the threshold of an inherited detector to at least this multiple of the largest residual
#: distance d in recent messages, so that the candidate reports nothing on a healthy arm
WIDENED = 3.5


def measures(mae: Mae, messages: RecentMessages, isolated: Iterable[int]) -> Iterator[float]:
    """Yield measures of a detector: ratios of the residual distance d to its threshold.

    Each ratio is the median over the recent messages.

    The first ratio is that of the messages as they are. Each following ratio is that of the same
    messages with one muscle ruptured, which is imitated by setting its tension to 0.

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
    # Use only LEAST messages for each imitated rupture; more messages would not change the result.
    rows = np.linspace(0, len(length) - 1, LEAST).astype(int)
    is_intact = 1.0 - np.eye(tension.shape[1])
    for factors in np.delete(is_intact, tuple(isolated), axis=0):
        yield measure(tension[rows] * factors, length[rows])


def faults(mae: Mae, messages: RecentMessages, isolated: Iterable[int]) -> Iterator[str | None]:
    """Yield a text for each fault of a candidate's detector, and None after each piece of work."""
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
            f'required: at least {LEAST_RUPTURED:g}'
        )


def with_detector_of(
    statistics: AnomalyStatistics, mae: Mae, messages: RecentMessages, isolated: tuple[int, ...]
) -> Mae:
    """Return a network with the detector of the network that it replaces.

    The threshold is raised, if necessary, to 3.5 times (WIDENED) the highest residual distance of
    the new network on the recent messages.

    Args:
        statistics: The calibrated detector of the network in use.
        mae: The new network.
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
