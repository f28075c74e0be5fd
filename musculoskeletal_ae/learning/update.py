# SPDX-License-Identifier: Apache-2.0
"""What every way of learning online is asked, and what it answers."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.learning.body_fit import Observations
from musculoskeletal_ae.learning.healthy import recalibrate
from musculoskeletal_ae.mae.mae import Mae

Array = NDArray[np.float64]

#: between how the network was made and what it learned since, in `Mae.training`
LEARNED = '; learned online: '


class Job(NamedTuple):
    """What an update may use.

    Attributes:
        seen: The samples, the oldest first.
        messages: Healthy messages (T, l), shape (N, 2M).
        healthy_time: Time that they were drawn from [s].
        statistics_hold: Whether the statistics so far are of the arm as it is now; not after a
            muscle was changed.
        steps: Steps of training.
        version: Of the network that comes out.
    """

    seen: Observations
    messages: NDArray[np.float32]
    healthy_time: float
    statistics_hold: bool
    steps: int
    version: int


class Update(NamedTuple):
    """What came of it.

    Attributes:
        mae: The network.
        loss: Of the training.
        error: Mean ‖θ_est − θ‖₂ over the newest samples, before they were learned [rad].
        noise: Standard deviation of each length that the body does not explain [m], (M,); empty
            where no body is fitted.
        changed: Muscles whose newest samples contradict all older ones, with how many do.
    """

    mae: Mae
    loss: float
    error: float
    noise: Array
    changed: tuple[tuple[int, int], ...] = ()


class Updater(Protocol):
    """A way of learning online; keeps its network and optimiser from update to update."""

    #: samples from which on it learns
    least_samples: int

    def update(self, job: Job) -> Update:
        """Learn a little."""


def with_statistics(mae: Mae, before: Mae, job: Job) -> Mae:
    """Return a network with the anomaly statistics that a job allows."""
    known = before.anomaly
    if known is not None and not job.statistics_hold:
        known = replace(known, calibrated=False)
    samples = len(job.seen)
    found = recalibrate(mae, known, job.messages, job.healthy_time, samples)
    return replace(mae, anomaly=found)


NEWEST = 20  # samples that tell how good the estimates are


def newest_error(mae: Mae, seen: Observations) -> float:
    """Return the mean of ‖θ_est − θ‖₂ over the newest samples [rad]."""
    newest = slice(-NEWEST, None)
    estimate = mae.estimate(seen.tension[newest], seen.length[newest]).theta
    return float(np.linalg.norm(estimate - seen.theta[newest], axis=1).mean())


def history(mae: Mae, samples: int, preset: str) -> str:
    """Return how a network was made and what it learned since."""
    return f'{mae.training.split(LEARNED)[0]}{LEARNED}{samples} samples at rest, preset {preset}'
