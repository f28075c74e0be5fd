# SPDX-License-Identifier: Apache-2.0
"""A chunk of an mcap file: decompressed within bounds, its checksum compared."""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from musculoskeletal_ae.bags.records import LARGEST

_HEAD = struct.Struct('<QQQII')  # start, end, uncompressed size, CRC, length of compression
_LENGTH = struct.Struct('<Q')
_AT_ONCE = 1 << 18
COMPRESSIONS = ('', 'zstd', 'lz4')


class Chunk(NamedTuple):
    """Content of a chunk and what its head says of it; `checked`: it has a checksum."""

    start: int
    end: int
    compression: str
    compressed_size: int
    content: bytes
    checked: bool


def read_chunk(record: bytes) -> Chunk:
    """Return the decompressed chunk of a chunk record.

    Raises:
        ValueError: If it is damaged or claims to be larger than any is.
    """
    if len(record) < _HEAD.size:
        raise ValueError('the chunk is shorter than its head')
    start, end, size, crc, letters = _HEAD.unpack_from(record)
    begin = _HEAD.size + letters
    compression = record[_HEAD.size : begin].decode('ascii', 'replace')[:40]
    if compression not in COMPRESSIONS:
        raise ValueError(f'compression {compression!r} is none of {COMPRESSIONS}')
    if len(record) < begin + _LENGTH.size:
        raise ValueError('the chunk is shorter than its head')
    (length,) = _LENGTH.unpack_from(record, begin)
    data = record[begin + _LENGTH.size :]
    if length != len(data):
        raise ValueError(f'the chunk claims {length} bytes and has {len(data)}')
    if size > LARGEST:
        raise ValueError(f'the chunk claims {size} bytes when decompressed, at most {LARGEST}')
    content = _decompress(data, compression, size)
    if len(content) != size:
        raise ValueError(f'the chunk does not have the {size} bytes it claims when decompressed')
    # A CRC of 0 says that the recorder computed none.
    if crc and zlib.crc32(content) != crc:
        raise ValueError('the checksum of the chunk does not fit')
    return Chunk(start, end, compression, length, content, crc != 0)


def _decompress(data: bytes, compression: str, size: int) -> bytes:
    """Return at most size + 1 bytes, in memory that grows with what really comes out."""
    if not compression:
        return data
    pieces, total = [], 0
    try:
        if compression == 'zstd':
            # A frame may claim a window far larger than its content.
            decompressor = zstandard.ZstdDecompressor(max_window_size=2 * LARGEST)
            stream = decompressor.stream_reader(BytesIO(data), read_across_frames=True)
        else:
            stream = lz4.frame.LZ4FrameFile(BytesIO(data))
        while total <= size and (piece := stream.read(min(_AT_ONCE, size + 1 - total))):
            pieces.append(piece)
            total += len(piece)
    except (zstandard.ZstdError, RuntimeError, EOFError, OSError, MemoryError) as error:
        raise ValueError(f'the chunk cannot be decompressed: {error}') from error
    return b''.join(pieces)
