# SPDX-License-Identifier: Apache-2.0
"""What a learner has on disk, so that nothing learned is lost when it is killed at any moment.

    samples.log              a header, then one record per accepted sample, appended and synced
    checkpoint.safetensors   the newest network, replaced as a whole
    backup-N/                a state that was replaced by a `checkpoint` set by the user
    lock                     held while a learner runs here

A record carries its checksum; one that was torn, or that the disk has damaged, is left out when the
log is read. The log is rewritten when it holds much more than the store does.
"""

from __future__ import annotations

import fcntl
import json
import os
import struct
import zlib
from contextlib import suppress
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.exceptions import CheckpointError, StateError
from musculoskeletal_ae.learning.sample import Sample
from musculoskeletal_ae.learning.store import SampleStore
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

Array = NDArray[np.float64]

MAGIC = b'MAESMPL1'
SAMPLE, FORGET = 1, 2
HEAD = struct.Struct('<II')  # kind, checksum
LARGEST_HEADER = 1 << 20
#: the log is rewritten when it holds so many more records than the store samples
SURPLUS = 400


class Journal:
    """The directory of one robot's learner."""

    def __init__(self, directory: str | Path, robot: Robot) -> None:
        """Open a directory, made if missing, for this process alone.

        Raises:
            StateError: If it cannot be written, or another learner works there.
        """
        self.directory = Path(directory).expanduser()
        self._robot = robot
        self._width = robot.joint_count + 4 * robot.muscle_count
        self._log: IO[bytes] | None = None
        self._records = 0
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

    @property
    def checkpoint_file(self) -> Path:
        """Where the network is."""
        return self.directory / 'checkpoint.safetensors'

    @property
    def _log_file(self) -> Path:
        return self.directory / 'samples.log'

    # -- reading --------------------------------------------------------------------------------

    def load(self, store: SampleStore) -> Mae | None:
        """Fill an empty store with the samples on disk and return the network, if there is one.

        Raises:
            StateError: If what is there does not fit the robot; nothing is changed then.
        """
        data = b''
        if self._log_file.exists():
            data = self._log_file.read_bytes()
        start = self._check_header(data) if data else 0
        mae = None
        if self.checkpoint_file.exists():
            try:
                mae = checkpoint.load(self.checkpoint_file, self._robot)
            except CheckpointError as error:
                raise StateError(str(error)) from error
        size = HEAD.size + 8 * self._width
        for at in range(start, len(data) - size + 1, size):
            self._replay(data[at : at + size], store)
        self.rewrite(store)
        return mae

    def _replay(self, record: bytes, store: SampleStore) -> None:
        kind, checksum = HEAD.unpack_from(record)
        payload = record[HEAD.size :]
        if zlib.crc32(record[:4] + payload) != checksum:
            return
        values = np.frombuffer(payload)
        muscles, joints = self._robot.muscle_count, self._robot.joint_count
        if kind == SAMPLE and np.isfinite(values).all():
            parts = np.split(values, joints + muscles * np.arange(4))
            store.add(Sample(*(part.copy() for part in parts[:4])), parts[4] > 0.5)
        elif kind == FORGET and 0 <= values[0] < muscles:
            store.forget(int(values[0]), int(values[1]))

    def _header(self) -> bytes:
        names = {'joints': self._robot.joints, 'muscles': self._robot.muscles}
        text = json.dumps(names).encode()
        return MAGIC + struct.pack('<II', len(text), zlib.crc32(text)) + text

    def _check_header(self, data: bytes) -> int:
        """Return where the records start."""
        expected = self._header()
        if data[: len(expected)] != expected:
            raise StateError(
                f'{self._log_file}: not made by a learner of these joints and muscles; '
                'set it aside, or give another state_directory'
            )
        return len(expected)

    # -- writing --------------------------------------------------------------------------------

    def append(self, sample: Sample, store: SampleStore) -> None:
        """Write a sample that the store has just taken; on disk when this returns.

        Raises:
            OSError: If the disk is full or gone.
        """
        known = np.ones(self._robot.muscle_count)
        self._write(SAMPLE, np.concatenate([*sample, known]))
        if self._records > 2 * len(store) + SURPLUS:
            self.rewrite(store)

    def forget(self, muscle: int, newest: int) -> None:
        """Write that older samples say nothing about a muscle any more."""
        values = np.zeros(self._width)
        values[:2] = muscle, newest
        self._write(FORGET, values)

    def _write(self, kind: int, values: Array) -> None:
        if self._log is None:
            raise StateError('the journal is closed')
        self._log.write(self._record(kind, values))
        self._log.flush()
        os.fsync(self._log.fileno())
        self._records += 1

    def _record(self, kind: int, values: Array) -> bytes:
        payload = values.astype('<f8').tobytes()
        checksum = zlib.crc32(struct.pack('<I', kind) + payload)
        return HEAD.pack(kind, checksum) + payload

    def rewrite(self, store: SampleStore) -> None:
        """Replace the log by one that holds just what the store does."""
        temporary = self._log_file.with_suffix('.new')
        with temporary.open('wb') as file:
            file.write(self._header())
            for sample, known in zip(store.samples, store.known, strict=True):
                file.write(self._record(SAMPLE, np.concatenate([*sample, known.astype(float)])))
            file.flush()
            os.fsync(file.fileno())
        self._close_log()
        temporary.replace(self._log_file)
        self._sync_directory()
        self._log = self._log_file.open('ab')
        self._records = len(store)

    def set_aside(self) -> Path | None:
        """Move the state into a backup folder; returns it, or None if there was nothing."""
        files = [f for f in (self._log_file, self.checkpoint_file) if f.exists()]
        self._close_log()
        if not files:
            return None
        number = 1
        while (backup := self.directory / f'backup-{number}').exists():
            number += 1
        backup.mkdir()
        for file in files:
            file.replace(backup / file.name)
        self._sync_directory()
        return backup

    def _sync_directory(self) -> None:
        descriptor = os.open(self.directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def _close_log(self) -> None:
        if self._log is not None:
            self._log.close()
            self._log = None

    def close(self) -> None:
        """Give the directory free."""
        self._close_log()
        with suppress(OSError):
            self._lock.close()
