# SPDX-License-Identifier: Apache-2.0
"""Decides when an update of the network begins, and collects the inputs of the update.

An update begins when there are new data and enough samples, and the last update began at least
`LEAST_INTERVAL` ago. The caller supplies all times from its clock, which may jump backward.

`Job` contains the inputs of an update, and `Update` its result. The node exchanges both with its
training process.
"""

import math
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.observations import Observations
from musculoskeletal_ae.learning.detector_calibration import Healthy, Reservoir, uncalibrated
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.mae.mae import Mae

#: train for this many steps in one update of preset `default`; 100 would reduce the error by 3 %
STEPS = 50
#: let at least this time pass between the starts of two updates [s]
LEAST_INTERVAL = 1.0
#: require this many samples for the first update of an arm without joint sensors
LEAST_BLIND = 20


class Job(NamedTuple):
    """A job for the training process: everything that an update of the network needs."""

    observed: Observations  # the samples, oldest first
    healthy: Healthy  # messages of the healthy arm, with which the anomaly detector is calibrated
    #: whether the statistics of the anomaly detector are valid for the present arm; not after a
    #: muscle has been changed
    statistics_hold: bool
    steps: int  # number of training steps of preset `default`
    isolated: tuple[int, ...] = ()  # indices of the muscles that the messages do not describe


class Update(NamedTuple):
    """The result of one update: the trained network, and what the update has found."""

    mae: Mae  # the trained network
    loss: float  # training loss
    #: σ of the part of each length that the body does not explain [m], (M,)
    noise: Array = np.empty(0)
    #: index of a muscle whose newest samples contradict the fitted body, and the number of the
    #: first of these samples (`Observations.number`); at most one entry
    changed: tuple[tuple[int, int], ...] = ()
    #: mean 2-norms of θ_est − θ at the newest samples, over the revolute and over the prismatic
    #: joints (`JointUnits.mean_errors`), with θ_est of the network before the update [rad], (2,)
    errors: Array = np.full(2, np.nan)
    seconds: float = 0.0  # duration of the update [s]
    #: root mean square over the samples of what the constants of the body model cannot express, for
    #: each length [m], (M,); empty if the preset fits no body
    remainder: Array = np.empty(0)
    #: estimated joint-sensor offsets z [rad], (D,); empty if the preset estimates none
    sensor_offset: Array = np.empty(0)
    unchanged: str = ''  # why the network was not trained; '' if it was


class UpdateScheduler:
    """Decides when an update of the network begins.

    Attributes:
        least_samples: Number of samples required for an update.
        updates: Number of finished updates.
        last_update: The last finished update; None before the first.
        statistics_hold: Whether the detector's statistics are valid for the present arm. After a
            muscle has changed, they are invalid until the detector has been calibrated again.
    """

    def __init__(self, least_samples: int) -> None:
        """Schedule updates, which need `least_samples` samples."""
        self.updates = 0
        self.last_update: Update | None = None
        self.statistics_hold = True
        self.least_samples = least_samples
        self._due = 1  # number of updates to begin, even without further news
        self._began_at = -math.inf  # start of the last update [s]
        self._has_changed = False  # whether a muscle has changed since the start of the last update

    def restart(self, updates: int = 1) -> None:
        """Restart after the network has been replaced.

        Args:
            updates: Number of updates that are run even without new samples; at least one is.
        """
        self._due, self.last_update = max(1, updates), None

    def note_news(self) -> None:
        """Note that there are new data to learn from."""
        self._due = max(1, self._due)

    def note_change(self) -> None:
        """Note that a muscle is relearned, which invalidates the detector's statistics."""
        self.statistics_hold = False
        self._has_changed = True
        self.note_news()

    def is_due(self, now: float, sample_count: int) -> bool:
        """Return whether an update is due at `now` [s]."""
        is_recent = 0.0 <= now - self._began_at < LEAST_INTERVAL
        return self._due > 0 and sample_count >= self.least_samples and not is_recent

    def begin(
        self,
        now: float,
        samples: SampleStore,
        healthy: Reservoir,
        isolated: tuple[int, ...],
        steps: int,
    ) -> Job:
        """Begin an update of `steps` training steps at `now` [s]; return its job."""
        self._due -= 1
        self._began_at, self._has_changed = now, False
        observed, statistics_hold = samples.observations(), self.statistics_hold
        return Job(observed, healthy.healthy(), statistics_hold, steps, isolated)

    def finish(self, update: Update) -> Mae:
        """Record that an update has finished, and return its network.

        If a muscle has changed since the update began, the network is marked as uncalibrated.
        """
        self.last_update = update
        self.updates += 1
        mae = uncalibrated(update.mae) if self._has_changed or update.changed else update.mae
        self.statistics_hold |= mae.is_calibrated
        return mae
