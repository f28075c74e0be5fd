# SPDX-License-Identifier: Apache-2.0
"""What a learner has on disk, so that nothing learned is lost when it is killed at any moment.

    learner.sqlite   the samples and the newest network
    backup-N/        a state that was replaced or could not be used: a state directory of its own

Memory is the truth, and the disk is brought in line with it, each time in one transaction. What
could not be written (disk full, read-only, deleted under our feet) is written as soon as that
succeeds, and until then `trouble` says why it was not.

The journal is a rollback journal, not a write-ahead log: between two transactions the directory
holds one file that is whole, however it is copied. Each sample's record carries its checksum, and a
mark by which it is found even where the disk has damaged the structure of the file.
"""

import json
import os
import re
import shutil
import sqlite3
import struct
import time
import zlib
from contextlib import closing, suppress
from pathlib import Path

import numpy as np

from musculoskeletal_ae.arrays import Bools, Ints
from musculoskeletal_ae.exceptions import CheckpointError, StateError
from musculoskeletal_ae.files import read_start, sync_directory
from musculoskeletal_ae.learning.samples import NOTHING, Sample, SampleStore
from musculoskeletal_ae.mae import checkpoint as checkpoints
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

FILE = 'learner.sqlite'
OLD = 'samples.log'  # what learners wrote before; not read any more
LARGEST = 1 << 26  # [bytes] of a state; a full one has a tenth
TABLES = {
    ('CREATE TABLE sample (number INTEGER PRIMARY KEY, record BLOB NOT NULL)',),
    ('CREATE TABLE network (checksum INTEGER NOT NULL, checkpoint BLOB NOT NULL)',),
}
MADE = 'SELECT sql FROM sqlite_master'
SAMPLES = 'SELECT number, record FROM sample ORDER BY number'
HEAD = struct.Struct('<8sI')  # mark, checksum
MARK = b'MAEsampl'
#: between two looks at the file, and two attempts to write what could not be written [s]
LOOK, PAUSE = 0.5, 2.0


