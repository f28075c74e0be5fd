# SPDX-License-Identifier: Apache-2.0
"""The file of accepted samples: a header, then one record per sample, appended and synced.

A record carries its checksum; one that was torn, or that the disk has damaged, is left out when the
log is read. What could not be written (disk full) is made good as a whole: the log is then written
anew from the store as soon as that succeeds.
"""

from __future__ import annotations

import json
import os
import struct
import time
import zlib
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import StateError
from musculoskeletal_ae.learning.sample import Sample
from musculoskeletal_ae.learning.store import SampleStore
from musculoskeletal_ae.robot.robot import Robot

MAGIC = b'MAESMPL1'
SAMPLE, FORGET = 1, 2
HEAD = struct.Struct('<II')  # kind, checksum
#: the log is rewritten when it holds so many more records than the store samples
SURPLUS = 400
#: between two attempts to write what could not be written [s]
PAUSE = 2.0


class SampleLog:
    """The log of one robot's samples; `trouble` says why it lags behind the store, or ''."""

    def __init__(self, path: Path, robot: Robot) -> None:
        """Open nothing yet."""
        self.path = path
        self._robot = robot
        self._width = robot.joint_count + 4 * robot.muscle_count
        self._file: BinaryIO | None = None
        self._records = 0
        self._retry_at = 0.0
        self.trouble = ''

    # -- reading --------------------------------------------------------------------------------

    def read(self, store: SampleStore) -> None:
        """Fill an empty store with the samples on disk.

        Raises:
            StateError: If the file cannot be read or is not of this robot; the store stays empty.
        """
        if not self.path.exists():
            return
        try:
            data = self.path.read_bytes()
        except OSError as error:
            raise StateError(f'{self.path}: cannot be read ({error})') from error
        size = HEAD.size + 8 * self._width
        # Found to be of this robot before the store is touched.
        start = self._start_of_records(data, size)
        for at in range(start, len(data) - size + 1, size):
            if _whole(data[at : at + size]):
                self._replay(data[at : at + size], store)

    def _replay(self, record: bytes, store: SampleStore) -> None:
        kind, _ = HEAD.unpack_from(record)
        values = np.frombuffer(record[HEAD.size :])
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

    def _start_of_records(self, data: bytes, size: int) -> int:
        expected = self._header()
        start = len(expected)
        if not data or data[:start] == expected:
            return start
        # A header that the disk has damaged costs no sample: whole records where this robot's
        # would be are its own. Another robot's header is whole itself.
        records = range(start, len(data) - size + 1, size)
        if not _whole_header(data) and any(_whole(data[at : at + size]) for at in records):
            return start
        raise StateError(
            f'{self.path}: not made by a learner of these joints and muscles; '
            'set it aside, or give another state_directory'
        )

    # -- writing --------------------------------------------------------------------------------

    def append(self, sample: Sample, store: SampleStore) -> None:
        """Write a sample that the store has just taken; on disk on return, or there is trouble."""
        known = np.ones(self._robot.muscle_count)
        self._put(_record(SAMPLE, np.concatenate([*sample, known])), store)

    def forget(self, muscle: int, newest: int, store: SampleStore) -> None:
        """Write that the store has let older samples forget a muscle; see `append`."""
        values = np.zeros(self._width)
        values[:2] = muscle, newest
        self._put(_record(FORGET, values), store)

    def _put(self, record: bytes, store: SampleStore) -> None:
        try:
            # After a failed write the file may end in a torn record: nothing may follow it.
            if self._file is None or self.trouble:
                self.rewrite(store)
                return
            _write(self._file, record)
            self._records += 1
            if self._records > 2 * len(store) + SURPLUS:
                self.rewrite(store)
        except OSError as error:
            self._fail(error)

    def heal(self, store: SampleStore) -> None:
        """Try again to write what could not be written; does nothing where nothing is missing."""
        if not self.trouble or time.monotonic() < self._retry_at:
            return
        try:
            self.rewrite(store)
        except OSError as error:
            self._fail(error)

    def begin(self, store: SampleStore) -> None:
        """Write the log anew, whatever file there was; there may be trouble then."""
        self.close()
        try:
            self.rewrite(store)
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.trouble = f'samples cannot be saved: {error}'
        self._retry_at = time.monotonic() + PAUSE

    def rewrite(self, store: SampleStore) -> None:
        """Replace the log by one that holds just what the store does.

        Raises:
            OSError: If the disk is full or gone; the log on disk is as it was then.
        """
        temporary = self.path.with_suffix('.new')
        # Unbuffered: nothing of a write that failed may come back later.
        file: BinaryIO = temporary.open('wb', buffering=0)
        try:
            records = [
                _record(SAMPLE, np.concatenate([*sample, known.astype(float)]))
                for sample, known in zip(store.samples, store.known, strict=True)
            ]
            _write(file, self._header() + b''.join(records))
            temporary.replace(self.path)
        except BaseException:
            _close(file)
            with suppress(OSError):
                temporary.unlink()
            raise
        # The file stays open under its new name, so that nothing more can fail.
        self.close()
        self._file, self._records = file, len(store)
        sync_directory(self.path.parent)
        self.trouble = ''

    def close(self) -> None:
        """Close the file; all of it is on disk already."""
        if self._file is not None:
            _close(self._file)
            self._file = None


def sync_directory(directory: Path) -> None:
    """Let names in a directory survive a power cut.

    Raises:
        OSError: If the disk is gone.
    """
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _record(kind: int, values: Array) -> bytes:
    payload = values.astype('<f8').tobytes()
    return HEAD.pack(kind, zlib.crc32(struct.pack('<I', kind) + payload)) + payload


def _whole(record: bytes) -> bool:
    _, checksum = HEAD.unpack_from(record)
    return zlib.crc32(record[:4] + record[HEAD.size :]) == checksum


def _whole_header(data: bytes) -> bool:
    if len(data) < len(MAGIC) + 8 or not data.startswith(MAGIC):
        return False
    size, checksum = struct.unpack_from('<II', data, len(MAGIC))
    text = data[len(MAGIC) + 8 : len(MAGIC) + 8 + size]
    return len(text) == size and zlib.crc32(text) == checksum


def _write(file: BinaryIO, data: bytes) -> None:
    written = file.write(data)
    if written != len(data):
        raise OSError(f'only {written} of {len(data)} bytes could be written')
    os.fsync(file.fileno())


def _close(file: BinaryIO) -> None:
    with suppress(OSError):
        file.close()
