# SPDX-License-Identifier: Apache-2.0
"""What every way of learning online is asked, and what it answers."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.body_fit import Observations
from musculoskeletal_ae.learning.healthy import Healthy, recalibrate
from musculoskeletal_ae.mae.mae import Mae

#: between how the network was made and what it learned since, in `Mae.training`
LEARNED = '; learned online: '


class Job(NamedTuple):
    """What an update may use.

    Attributes:
        seen: The samples, the oldest first.
        healthy: What was seen of the healthy arm.
        statistics_hold: Whether the statistics so far are of the arm as it is now; not after a
            muscle was changed.
        steps: Steps of training.
        version: Of the network that comes out.
    """

    seen: Observations
    healthy: Healthy
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
        changed: The muscle, if any, whose newest samples contradict all older ones, with how many.
        doubtful: Muscles that newest samples contradict together: θ is wrong there, not they.
    """

    mae: Mae
    loss: float
    error: float
    noise: Array
    changed: tuple[tuple[int, int], ...] = ()
    doubtful: tuple[int, ...] = ()


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
    found = recalibrate(mae, known, job.healthy, samples)
    return replace(mae, anomaly=found)


NEWEST = 20  # samples that tell how good the estimates are


def newest_error(mae: Mae, seen: Observations) -> float:
    """Return the mean of ‖θ_est − θ‖₂ over the newest samples [rad]."""
    newest = slice(-NEWEST, None)
    estimate = mae.estimate(seen.tension[newest], seen.length[newest]).theta
    return float(np.linalg.norm(estimate - seen.theta[newest], axis=1).mean())


def history(mae: Mae, samples: int, preset: str, steps: int) -> str:
    """Return how a network was made and what it learned since; `learned_steps` reads it."""
    origin = mae.training.split(LEARNED)[0]
    return f'{origin}{LEARNED}{samples} samples at rest, preset {preset}, {steps} steps'


def learned_steps(mae: Mae) -> int:
    """Return how many steps of preset `default` a network has learned on a real arm, or 0."""
    found = re.search(f'{LEARNED}.*, preset default, (\\d+) steps$', mae.training)
    return int(found[1]) if found else 0
