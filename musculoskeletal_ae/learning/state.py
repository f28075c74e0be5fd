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
import zlib
from pathlib import Path
from typing import TextIO

import msgspec
import numpy as np

from musculoskeletal_ae.arrays import Bools
from musculoskeletal_ae.exceptions import CheckpointError, StateError
from musculoskeletal_ae.files import read_bytes, write_whole
from musculoskeletal_ae.learning.samples import Sample, SampleStore
from musculoskeletal_ae.mae import checkpoint as checkpoints
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

NEWEST, PREVIOUS, LOCK = 'learner.state', 'previous.state', 'lock'
LARGEST = 1 << 26  # [bytes] of a state; a full one of the shipped arms has a fiftieth
CHECKSUM = 4  # [bytes] at the start of a file
#: between two checks that the files are still there, and between two attempts to save [s]
CHECK_INTERVAL, RETRY_INTERVAL = 0.5, 2.0

Values = tuple[float, ...]


class SavedSample(msgspec.Struct, frozen=True, array_like=True):
    """One `Sample`, its number among all ever accepted, and which muscles it describes."""

    number: int
    theta: Values
    tension: Values
    length: Values
    direction: Values
    spread: Values
    gravity: Values
    known: tuple[bool, ...]

    def sizes(self) -> tuple[int, ...]:
        """Return the number of values of each part that has one for every joint or muscle."""
        parts = self.theta, self.tension, self.length, self.direction, self.known
        return tuple(map(len, parts))


class SavedState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a state file holds, as MessagePack behind a checksum."""

    joints: tuple[str, ...]
    muscles: tuple[str, ...]
    samples: tuple[SavedSample, ...]  # the oldest first
    network: bytes | None  # a checkpoint


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
        except OSError:
            lock.close()
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
        problems = []
        try:
            for file in (self._newest, self._previous):
                if not file.exists():
                    continue
                try:
                    data = read_bytes(file, _refuse, LARGEST)
                    saved = self._decode(file, data)
                except StateError as error:
                    problems.append(f'{error} (kept as {self._set_aside(file)})')
                    continue
                if problems:
                    problems.append('the state saved before it is used')
                self._restore(saved, samples)
                mae, problem = self._restore_network(saved)
                if problem:
                    backup = self._free_name()
                    write_whole(backup, data)
                    self._save(samples, None)
                    problems.append(f'{file}: {problem} (kept as {backup})')
                return mae
            if problems:
                problems.append('learning starts anew')
        except OSError as error:
            raise StateError(
                f'{self.directory}: a state that cannot be used cannot be kept as a backup '
                f'({error}); make space there, or give another state_directory'
            ) from error
        finally:
            self.not_used = '; '.join(problems)
        return None

    def _decode(self, file: Path, data: bytes) -> SavedState:
        """Return the state of a file's content, which fits the robot."""
        checksum, content = data[:CHECKSUM], data[CHECKSUM:]
        try:
            if checksum != _checksum(content):
                raise StateError(f'{file}: damaged, or no state of a learner')
            saved = msgspec.msgpack.decode(content, type=SavedState)
        except msgspec.MsgspecError as error:
            raise StateError(
                f'{file}: no state of this version of the learner ({error})'
            ) from error
        joints, muscles = self._robot.joints, self._robot.muscles
        if saved.joints != joints or not set(saved.muscles) <= set(muscles):
            raise StateError(
                f'{file}: of a robot with joints {", ".join(saved.joints)} and muscles '
                f'{", ".join(saved.muscles)}; this one has {", ".join(joints)} and '
                f'{", ".join(muscles)}'
            )
        sizes = len(joints), *4 * [len(saved.muscles)]
        spreads = 0, len(joints)
        gravities = 0, 3 * len(self._robot.kinematics.parent)
        for sample in saved.samples:
            if (
                sample.sizes() != sizes
                or len(sample.spread) not in spreads
                or len(sample.gravity) not in gravities
            ):
                raise StateError(f'{file}: sample {sample.number} does not fit the robot')
        return saved

    def _restore(self, saved: SavedState, samples: SampleStore) -> None:
        robot = self._robot
        places = list(robot.muscle_indices(saved.muscles))
        for sample in saved.samples:
            theta = np.array(sample.theta)
            # What is not known of an added muscle is as the geometric model has it.
            tension = robot.tension.bias.copy()
            length = robot.muscle_lengths(np.nan_to_num(theta), tension)
            direction = np.zeros(robot.muscle_count)
            known: Bools = np.zeros(robot.muscle_count, dtype=bool)
            tension[places] = sample.tension
            length[places] = sample.length
            direction[places] = sample.direction
            known[places] = sample.known
            spread, gravity = np.array(sample.spread), np.array(sample.gravity)
            restored = Sample(theta, tension, length, direction, spread, gravity)
            samples.add(restored, known, sample.number)
        self._saved_samples = list(samples.samples)

    def _restore_network(self, saved: SavedState) -> tuple[Mae | None, str]:
        """Return the saved network, and what is wrong with it."""
        if added := [name for name in self._robot.muscles if name not in saved.muscles]:
            return None, f'of the robot without {", ".join(added)}; its samples are used'
        if saved.network is None:
            return None, ''
        try:
            return checkpoints.from_bytes(saved.network, self._robot), ''
        except CheckpointError as error:
            return None, f'the saved network: {error}; its samples are used'

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
        backup = self._free_name()
        try:
            write_whole(backup, self._encode(samples, network))
        except OSError as error:
            raise StateError(
                f'{self.directory}: no backup can be made ({error}); nothing was replaced. Make '
                'space there and try again'
            ) from error
        if reason:
            self.not_used = f'{reason} (kept as {backup})'

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
        write_whole(self._newest, self._encode(samples, network), self._previous)
        self._saved_samples, self._is_saved = list(samples.samples), True

    def _encode(self, samples: SampleStore, network: bytes | None) -> bytes:
        stored = zip(samples.numbers, samples.samples, samples.known, strict=True)
        saved = tuple(
            SavedSample(number, *(tuple(part.tolist()) for part in (*sample, known)))
            for number, sample, known in stored
        )
        state = SavedState(self._robot.joints, self._robot.muscles, saved, network)
        content = msgspec.msgpack.encode(state)
        return _checksum(content) + content

    def _free_name(self) -> Path:
        number = 1
        while (backup := self.directory / f'backup-{number}.state').exists():
            number += 1
        return backup

    def _set_aside(self, file: Path) -> Path:
        """Rename a file that cannot be used, so that nothing overwrites it; return its new name."""
        return file.rename(self._free_name())


def _checksum(content: bytes) -> bytes:
    return zlib.crc32(content).to_bytes(CHECKSUM, 'big')


def _refuse(file: Path, problem: str) -> StateError:
    return StateError(f'{file} {problem}')
