# SPDX-License-Identifier: Apache-2.0
"""The state directory of version 0.1, read once and then kept as a backup.

samples.log              a header, then one record per sample or per muscle that was forgotten
checkpoint.safetensors   the newest network
lock                     empty
"""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import numpy as np

from musculoskeletal_ae.files import read_start
from musculoskeletal_ae.learning.samples import Sample, SampleStore
from musculoskeletal_ae.robot.robot import Robot

LOG, NETWORK, LOCK = 'samples.log', 'checkpoint.safetensors', 'lock'
MAGIC = b'MAESMPL1'
SAMPLE, FORGET = 1, 2
LARGEST = 1 << 26  # [bytes] of a state; a full one has a tenth
HEAD = struct.Struct('<II')  # kind, checksum


def files(directory: Path) -> list[Path]:
    """Return the files of an old state."""
    return [file for name in (LOG, NETWORK, LOCK) if (file := directory / name).is_file()]


def read(directory: Path, robot: Robot, samples: SampleStore) -> tuple[str, bytes | None]:
    """Fill a store; return what is wrong with the state, or '', and the checkpoint.

    Raises:
        OSError: If a file cannot be read.
    """
    problem, log, network = '', directory / LOG, directory / NETWORK
    names = json.dumps({'joints': robot.joints, 'muscles': robot.muscles}).encode()
    header = MAGIC + struct.pack('<II', len(names), zlib.crc32(names)) + names
    data = read_start(log, LARGEST)
    size = HEAD.size + 8 * (robot.joint_count + 4 * robot.muscle_count)
    records = [data[at : at + size] for at in range(len(header), len(data) - size + 1, size)]
    whole = [r for r in records if zlib.crc32(r[:4] + r[8:]) == HEAD.unpack_from(r)[1]]
    # A header that the disk has damaged costs no sample: whole records where this robot's would be
    # are its own. Another robot's header is whole itself.
    if data and data[: len(header)] != header and (_whole_header(data) or not whole):
        problem = f'{log}: not made by a learner of these joints and muscles'
    else:
        for record in whole:
            _replay(record, robot, samples)
    return problem, read_start(network, LARGEST) or None


def _replay(record: bytes, robot: Robot, samples: SampleStore) -> None:
    kind, _ = HEAD.unpack_from(record)
    values = np.frombuffer(record[HEAD.size :])
    muscles, joints = robot.muscle_count, robot.joint_count
    if kind == SAMPLE and np.isfinite(values).all():
        *parts, known = np.split(values, joints + muscles * np.arange(4))
        samples.add(Sample(*(part.copy() for part in parts)), known > 0.5)
    elif kind == FORGET and 0 <= values[0] < muscles:
        samples.forget(int(values[0]), int(values[1]))


def _whole_header(data: bytes) -> bool:
    if len(data) < len(MAGIC) + 8 or not data.startswith(MAGIC):
        return False
    size, checksum = struct.unpack_from('<II', data, len(MAGIC))
    names = data[len(MAGIC) + 8 : len(MAGIC) + 8 + size]
    return len(names) == size and zlib.crc32(names) == checksum
