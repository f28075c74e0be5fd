# SPDX-License-Identifier: Apache-2.0
"""When an update of the network begins, and on what.

An update begins when there is something new to learn from, there are enough samples, and the last
one began at least `LEAST_INTERVAL` ago. Times are of the caller's clock, which may jump backward.
"""

import math

from musculoskeletal_ae.learning.calibration import Reservoir, is_calibrated, uncalibrated
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.learning.trainer import Job, Update
from musculoskeletal_ae.mae.mae import Mae

#: between the beginnings of two updates, and between two checkpoints [s]
LEAST_INTERVAL = 1.0
LEAST_BLIND = 20  # samples to begin with where no θ is known


class UpdateScheduler:
    """Decides when to train, and composes the job.

    Attributes:
        least_samples: With how many the first one begins.
        updates: How many updates were made.
        last_update: The last of them, if any.
        statistics_hold: Whether the statistics of the detector are of the arm as it is. They are
            not after a muscle has changed, until the detector has been calibrated anew.
    """

    def __init__(self, least_samples: int, steps: int) -> None:
        """Begin with at least so many samples; train so many steps in each update."""
        self.updates = 0
        self.last_update: Update | None = None
        self.statistics_hold = True
        self.least_samples, self._steps = least_samples, steps
        self._has_news = True
        self._began_at = -math.inf  # the last update [s]
        self._has_changed = False  # a muscle, since the last update began
        self._updates_to_repeat = 0

    def restart(self, updates_to_repeat: int = 0) -> None:
        """Begin anew. Samples without their network bring as many updates as when they came."""
        self._updates_to_repeat, self.last_update = updates_to_repeat, None

    def note_news(self) -> None:
        """Note that there is something new to learn from."""
        self._has_news = True

    def note_change(self) -> None:
        """Note that a muscle is learned anew: statistics of the arm before say nothing."""
        self.statistics_hold = False
        self._has_changed = self._has_news = True

    def is_due(self, now: float, sample_count: int) -> bool:
        """Whether an update is to begin at `now` [s]."""
        enough = sample_count >= self.least_samples
        return self._has_news and enough and not is_recent(self._began_at, now)

    def begin(
        self, now: float, samples: SampleStore, healthy: Reservoir, isolated: tuple[int, ...]
    ) -> Job:
        """Return the job of an update that begins at `now` [s]."""
        self._has_news = self.updates + 1 < self._updates_to_repeat
        self._began_at, self._has_changed = now, False
        return Job(
            samples.observations(), healthy.healthy(), self.statistics_hold, self._steps, isolated
        )

    def finish(self, update: Update) -> Mae:
        """Count an update; return its network, uncalibrated if a muscle changed meanwhile."""
        self.last_update = update
        self.updates += 1
        mae = uncalibrated(update.mae) if self._has_changed or update.changed else update.mae
        self.statistics_hold |= is_calibrated(mae)
        return mae


def is_recent(then: float, now: float) -> bool:
    """Whether `then` is less than `LEAST_INTERVAL` ago; not if the clock went back since."""
    return 0.0 <= now - then < LEAST_INTERVAL
