# SPDX-License-Identifier: Apache-2.0
"""A learner's run: samples and network on disk, and the training process beside it.

Nothing here waits for training. The caller gives samples as they are accepted and looks in now and
then; what has been learned is handed to `publish` as checkpoint bytes, on disk before it leaves.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from musculoskeletal_ae.exceptions import MusculoskeletalError, StateError
from musculoskeletal_ae.learning.collector import Collector
from musculoskeletal_ae.learning.journal import Journal
from musculoskeletal_ae.learning.online import PRESETS
from musculoskeletal_ae.learning.sample import Sample
from musculoskeletal_ae.learning.supervisor import Supervisor
from musculoskeletal_ae.learning.update import Job
from musculoskeletal_ae.learning.worker_process import Answer, Start
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

#: between two updates [s], so that checkpoints leave at 1 Hz at most
LEAST_INTERVAL = 1.0
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
        if preset not in PRESETS:
            raise MusculoskeletalError(f'preset {preset!r} is unknown; legal: {", ".join(PRESETS)}')
        self._robot, self._collector, self._publish = robot, collector, publish
        self._preset, self._seed, self._steps = preset, seed, steps
        self.data: bytes | None = None
        self.saved: Mae | None = None
        self._unsaved = ''
        self._version = 0
        self._checkpoints = 0
        self._answer: Answer | None = None
        self._training = Supervisor(self._begin_with)
        self._stale = False
        self._due = AFTER_NEWEST
        self._last_start = -LEAST_INTERVAL
        self._set_aside = ''
        self._statistics_hold = True
        self._journal = None if directory is None else Journal(directory, robot)
        if self._journal is not None:
            self._load(self._journal)

    def _load(self, journal: Journal) -> None:
        try:
            self.saved = journal.load(self._collector.store)
        except StateError as error:
            self._set_aside = f'{error}'
            self.set_aside()
            return
        if self.saved is not None:
            self._use(self.saved)

    # -- state ----------------------------------------------------------------------------------

    def _use(self, mae: Mae) -> None:
        """Go on from a network, and hand it out at once."""
        self.data, self._version = checkpoint.to_bytes(mae), mae.version
        self._training.start()
        self._hand_out(self.data)

    def _begin_with(self) -> Start:
        # A new process knows the network but not the body, and nothing of a job that was lost.
        assert self.data is not None
        self._stale, self._due = False, AFTER_NEWEST
        return Start(
            self._robot.description.directory,
            self.data,
            self._preset,
            self._seed,
            None if self._journal is None else self._journal.checkpoint_file,
        )

    def replace(self, path: str | Path) -> None:
        """Start anew from a checkpoint file; the state so far is kept as a backup.

        Raises:
            MusculoskeletalError: If the file does not fit; nothing is changed then.
            OSError: If the disk is full or gone.
        """
        mae = checkpoint.load(path, self._robot)
        self.set_aside()
        self._take(mae)

    def begin(self, path: str | Path) -> None:
        """Start from a checkpoint file where no network was saved; see `replace` for errors."""
        self._take(checkpoint.load(path, self._robot))

    def _take(self, mae: Mae) -> None:
        mae = replace(mae, version=max(mae.version, self._version) + 1)
        if self._journal is not None:
            checkpoint.save(mae, self._journal.checkpoint_file)
        self._statistics_hold = True
        self._use(mae)

    def set_aside(self) -> None:
        """Forget samples and network; on disk they become a backup."""
        self._training.stop()
        self._collector.clear()
        self.data, self.saved = None, None
        if self._journal is not None:
            backup = self._journal.set_aside()
            if backup is not None:
                self._set_aside = f'{self._set_aside} (kept in {backup})'.strip()
            self._journal.rewrite(self._collector.store)

    def accept(self, sample: Sample) -> None:
        """Keep a sample that the collector has just accepted, and learn it soon."""
        self._due = AFTER_NEWEST
        if self._journal is not None:
            try:
                self._journal.append(sample, self._collector.store)
            except (StateError, OSError) as error:
                self._unsaved = f'samples cannot be saved: {error}'
            else:
                self._unsaved = ''

    def relearn(self, muscle: int, newest: int = 0) -> None:
        """Learn a muscle's constants anew from its newest samples and what comes.

        The detector is uncalibrated until enough of the changed arm has been seen.
        """
        self._collector.relearn(muscle, newest)
        if self._journal is not None:
            self._journal.forget(muscle, newest)
        self._due = AFTER_NEWEST
        self._statistics_hold = False
        if self.data is None:
            return
        mae = checkpoint.from_bytes(self.data, self._robot)
        if mae.anomaly is not None and mae.anomaly.calibrated:
            self._version += 1
            anomaly = replace(mae.anomaly, calibrated=False)
            mae = replace(mae, anomaly=anomaly, version=self._version)
            self.data = checkpoint.to_bytes(mae)
            self._stale = self._training.busy
            self._keep_and_hand_out(mae)

    def _keep_and_hand_out(self, mae: Mae) -> None:
        if self._journal is not None:
            checkpoint.save(mae, self._journal.checkpoint_file)
        self._hand_out(checkpoint.to_bytes(mae))

    def save(self) -> Path:
        """Write everything; returns where.

        Raises:
            StateError: If nothing is to be kept.
            OSError: If the disk is full or gone.
        """
        if self._journal is None:
            raise StateError("state_directory is '': nothing is kept; start with a directory")
        self._journal.rewrite(self._collector.store)
        if self.data is not None:
            mae = checkpoint.from_bytes(self.data, self._robot)
            checkpoint.save(mae, self._journal.checkpoint_file)
        return self._journal.directory

    # -- training -------------------------------------------------------------------------------

    def poll(self, learning: bool) -> None:
        """Look whether an update is done, and begin the next one if `learning`."""
        answer = self._training.poll()
        if answer is not None:
            self._finish(answer)
        now = time.monotonic()
        due = learning and self._due > 0 and now - self._last_start >= LEAST_INTERVAL
        if due and self._training.can_take(len(self._collector.store)):
            self._begin(now)

    def _begin(self, now: float) -> None:
        # Going on without new samples is the corrected body's way, not the paper's.
        self._due = self._due - 1 if self._preset == 'default' else 0
        self._last_start = now
        self._version += 1
        collector = self._collector
        self._training.submit(
            Job(
                collector.store.observations(),
                collector.reservoir.messages(),
                collector.reservoir.time,
                self._statistics_hold,
                self._steps,
                self._version,
            )
        )

    def _finish(self, answer: Answer) -> None:
        self._answer, self._unsaved = answer, ''
        if self._stale:
            # Begun before a muscle was changed: it would bring the old detector back.
            self._stale = False
            if self.data is not None:
                self._keep_and_hand_out(checkpoint.from_bytes(self.data, self._robot))
            return
        if answer.unsaved:
            self._unsaved = f'the network cannot be saved: {answer.unsaved}'
        self._statistics_hold |= answer.calibrated
        self.data = answer.checkpoint
        self._hand_out(answer.checkpoint)
        try:
            for muscle, newest in answer.changed:
                self.relearn(muscle, newest)
        except (MusculoskeletalError, OSError) as error:
            self._unsaved = f'the state cannot be saved: {error}'

    def _hand_out(self, data: bytes) -> None:
        self._checkpoints += 1
        self._publish(data)

    def close(self) -> None:
        """End the training process and give the directory free."""
        self._training.stop()
        if self._journal is not None:
            self._journal.close()

    @property
    def trouble(self) -> str:
        """What is wrong, or ''."""
        return self._training.trouble or self._unsaved

    def values(self) -> dict[str, str]:
        """Return what people want to know, for /diagnostics."""
        values = {
            'samples': str(len(self._collector.store)),
            'accepted': str(self._collector.store.accepted),
            'checkpoints': str(self._checkpoints),
            'checkpoint version': str(self._version),
            'preset': self._preset,
            'healthy time': f'{self._collector.reservoir.time:.0f} s',
            'training process restarts': str(self._training.restarts),
        }
        if self._journal is not None:
            values['state directory'] = str(self._journal.directory)
        if self._training.pid is not None:
            values['training process'] = str(self._training.pid)
        if self._set_aside:
            values['saved state not used'] = self._set_aside
        if self._answer is not None:
            answer = self._answer
            values |= {
                'error at newest samples': f'{answer.error:.4f} rad',
                'loss': f'{answer.loss:.4f}',
                'update': f'{answer.seconds:.2f} s',
                'anomaly calibrated': str(answer.calibrated),
            }
            if len(answer.noise):
                worst = int(answer.noise.argmax())
                values['length noise'] = (
                    f'{1e3 * answer.noise[worst]:.2f} mm ({self._robot.muscles[worst]})'
                )
        return values
