# SPDX-License-Identifier: Apache-2.0
"""A learner's run: samples and network on disk, and the training process beside it.

Nothing here waits for training. The caller gives samples as they are accepted and looks in now and
then; what has been learned is handed to `publish` as checkpoint bytes, on disk before it leaves.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from musculoskeletal_ae.exceptions import StateError
from musculoskeletal_ae.learning.answer_values import answer_values
from musculoskeletal_ae.learning.collector import Collector
from musculoskeletal_ae.learning.handout import LEAST_INTERVAL, Handout
from musculoskeletal_ae.learning.journal import Journal
from musculoskeletal_ae.learning.sample import Sample
from musculoskeletal_ae.learning.supervisor import Supervisor
from musculoskeletal_ae.learning.update import Job
from musculoskeletal_ae.learning.worker_process import Answer, Start
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.presets import preset_named
from musculoskeletal_ae.robot.robot import Robot

#: updates that a new sample is worth: its own, and one more of training
AFTER_NEWEST = 2


class Session:
    """Keeps the state of one learner.

    Attributes:
        data: The newest checkpoint as bytes; None without.
        saved: The state found on disk that fits the robot, or None.
    """

    def __init__(
        self,
        robot: Robot,
        collector: Collector,
        preset: str,
        seed: int,
        steps: int,
        directory: Path | None,
        publish: Callable[[bytes], None],
    ) -> None:
        """Take up the saved state, if there is one that fits.

        Args:
            robot: The robot.
            collector: Where samples come from and are kept.
            preset: How to learn.
            seed: Of everything random.
            steps: Of training per update.
            directory: Where the state is kept; None for nowhere.
            publish: Called with each new checkpoint.

        Raises:
            MusculoskeletalError: If the preset is unknown or the directory cannot be used.
        """
        self._robot, self._collector = robot, collector
        self._handout = Handout(publish)
        self._preset, self._seed, self._steps = preset_named(preset), seed, steps
        self.data: bytes | None = None
        self.saved: Mae | None = None
        self._version = 0
        self._answer: Answer | None = None
        self._training = Supervisor(self._begin_with)
        self._due = AFTER_NEWEST
        self._last_start = -LEAST_INTERVAL
        self._statistics_hold = True
        self._journal = None if directory is None else Journal(directory, robot)
        if self._journal is not None:
            self.saved = self._journal.load(collector.store)
        if self.saved is not None:
            self._use(self.saved)

    # -- state ----------------------------------------------------------------------------------

    def _use(self, mae: Mae) -> None:
        """Go on from a network, and hand it out at once."""
        self.data, self._version = checkpoint.to_bytes(mae), mae.version
        # Where they do not, the checkpoint says that the detector is not calibrated.
        self._statistics_hold = True
        self._training.start()
        self._handout.give(self.data)

    def _begin_with(self) -> Start:
        # A new process knows the network but not the body, and nothing of a job that was lost.
        assert self.data is not None
        self._due = AFTER_NEWEST
        return Start(
            self._robot.description.directory,
            self.data,
            self._preset.name,
            self._seed,
            None if self._journal is None else self._journal.network.path,
        )

    def replace(self, path: str | Path) -> None:
        """Start anew from a checkpoint file; the state so far is kept as a backup.

        Raises:
            MusculoskeletalError: If the file does not fit; nothing is changed then.
            OSError: If the disk is full or gone; nothing is changed then.
        """
        mae = self._numbered(checkpoint.load(path, self._robot))
        self._drop_state(mae)
        self._use(mae)

    def begin(self, path: str | Path) -> None:
        """Start from a checkpoint file where no network was saved.

        Raises:
            MusculoskeletalError: If the file does not fit.
        """
        mae = self._numbered(checkpoint.load(path, self._robot))
        if self._journal is not None:
            self._journal.network.keep(mae)
        self._use(mae)

    def _numbered(self, mae: Mae) -> Mae:
        return replace(mae, version=max(mae.version, self._version) + 1)

    def set_aside(self) -> None:
        """Forget samples and network; on disk they become a backup.

        Raises:
            OSError: If the disk is full or gone; nothing is changed then.
        """
        self._drop_state(None)

    def _drop_state(self, successor: Mae | None) -> None:
        # Ended first: what it is learning would be saved over the successor.
        self._training.stop()
        if self._journal is not None:
            try:
                self._journal.replace(successor)
            except OSError:
                self._training_again()
                raise
        self._collector.clear()
        self.data, self.saved = None, None
        self._handout.drop()

    def _training_again(self) -> None:
        if self.data is not None:
            self._training.start()

    def accept(self, sample: Sample) -> None:
        """Keep a sample that the collector has just accepted, and learn it soon."""
        self._due = AFTER_NEWEST
        if self._journal is not None:
            self._journal.log.append(sample, self._collector.store)

    def relearn(self, muscle: int, newest: int = 0) -> None:
        """Learn a muscle's constants anew from its newest samples and what comes.

        The detector is uncalibrated until enough of the changed arm has been seen.

        Raises:
            OSError: If the disk is full or gone; nothing is changed then.
        """
        busy = self._training.busy
        if busy:
            # A job begun before would bring the detector of the arm as it was back.
            self._training.stop()
        try:
            self._doubt_detector(busy)
        finally:
            if busy:
                self._training_again()
        self._collector.relearn(muscle, newest)
        if self._journal is not None:
            self._journal.log.forget(muscle, newest, self._collector.store)
        self._due = AFTER_NEWEST
        self._statistics_hold = False

    def _doubt_detector(self, outdated: bool) -> None:
        """Take back that the detector is calibrated; on disk it may be `outdated` either way."""
        if self.data is None:
            return
        mae = checkpoint.from_bytes(self.data, self._robot)
        calibrated = mae.anomaly is not None and mae.anomaly.calibrated
        if not calibrated and not outdated:
            return
        if mae.anomaly is not None:
            mae = replace(mae, anomaly=replace(mae.anomaly, calibrated=False))
        mae = replace(mae, version=self._version + 1)
        if self._journal is not None:
            self._journal.network.save(mae)
        self._version, self.data = mae.version, checkpoint.to_bytes(mae)
        self._handout.give(self.data)

    def save(self) -> Path:
        """Write everything; returns where.

        Raises:
            StateError: If nothing is to be kept.
            OSError: If the disk is full or gone.
        """
        if self._journal is None:
            raise StateError("state_directory is '': nothing is kept; start with a directory")
        self._journal.log.rewrite(self._collector.store)
        if self._journal.network.trouble and self.data is not None:
            self._journal.network.save(checkpoint.from_bytes(self.data, self._robot))
        return self._journal.directory

    def _heal(self) -> None:
        """Write what could not be written before, if that is possible now."""
        if self._journal is None:
            return
        self._journal.log.heal(self._collector.store)
        # While it trains, the training process may be about to save a newer one.
        if self.data is not None and not self._training.busy:
            self._journal.network.heal(self.data)

    # -- training -------------------------------------------------------------------------------

    def poll(self, learning: bool) -> None:
        """Look whether an update is done, and begin the next one if `learning`."""
        answer = self._training.poll()
        if answer is not None:
            self._finish(answer)
        self._heal()
        self._handout.poll()
        now = time.monotonic()
        due = learning and self._due > 0 and now - self._last_start >= LEAST_INTERVAL
        if due and self._training.can_take(len(self._collector.store)):
            self._begin(now)

    def _begin(self, now: float) -> None:
        # Going on without new samples is the corrected body's way, not the paper's.
        self._due = self._due - 1 if self._preset.corrected_body else 0
        self._last_start = now
        self._version += 1
        collector = self._collector
        self._training.submit(
            Job(
                collector.store.observations(),
                collector.healthy(),
                self._statistics_hold,
                self._steps,
                self._version,
            )
        )

    def _finish(self, answer: Answer) -> None:
        self._answer = answer
        if self._journal is not None:
            self._journal.network.outcome(answer.unsaved)
        self._statistics_hold |= answer.calibrated
        self.data = answer.checkpoint
        self._handout.give(answer.checkpoint)
        for muscle, newest in answer.changed:
            # With a full disk the next update finds the same change again.
            with suppress(OSError):
                self.relearn(muscle, newest)

    def close(self) -> None:
        """End the training process and give the directory free."""
        self._training.stop()
        if self._journal is not None:
            self._journal.close()

    @property
    def trouble(self) -> str:
        """What is wrong, or ''."""
        disk = '' if self._journal is None else self._journal.trouble
        return '; '.join(filter(None, (self._training.trouble, disk)))

    def values(self) -> dict[str, str]:
        """Return what people want to know, for /diagnostics."""
        values = {
            'samples': str(len(self._collector.store)),
            'accepted': str(self._collector.store.accepted),
            'checkpoints': str(self._handout.count),
            'checkpoint version': str(self._version),
            'preset': self._preset.name,
            'healthy time': f'{self._collector.reservoir.time:.0f} s',
            'training process restarts': str(self._training.restarts),
        }
        if self._journal is not None:
            values['state directory'] = str(self._journal.directory)
            if self._journal.not_used:
                values['saved state not used'] = self._journal.not_used
        if self._training.pid is not None:
            values['training process'] = str(self._training.pid)
        if self._answer is not None:
            values |= answer_values(self._answer, self._robot)
        return values
