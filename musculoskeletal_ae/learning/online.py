# SPDX-License-Identifier: Apache-2.0
"""Online learning in one object: messages in, now and then a better network out.

    messages → Collector → samples → Updater → network

The node runs the two halves in two processes, so that no update ever delays a message; experiments
run them in one, by `OnlineLearner.step`.
"""

from __future__ import annotations

from dataclasses import replace

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.body_updater import BodyUpdater
from musculoskeletal_ae.learning.collector import Collector
from musculoskeletal_ae.learning.paper_updater import PaperUpdater
from musculoskeletal_ae.learning.update import Job, Update, Updater
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.presets import preset_named
from musculoskeletal_ae.robot.robot import Robot

STEPS = 100  # of training in one update of preset default


def make_updater(robot: Robot, mae: Mae, preset: str, seed: int = 0) -> Updater:
    """Return the way of learning that a preset names.

    Raises:
        MusculoskeletalError: If it names none.
    """
    kind = BodyUpdater if preset_named(preset).corrected_body else PaperUpdater
    return kind(robot, mae, seed)


class OnlineLearner:
    """Collector and updater in one process.

    Attributes:
        collector: Holds the samples.
        mae: The network as learned so far.
        updates: How many updates there were.
        updater: The way of learning.
    """

    def __init__(
        self, robot: Robot, mae: Mae, preset: str = 'default', seed: int = 0, steps: int = STEPS
    ) -> None:
        """Start from a network.

        Args:
            robot: The geometric model.
            mae: Fits the robot.
            preset: 'default' or 'paper'.
            seed: Of everything random.
            steps: Of training per update, in preset default.
        """
        self.collector = Collector(robot, seed=seed)
        self.mae = mae
        self.updates = 0
        self.last: Update | None = None
        self.updater = make_updater(robot, mae, preset, seed)
        self._steps = steps
        self._statistics_hold = True

    def step(
        self, tension: Array, length: Array, dt: float, theta: Array | None = None
    ) -> Update | None:
        """Take one message; learn if it completed a sample. Arguments as `Collector.step`."""
        if self.collector.step(tension, length, dt, theta) is None:
            return None
        return self.update()

    def update(self) -> Update | None:
        """Learn a little from the samples so far, if there are enough."""
        collector = self.collector
        if len(collector.store) < self.updater.least_samples:
            return None
        job = Job(
            collector.store.observations(),
            collector.healthy(),
            self._statistics_hold,
            self._steps,
            self.mae.version + 1,
        )
        update = self.last = self.updater.update(job)
        self.mae, self.updates = update.mae, self.updates + 1
        anomaly = update.mae.anomaly
        self._statistics_hold |= anomaly is not None and anomaly.calibrated
        for muscle, newest in update.changed:
            self.relearn(muscle, newest)
        return update

    def relearn(self, muscle: int, newest: int = 0) -> None:
        """Learn a muscle's constants anew from what comes and the `newest` samples stored."""
        self.collector.relearn(muscle, newest)
        self._statistics_hold = False
        anomaly = self.mae.anomaly
        if anomaly is not None:
            self.mae = replace(self.mae, anomaly=replace(anomaly, calibrated=False))
