# SPDX-License-Identifier: Apache-2.0
"""Saves the learner's state to disk, so that nothing is lost if the learner is killed.

    learner.state          the samples and the newest accepted network
    previous.state         the state before that, used if the newest one is missing or unusable
    backup-N.state         states that the user replaced, that were unusable, or whose network the
                           estimator has rejected later
    network.safetensors    the network of the last explicit save, as a checkpoint for other tools
    lock                   locked by the learner that uses the directory

Each save replaces the whole file atomically, and a checksum detects damage. To restore a state,
copy its file to `learner.state` while no learner is running.
"""

import os
import time
from pathlib import Path
from typing import TextIO

from musculoskeletal_ae.exceptions import StateError
from musculoskeletal_ae.files import locked, read_bytes, write_whole
from musculoskeletal_ae.learning import state_format
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.learning.state_format import SavedState
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

NEWEST, PREVIOUS, LOCK = 'learner.state', 'previous.state', 'lock'  # files in the state directory
NETWORK = 'network.safetensors'  # file of the network of the last explicit save
#: refuse a larger state file [bytes]; the states of the shipped arms are 100 times smaller
LARGEST = 1 << 26
RETRY_INTERVAL = 2.0  # after a failed save, try again after this time [s]


class StateStore:
    """Saves and loads the state of one learner in a directory.

    Attributes:
        directory: The state directory.
        not_used: Why a state on disk was not used, and where its backup is, for users; '' if none.
    """

    def __init__(self, directory: str | Path, robot: Robot) -> None:
        """Open and lock a directory, and create it if it does not exist.

        Raises:
            StateError: If the directory cannot be written or another learner uses it.
        """
        name = f'state_directory {str(directory)!r}'
        try:
            self.directory = Path(directory).expanduser()
        except RuntimeError as error:
            raise StateError(
                f'{name}: the home directory is unknown; set the parameter state_directory to an '
                "absolute path, or to '' to save nothing"
            ) from error
        self.not_used = ''
        self._robot = robot
        self._newest = self.directory / NEWEST
        self._previous = self.directory / PREVIOUS
        self._lock: TextIO | None = None
        self._saved_count = 0  # number of accepted samples when the state was saved last
        self._problem = ''  # why the last save failed
        self._next_attempt = 0.0  # do not retry a failed save before this time [s]
        try:
            self._open()
        except BlockingIOError as error:
            raise StateError(
                f'{name} is in use by another learner; stop that learner, or set the parameter '
                'state_directory to another directory'
            ) from error
        except (OSError, ValueError) as error:  # a NUL in the path raises a ValueError
            raise StateError(
                f'{name} cannot be written ({error}); set the parameter state_directory to a '
                "writable directory, or to '' to save nothing"
            ) from error

    def _open(self) -> None:
        self.directory.mkdir(parents=True, exist_ok=True)
        self._lock = locked(self.directory / LOCK)
        # Remove the temporary files of a learner that was killed while it saved.
        for pattern in ('.*.state.*', f'.{NETWORK}.*'):
            for unfinished in self.directory.glob(pattern):
                unfinished.unlink()

    def close(self) -> None:
        """Release the directory without saving, because each change was saved when it was made."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    # -- reading --------------------------------------------------------------------------------

    def load(self, samples: SampleStore) -> Mae | None:
        """Load the saved samples into an empty store; return the saved network, or None.

        An unusable state is renamed to a backup, and the previous state is used. Only the samples
        are used if the saved network is unusable, or if muscles were added to the robot after the
        save; the samples do not describe those muscles.

        Raises:
            StateError: If a state cannot be kept as a backup.
        """
        try:
            return self._load(samples)
        except OSError as error:
            raise StateError(
                f'{self.directory}: an unusable state cannot be kept as a backup ({error}); '
                'free disk space or make the directory writable, or set another state_directory'
            ) from error

    def _load(self, samples: SampleStore) -> Mae | None:
        state = self._read(self._newest)
        if state is None:
            state = self._read(self._previous)
            if self.not_used:
                used = 'learning starts again' if state is None else 'the previous state is used'
                self.not_used += f'; {used}'
        if state is None:
            return None
        state_format.restore_samples(state, self._robot, samples)
        self._saved_count = samples.accepted
        try:
            return state_format.restore_network(state, self._robot)
        except StateError as error:
            self._note_backup(error, self._write_backup(state))
            self._save(samples, None)
            return None

    def _read(self, file: Path) -> SavedState | None:
        """Read the state in a file; rename the file to a backup if it is unusable."""
        if not file.exists():
            return None
        try:
            return state_format.from_bytes(read_bytes(file, _refuse, LARGEST), self._robot)
        except StateError as error:
            self._note_backup(f'{file}: {error}', file.rename(self._free_name()))
            return None

    def _note_backup(self, problem: object, backup: Path) -> None:
        note = f'{problem}; the state is kept as {backup}'
        self.not_used = f'{self.not_used}; {note}' if self.not_used else note

    # -- writing --------------------------------------------------------------------------------

    def keep(self, samples: SampleStore, network: bytes | None, changed: bool = True) -> None:
        """Keep the state on disk: save it if it has `changed`, and retry a failed save (`trouble`).

        Call this method often, because a failed save is retried by a later call.
        """
        now = time.monotonic()
        if now < self._next_attempt or not (changed or self._problem):
            return
        try:
            self._put_in_place()
            self._save(samples, network)
            self._problem = ''
        except OSError as error:
            self._problem = str(error)
            self._next_attempt = now + RETRY_INTERVAL

    def save(self, samples: SampleStore, network: bytes | None) -> None:
        """Save the state now, and the network also as a separate checkpoint file.

        Raises:
            StateError: If the state or the network cannot be saved.
        """
        self._next_attempt = 0.0
        self.keep(samples, network)
        if trouble := self.trouble(samples):
            raise StateError(trouble)
        if network is None:
            return
        try:
            write_whole(self.directory / NETWORK, network)
        except OSError as error:
            raise StateError(
                'the state is saved with samples and network, but the network could not also be '
                f'written to {self.directory / NETWORK} ({error}); free disk space or make the '
                'directory writable, and try again'
            ) from error

    def trouble(self, samples: SampleStore) -> str:
        """Return why the newest state is not on disk and how many samples are missing, or ''."""
        if not self._problem:
            return ''
        count = samples.accepted - self._saved_count
        if count < 0:  # the saved samples were replaced, after which they are numbered anew
            count = samples.accepted
        return (
            f'samples and network cannot be saved ({self._problem}); samples not on disk yet: '
            f'{count}; free disk space or make {self.directory} writable, then saving succeeds'
        )

    def back_up(self, samples: SampleStore, network: bytes | None, reason: str = '') -> None:
        """Save a state that is about to be replaced as a backup.

        Args:
            samples: The samples.
            network: The network as the content of a checkpoint, or None.
            reason: Why a saved network is not used, for `not_used`.

        Raises:
            StateError: If the backup cannot be made.
        """
        try:
            self._put_in_place()
            backup = self._write_backup(state_format.collect(self._robot, samples, network))
        except OSError as error:
            raise StateError(
                f'{self.directory}: no backup can be made ({error}); nothing was replaced. Free '
                'disk space or make the directory writable, and try again'
            ) from error
        if reason:
            self._note_backup(reason, backup)

    def _put_in_place(self) -> None:
        """Open the directory again if it has been deleted or replaced."""
        if not self._is_in_place():
            self.close()
            self._open()

    def _is_in_place(self) -> bool:
        """Return whether the directory is open, and has not been deleted or replaced since then."""
        if self._lock is None:
            return False
        try:
            in_directory = (self.directory / LOCK).stat()
        except FileNotFoundError:
            return False
        return os.path.samestat(os.fstat(self._lock.fileno()), in_directory)

    def _save(self, samples: SampleStore, network: bytes | None) -> None:
        state = state_format.collect(self._robot, samples, network)
        write_whole(self._newest, state_format.to_bytes(state), self._previous)
        self._saved_count = samples.accepted

    def _write_backup(self, state: SavedState) -> Path:
        backup = self._free_name()
        write_whole(backup, state_format.to_bytes(state))
        return backup

    def _free_name(self) -> Path:
        number = 1
        while (backup := self.directory / f'backup-{number}.state').exists():
            number += 1
        return backup


def _refuse(_: Path, problem: str) -> StateError:
    return StateError(problem)
