# SPDX-License-Identifier: Apache-2.0
"""What a learner has on disk, so that nothing learned is lost when it is killed at any moment.

    samples.log              the samples (`sample_log`)
    checkpoint.safetensors   the newest network, replaced as a whole
    backup-N/                a state that was replaced by a `checkpoint` set by the user
    lock                     held while a learner runs here

A state is replaced in one step, the renaming of a folder: backup-N.tmp, which holds the old files
as hard links and the new network, becomes backup-N. Before it, the old state is in use; after it,
the new one is: what is left to do then is done, at the latest, when the directory is opened next.
"""

from __future__ import annotations

import fcntl
import os
import shutil
from contextlib import suppress
from pathlib import Path

from musculoskeletal_ae.exceptions import CheckpointError, StateError
from musculoskeletal_ae.learning.network_file import NetworkFile
from musculoskeletal_ae.learning.sample_log import SampleLog, sync_directory
from musculoskeletal_ae.learning.store import SampleStore
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

NEXT = 'next.safetensors'  # in a backup: the network that replaces the one kept there


class Journal:
    """The directory of one robot's learner.

    Attributes:
        directory: Where it is.
        log: The samples.
        network: The network.
        not_used: What was found at the start and could not be used, or ''.
    """

    def __init__(self, directory: str | Path, robot: Robot) -> None:
        """Open a directory, made if missing, for this process alone.

        Raises:
            StateError: If it cannot be written, or another learner works there.
        """
        self.directory = Path(directory).expanduser()
        self._robot = robot
        self.log = SampleLog(self.directory / 'samples.log', robot)
        self.network = NetworkFile(self.directory / 'checkpoint.safetensors', robot)
        self.not_used = ''
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            self._lock = (self.directory / 'lock').open('wb')
        except (OSError, ValueError) as error:
            raise StateError(
                f'state_directory {str(directory)!r} cannot be written ({error}); '
                "give a directory that can, or '' to keep nothing"
            ) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._lock.close()
            raise StateError(
                f'state_directory {str(directory)!r} is used by another learner; '
                'give each its own, or stop the other'
            ) from error
        self._tidy()

    def _tidy(self) -> None:
        """Remove what a kill has left unfinished, and finish what it has left begun."""
        for temporary in self.directory.glob(f'.{self.network.path.name}.*'):
            with suppress(OSError):
                temporary.unlink()
        for temporary in self.directory.glob('backup-*.tmp'):
            shutil.rmtree(temporary, ignore_errors=True)
        try:
            for backup in self.directory.glob('backup-*'):
                self._finish(backup)
        except OSError as error:
            self.close()
            raise StateError(
                f'state_directory {str(self.directory)!r}: the state set aside in {backup} '
                f'cannot be removed ({error})'
            ) from error

    # -- the state ------------------------------------------------------------------------------

    def load(self, store: SampleStore) -> Mae | None:
        """Fill an empty store with the samples on disk and return the network, if there is one.

        A file that is damaged or of another robot is set aside, whatever the other one is worth.

        Raises:
            StateError: If a file can neither be used nor set aside.
        """
        mae, unfit, reasons = None, [], []
        try:
            self.log.read(store)
        except StateError as error:
            unfit.append(self.log.path)
            reasons.append(str(error))
        try:
            if self.network.path.exists():
                mae = checkpoint.load(self.network.path, self._robot)
        except CheckpointError as error:
            unfit.append(self.network.path)
            reasons.append(str(error))
        if unfit:
            self.not_used = '; '.join(reasons)
            try:
                self._set_aside(unfit, None)
            except OSError as error:
                raise StateError(f'{self.not_used}; cannot be set aside ({error})') from error
        # With a full disk the learner goes on with what was read, and says so.
        self.log.begin(store)
        return mae

    def replace(self, mae: Mae | None) -> None:
        """Let the state become a backup, and a network without samples its successor, in one step.

        Args:
            mae: The network; None for none.

        Raises:
            OSError: If the disk is full or gone; nothing is changed then.
        """
        files = [file for file in (self.log.path, self.network.path) if file.exists()]
        self._set_aside(files, mae)
        self.network.outcome('')
        self.log.begin(SampleStore())

    def _set_aside(self, files: list[Path], mae: Mae | None) -> None:
        number = 1
        while (backup := self.directory / f'backup-{number}').exists():
            number += 1
        temporary = backup.with_suffix('.tmp')
        shutil.rmtree(temporary, ignore_errors=True)
        try:
            temporary.mkdir()
            for file in files:
                os.link(file, temporary / file.name)
            if mae is not None:
                checkpoint.save(mae, temporary / NEXT)
            sync_directory(temporary)
            temporary.replace(backup)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        # From here on the new state is in use: what fails now is done at the next start.
        with suppress(OSError):
            self._finish(backup)
        self.not_used = f'{self.not_used} (kept in {backup})'.strip()

    def _finish(self, backup: Path) -> None:
        """Remove the files that a backup keeps, and take its successor into use."""
        sync_directory(self.directory)
        for file in (self.log.path, self.network.path):
            kept = backup / file.name
            if file.exists() and kept.exists() and file.samefile(kept):
                file.unlink()
        if (backup / NEXT).exists():
            (backup / NEXT).replace(self.network.path)
        sync_directory(self.directory)
        with suppress(OSError):
            backup.rmdir()  # where there was no state to keep

    @property
    def trouble(self) -> str:
        """What could not be saved, and why; or ''."""
        return '; '.join(filter(None, (self.network.trouble, self.log.trouble)))

    def close(self) -> None:
        """Give the directory free."""
        self.log.close()
        with suppress(OSError):
            self._lock.close()
