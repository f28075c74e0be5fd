# SPDX-License-Identifier: Apache-2.0
"""The records of an mcap file one after another, never reading what the file cannot hold.

An mcap file is: magic, records, magic. A record is one byte of opcode, eight bytes of length and
as many bytes of content. (https://mcap.dev/spec)
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from musculoskeletal_ae.exceptions import BagError

MAGIC = b'\x89MCAP0\r\n'
# No record, and no chunk once decompressed, is larger: what a damaged file can ask for is bounded.
LARGEST = 64 << 20  # [bytes]
DAMAGED = 'the file is damaged: use a copy or another recording'

_HEAD = struct.Struct('<BQ')
_SKIPPED_AT_ONCE = 1 << 20


class Cut(Exception):  # noqa: N818
    """The file ends before the record that begins at `offset` does."""

    def __init__(self, offset: int) -> None:
        super().__init__(offset)
        self.offset = offset


class Record(NamedTuple):
    """Head of a record: where it begins and how many bytes of content follow."""

    opcode: int
    offset: int
    length: int


class Records:
    """Reads one file from its beginning, and keeps the CRC-32 of what has been read.

    Attributes:
        path: The file.
        size: Its length when it was opened [bytes].
        offset: How far it has been read.
        crc: CRC-32 of what was read since the file's beginning or since it was set to 0.
        crc_before: The same up to the head of the current record.
    """

    def __init__(self, file: BinaryIO, path: Path) -> None:
        """Read `file`, which is open at its beginning."""
        self.path, self._file = path, file
        self.size = path.stat().st_size
        self.offset = self.crc = self.crc_before = 0

    def take(self, count: int, begin: int) -> bytes:
        """Return exactly `count` bytes of the record that begins at `begin`."""
        if count > self.size - self.offset:
            raise Cut(begin)
        data = self._file.read(count)
        if len(data) != count:
            raise Cut(begin)
        self.offset += count
        self.crc = zlib.crc32(data, self.crc)
        return data

    def head(self) -> Record:
        """Read the head of the next record.

        Raises:
            Cut: If the file ends before the record does.
            BagError: If the record claims to be larger than any is.
        """
        begin, self.crc_before = self.offset, self.crc
        opcode, length = _HEAD.unpack(self.take(_HEAD.size, begin))
        if length > LARGEST and opcode != Opcode.ATTACHMENT:
            raise BagError(
                self.path, begin, f'a record claims {length} bytes, at most {LARGEST}', DAMAGED
            )
        if length > self.size - self.offset:
            raise Cut(begin)
        return Record(opcode, begin, length)

    def content(self, record: Record) -> bytes:
        """Read the content of the record whose head was read last."""
        return self.take(record.length, record.offset)

    def skip(self, record: Record) -> None:
        """Pass over the content of the record whose head was read last."""
        end = self.offset + record.length
        while self.offset < end:
            self.take(min(_SKIPPED_AT_ONCE, end - self.offset), record.offset)


def split(data: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Yield (opcode, begin, begin of content, end) of the records in a chunk's content.

    Raises:
        ValueError: If a record reaches beyond the end.
    """
    position, end = 0, len(data)
    while position < end:
        if end - position < _HEAD.size:
            raise ValueError(f'{end - position} bytes too many at byte {position} of the chunk')
        opcode, length = _HEAD.unpack_from(data, position)
        begin = position + _HEAD.size
        if length > end - begin:
            raise ValueError(f'a record at byte {position} of the chunk claims {length} bytes')
        yield opcode, position, begin, begin + length
        position = begin + length


def parse(kind: type, content: bytes) -> Any:
    """Return a record of one of mcap's classes.

    The library takes short strings and surplus bytes as they come; what was read is therefore
    written again and must be the same bytes.

    Raises:
        ValueError: If the content is not such a record.
    """
    try:
        record = kind.read(ReadDataStream(BytesIO(content)))  # type: ignore[attr-defined]
        builder = RecordBuilder()
        record.write(builder)
    except (McapError, struct.error, ValueError, OverflowError) as error:
        raise ValueError(f'not a {kind.__name__} record: {error}') from error
    if builder.end()[_HEAD.size :] != content:
        raise ValueError(f'not a {kind.__name__} record: its lengths do not fit')
    return record
