# SPDX-License-Identifier: Apache-2.0
"""The learner's state on disk, so that nothing learned is lost when it is killed at any moment.

    learner.state     the samples and the newest network
    previous.state    the state before that, which is used if the newest cannot be
    backup-N.state    states that were replaced by the user or could not be used
    lock              locked by the learner that uses the directory

Each save replaces the whole file atomically; a checksum shows damage. Any of the states becomes
the learner's again when it is copied to `learner.state` while no learner runs.
"""

import fcntl
import os
import time
from pathlib import Path
from typing import TextIO

from musculoskeletal_ae.exceptions import StateError
from musculoskeletal_ae.files import read_bytes, write_whole
from musculoskeletal_ae.learning import saved_state
from musculoskeletal_ae.learning.samples import Sample, SampleStore
from musculoskeletal_ae.learning.saved_state import SavedState
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

NEWEST, PREVIOUS, LOCK = 'learner.state', 'previous.state', 'lock'
LARGEST = 1 << 26  # [bytes] of a state; a full one of the shipped arms has a hundredth
#: between two checks that the files are still there, and between two attempts to save [s]
CHECK_INTERVAL, RETRY_INTERVAL = 0.5, 2.0


class StateStore:
    """Saves and loads the state of one learner in a directory.

    Attributes:
        directory: Where it is.
        not_used: What was found at the start and could not be used, and where it is now; or ''.
    """

    def __init__(self, directory: str | Path, robot: Robot) -> None:
        """Open a directory, made if missing, for this learner alone.

        Raises:
            StateError: If it cannot be written, or another learner uses it.
        """
        name = f'state_directory {str(directory)!r}'
        try:
            self.directory = Path(directory).expanduser()
        except RuntimeError as error:
            raise StateError(
                f"{name}: the home directory is not known; give a whole path, or ''"
            ) from error
        self.not_used = ''
        self._robot = robot
        self._newest = self.directory / NEWEST
        self._previous = self.directory / PREVIOUS
        self._lock: TextIO | None = None
        self._saved_samples: list[Sample] = []  # those that are on disk
        self._is_saved = False  # whether `_newest` should be there
        self._problem = ''  # why the last save failed
        self._next_attempt = 0.0
        try:
            self._open()
        except BlockingIOError as error:
            raise StateError(
                f'{name} is used by another learner; give each its own, or stop the other'
            ) from error
        except (OSError, ValueError) as error:  # a ValueError is a NUL in the path
            raise StateError(
                f"{name} cannot be written ({error}); give a directory that can, or ''"
            ) from error

    def _open(self) -> None:
        self.directory.mkdir(parents=True, exist_ok=True)
        lock = (self.directory / LOCK).open('w')
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            lock.close()
            if isinstance(error, BlockingIOError):
                raise BlockingIOError('another learner uses the directory') from error
            raise
        self._lock = lock
        # A learner that was killed while it saved leaves its temporary file.
        for unfinished in self.directory.glob('.*.state.*'):
            unfinished.unlink()

    def close(self) -> None:
        """Release the directory; everything is on disk already."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    # -- reading --------------------------------------------------------------------------------

    def load(self, samples: SampleStore) -> Mae | None:
        """Fill an empty store with the saved samples; return the saved network, if there is one.

        A state that cannot be used becomes a backup, and the one before it is used. Of the robot as
        it was with fewer muscles the samples are used, which describe the others only.

        Raises:
            StateError: If a state cannot become a backup.
        """
        try:
            return self._load(samples)
        except OSError as error:
            raise StateError(
                f'{self.directory}: a state that cannot be used cannot be kept as a backup '
                f'({error}); make space there, or give another state_directory'
            ) from error

    def _load(self, samples: SampleStore) -> Mae | None:
        state = self._read(self._newest)
        if state is None:
            state = self._read(self._previous)
            if self.not_used:
                used = 'learning starts anew' if state is None else 'the state before it is used'
                self.not_used += f'; {used}'
        if state is None:
            return None
        saved_state.restore_samples(state, self._robot, samples)
        self._saved_samples = list(samples.samples)
        try:
            return saved_state.restore_network(state, self._robot)
        except StateError as error:
            self._note_backup(error, self._write_backup(state))
            self._save(samples, None)
            return None

    def _read(self, file: Path) -> SavedState | None:
        """Return the state of a file; make the file a backup if it cannot be used."""
        if not file.exists():
            return None
        try:
            return saved_state.from_bytes(read_bytes(file, _refuse, LARGEST), self._robot)
        except StateError as error:
            self._note_backup(f'{file}: {error}', file.rename(self._free_name()))
            return None

    def _note_backup(self, problem: object, backup: Path) -> None:
        note = f'{problem} (kept as {backup})'
        self.not_used = f'{self.not_used}; {note}' if self.not_used else note

    # -- writing --------------------------------------------------------------------------------

    def keep(self, samples: SampleStore, network: bytes | None, changed: bool = True) -> None:
        """Save; what cannot be saved now (see `trouble`) is saved as soon as that succeeds.

        Call it often: unless something `changed`, it only checks now and then that the files are
        still there.
        """
        now = time.monotonic()
        if now < self._next_attempt and (self._problem or not changed):
            return
        try:
            self._check_in_place()
            if changed or self._problem:
                self._save(samples, network)
            self._problem = ''
            self._next_attempt = now + CHECK_INTERVAL
        except OSError as error:
            self._problem = str(error)
            self._next_attempt = now + RETRY_INTERVAL

    def save(self, samples: SampleStore, network: bytes | None) -> None:
        """Save at once.

        Raises:
            StateError: If that cannot be done.
        """
        self._next_attempt = 0.0
        self.keep(samples, network)
        if trouble := self.trouble(samples):
            raise StateError(trouble)

    def trouble(self, samples: SampleStore) -> str:
        """Return why the newest state is not on disk, and how much that is; or ''."""
        if not self._problem:
            return ''
        on_disk = {id(sample) for sample in self._saved_samples}
        count = sum(id(sample) not in on_disk for sample in samples.samples)
        return (
            f'samples and network cannot be saved ({self._problem}); samples that are not on disk '
            f'yet: {count}; make space in {self.directory}, or make it writable, and all is saved'
        )

    def back_up(self, samples: SampleStore, network: bytes | None, reason: str = '') -> None:
        """Save a state that is about to be replaced as a backup.

        `reason` says why a network that was found is not used.

        Raises:
            StateError: If that cannot be done.
        """
        try:
            backup = self._write_backup(saved_state.collect(self._robot, samples, network))
        except OSError as error:
            raise StateError(
                f'{self.directory}: no backup can be made ({error}); nothing was replaced. Make '
                'space there and try again'
            ) from error
        if reason:
            self._note_backup(reason, backup)

    def _check_in_place(self) -> None:
        """Open the directory if need be; raise an OSError if it, or the state, was removed."""
        if self._lock is None:
            self._open()
            return
        try:
            there = os.path.samestat(os.fstat(self._lock.fileno()), (self.directory / LOCK).stat())
        except FileNotFoundError:
            there = False
        if not there or (self._is_saved and not self._newest.exists()):
            self.close()
            raise FileNotFoundError(f'{self._newest} was removed')

    def _save(self, samples: SampleStore, network: bytes | None) -> None:
        state = saved_state.collect(self._robot, samples, network)
        write_whole(self._newest, saved_state.to_bytes(state), self._previous)
        self._saved_samples, self._is_saved = list(samples.samples), True

    def _write_backup(self, state: SavedState) -> Path:
        backup = self._free_name()
        write_whole(backup, saved_state.to_bytes(state))
        return backup

    def _free_name(self) -> Path:
        number = 1
        while (backup := self.directory / f'backup-{number}.state').exists():
            number += 1
        return backup


def _refuse(_: Path, problem: str) -> StateError:
    return StateError(problem)