class State:
    """The directory of one robot's learner."""

    def __init__(self, directory: str | Path, robot: Robot) -> None:
        """Open a directory, made if missing, for this process alone.

        Raises:
            StateError: If it cannot be written, or another learner works there.
        """
        name = f'state_directory {str(directory)!r}'
        try:
            self.directory = Path(directory).expanduser()
        except RuntimeError as error:  # of whom nobody knows a home
            raise StateError(f"{name}: no home to put for ~; give a whole path, or ''") from error
        self.not_used = ''  # what was found at the start and could not be used
        self.trouble = ''  # why the disk is not in line with memory
        self._file = self.directory / FILE
        self._robot = robot
        self._connection: sqlite3.Connection | None = None
        self._next_look = 0.0
        try:
            self._open()
            for unfinished in self.directory.glob('backup-*.tmp'):
                shutil.rmtree(unfinished, ignore_errors=True)
        except (OSError, ValueError, sqlite3.Error) as error:
            if 'locked' in str(error):
                raise StateError(
                    f'{name} is used by another learner; give each its own, or stop the other'
                ) from error
            try:
                writable = all(os.access(path, os.W_OK) for path in (self.directory, self._file))
            except ValueError:  # a name that no file can have
                writable = False
            if not writable:
                raise StateError(
                    f"{name} cannot be written ({error}); give a directory that can, or ''"
                ) from error
            if self._empty():
                self._failed(error)  # with a full disk, a new learner goes on and says so
            # Else it is damaged: `load` sees what can be used.

    def _empty(self) -> bool:
        return self._file.stat().st_size == 0

    def _files(self) -> list[Path]:
        names = FILE, f'{FILE}-journal'
        return [file for name in names if (file := self.directory / name).exists()]

    def _open(self) -> None:
        self.directory.mkdir(parents=True, exist_ok=True)
        if self._file.exists() and not self._file.is_file():
            raise OSError(f'{self._file} is no regular file')  # one that may never end
        if self._file.exists() and self._file.stat().st_size > LARGEST:
            raise sqlite3.DatabaseError('larger than any state')
        self._connection = _connect(self._file)
        self._opened = self._file.stat()

    def close(self) -> None:
        """Release the directory; all is on disk already."""
        if self._connection is not None:
            with suppress(sqlite3.Error):
                self._connection.close()
            self._connection = None

    # -- reading --------------------------------------------------------------------------------

    def load(self, samples: SampleStore) -> Mae | None:
        """Fill an empty store with the samples on disk and return the network, if there is one.

        A file that is damaged or another robot's becomes a backup, and what can be used is used:
        of a robot that had fewer muscles all samples, which say nothing about the others.

        Raises:
            StateError: If it can neither be used nor become a backup.
        """
        problem, old = '', self.directory / OLD
        data: bytes | None = None
        try:
            if not self._empty():
                problem, data = self._read(samples)
            elif old.exists():
                problem = f'{old}: of a version before {FILE}, whose samples are not read any more;'
                problem += ' the network beside it can be given as `checkpoint`'
            mae = None
            if data is not None:
                try:
                    mae = checkpoints.from_bytes(data, self._robot)
                except CheckpointError as error:
                    problem = problem or f'the saved network: {error}'
            if problem:
                self._put_away([old] if self._empty() else self._files(), problem)
            # With a full disk the learner goes on with what was read, and says so.
            self.keep(samples, None if mae is None else data)
        except OSError as error:
            raise StateError(f'{self.directory}: cannot be used ({error})') from error
        return mae

    def _read(self, samples: SampleStore) -> tuple[str, bytes | None]:
        """Read the file; return what is wrong with it, or '', and the checkpoint."""
        problem, data, records = '', None, []
        try:
            if self._connection is None:
                raise sqlite3.DatabaseError('not a database')
            for checksum, checkpoint in self._connection.execute('SELECT * FROM network'):
                if zlib.crc32(checkpoint) == checksum:
                    data = checkpoint
                else:
                    problem = f'{self._file}: the saved network is damaged'
            records = [record for _, record in self._connection.execute(SAMPLES)]
            ((said,),) = self._connection.execute('PRAGMA integrity_check(1)')
            if said != 'ok' or set(self._connection.execute(MADE)) != TABLES:
                raise sqlite3.DatabaseError(said)
        except (sqlite3.Error, TypeError, ValueError) as error:
            problem = f'{self._file}: damaged ({error})'
            whole = read_start(self._file, LARGEST)
            places = [match.start() for match in re.finditer(re.escape(MARK), whole)]
            sizes = self._sizes(self._robot.muscles)
            records = [whole[place : place + size] for place in places for size in sizes]
        muscles = self._muscles_of(data)
        if added := [name for name in self._robot.muscles if name not in muscles]:
            problem = problem or f'{self._file}: of the robot without {", ".join(added)}; its '
            problem += 'samples are learned from'
        unpacked = (read for record in records if (read := self._unpacked(record, muscles)))
        for number, sample, known in sorted(unpacked, key=lambda record: record[0]):
            if number in samples.numbers:  # an older copy: what was forgotten stays so
                samples.known[samples.numbers.index(number)] &= known
            else:
                samples.add(sample, known, number)
        if records and not samples:
            problem = f'{self._file}: made by a learner of other joints and muscles'
        return problem, data

    def _muscles_of(self, data: bytes | None) -> tuple[str, ...]:
        """Return the muscles of the robot whose state this is, as its checkpoint says: no others.

        They may be fewer than this robot's, which had muscles added.
        """
        with suppress(CheckpointError):
            mae = checkpoints.from_bytes(data or b'')
            if mae.joints == self._robot.joints and set(mae.muscles) < set(self._robot.muscles):
                return mae.muscles
        return self._robot.muscles

    def _ends(self, muscles: tuple[str, ...]) -> Ints:
        """Return where a record's number, θ, T, l, s, known and spread end."""
        joints = self._robot.joint_count
        ends: Ints = np.cumsum([1, joints, *4 * [len(muscles)], joints])
        return ends

    def _sizes(self, muscles: tuple[str, ...]) -> tuple[int, ...]:
        """Return the size of a record, and of one from before samples told spread and gravity."""
        *_, before, end = self._ends(muscles)
        whole = end + 3 * len(self._robot.kinematics.parent)
        return tuple(HEAD.size + 8 * int(size) for size in (whole, before))

    def _checksum(self, values: bytes, muscles: tuple[str, ...]) -> int:
        # Another robot's records do not fit.
        names = json.dumps({'joints': self._robot.joints, 'muscles': muscles})
        return zlib.crc32(values, zlib.crc32(names.encode()))

    def _packed(self, number: int, sample: Sample, known: Bools) -> bytes:
        spread, gravity = sample.spread, sample.gravity
        if not spread.size:
            spread = np.zeros(self._robot.joint_count)
        if not gravity.size:
            gravity = np.full(3 * len(self._robot.kinematics.parent), np.nan)
        parts = [number], *sample[:4], known, spread, gravity
        values = np.concatenate(parts).astype('<f8').tobytes()
        return HEAD.pack(MARK, self._checksum(values, self._robot.muscles)) + values

    def _unpacked(
        self, record: object, muscles: tuple[str, ...]
    ) -> tuple[int, Sample, Bools] | None:
        if not isinstance(record, bytes) or len(record) not in self._sizes(muscles):
            return None
        values, (_, checksum) = record[HEAD.size :], HEAD.unpack_from(record)
        if checksum != self._checksum(values, muscles):
            return None
        robot, split = self._robot, np.split(np.frombuffer(values).copy(), self._ends(muscles))
        number, theta, *parts, spread, gravity = split
        # What is not known of an added muscle is as the geometric model has it.
        bias, nothing = robot.tension.bias, np.zeros(robot.muscle_count)
        there = robot.muscle_lengths(np.nan_to_num(theta), bias)
        whole = np.stack([bias, there, nothing, nothing])
        whole[:, list(robot.muscle_indices(muscles))] = parts
        tension, length, direction, known = whole
        sample = Sample(
            theta,
            tension,
            length,
            direction,
            spread if spread.any() else NOTHING,
            gravity if np.isfinite(gravity).any() else NOTHING,
        )
        return int(number[0]), sample, known > 0.5

    # -- writing --------------------------------------------------------------------------------

    def keep(self, samples: SampleStore, checkpoint: bytes | None, changed: bool = True) -> None:
        """Bring the disk in line with memory; it is on return, or there is `trouble`.

        Unless something `changed`, it is enough to look now and then whether the file is there.
        """
        now = time.monotonic()
        if now < self._next_look and (self.trouble or not changed):
            return
        self._next_look = now + LOOK
        try:
            if self._connection and not os.path.samestat(self._file.stat(), self._opened):
                raise FileNotFoundError(f'{self._file} was replaced')
            if self.directory.exists() and not os.access(self.directory, os.W_OK):
                raise PermissionError(f'{self.directory} is read-only')
            if self._connection is None:
                self._open()
            if changed or self.trouble:
                assert self._connection is not None
                self._write(self._connection, samples, checkpoint)
            self.trouble = ''
        except (OSError, sqlite3.Error) as error:
            self._failed(error)

    def save(self, samples: SampleStore, checkpoint: bytes | None) -> None:
        """Bring the disk in line at once.

        Raises:
            StateError: If that cannot be done.
        """
        self._next_look = 0.0
        self.keep(samples, checkpoint)
        if self.trouble:
            raise StateError(self.trouble)

    def _failed(self, error: Exception) -> None:
        self.close()
        self.trouble = f'samples and network cannot be saved: {error}'
        self._next_look = time.monotonic() + PAUSE
        if type(error) is sqlite3.DatabaseError:  # the file itself is damaged
            with suppress(OSError):
                self._put_away(self._files(), str(error))

    def _write(
        self, connection: sqlite3.Connection, samples: SampleStore, checkpoint: bytes | None
    ) -> None:
        with connection:  # commits, or rolls back
            connection.execute('BEGIN IMMEDIATE')
            for (table,) in TABLES - set(connection.execute(MADE)):
                connection.execute(table)
            stack = zip(samples.numbers, samples.samples, samples.known, strict=True)
            wanted = {n: self._packed(n, sample, known) for n, sample, known in stack}
            stored = dict(connection.execute(SAMPLES))
            gone = [(n,) for n, record in stored.items() if wanted.get(n) != record]
            new = [(n, record) for n, record in wanted.items() if stored.get(n) != record]
            connection.executemany('DELETE FROM sample WHERE number = ?', gone)
            connection.executemany('INSERT INTO sample VALUES (?, ?)', new)
            network = [] if checkpoint is None else [(zlib.crc32(checkpoint),)]
            if network != list(connection.execute('SELECT checksum FROM network')):
                connection.execute('DELETE FROM network')
                connection.executemany(
                    'INSERT INTO network VALUES (?, ?)', [(*row, checkpoint) for row in network]
                )

    # -- backups --------------------------------------------------------------------------------

    def back_up(self, samples: SampleStore, checkpoint: bytes | None, problem: str = '') -> None:
        """Make a backup of what is in memory, before that is replaced.

        `problem` says why a network that was found is not used.

        Raises:
            StateError: If the disk is full or gone; nothing is changed then.
        """
        backup = self._next_backup()
        unfinished = backup.with_suffix('.tmp')
        try:
            unfinished.mkdir()
            with closing(_connect(unfinished / FILE)) as connection:
                self._write(connection, samples, checkpoint)
            unfinished.rename(backup)
            sync_directory(self.directory)
        except (OSError, sqlite3.Error) as error:
            shutil.rmtree(unfinished, ignore_errors=True)
            raise StateError(f'{self.directory}: no backup can be made ({error})') from error
        if problem:
            self.not_used = f'{problem} (kept in {backup})'

    def _next_backup(self) -> Path:
        number = 1
        while (backup := self.directory / f'backup-{number}').exists():
            number += 1
        return backup

    def _put_away(self, files: list[Path], problem: str) -> None:
        """Move files into a backup."""
        self.close()
        backup = self._next_backup()
        backup.mkdir()
        for file in files:
            file.rename(backup / file.name)
        sync_directory(backup)
        sync_directory(self.directory)
        if problem:
            self.not_used = f'{problem} (kept in {backup})'


def _connect(file: Path) -> sqlite3.Connection:
    """Open a database for this process alone."""
    connection = sqlite3.connect(file, timeout=0.0, check_same_thread=False)
    try:
        for setting in ('locking_mode=EXCLUSIVE', 'synchronous=EXTRA', 'secure_delete=ON'):
            connection.execute(f'PRAGMA {setting}')
        connection.execute('BEGIN EXCLUSIVE')
        connection.rollback()  # the lock stays, and nothing is written
    except BaseException:
        connection.close()
        raise
    return connection
