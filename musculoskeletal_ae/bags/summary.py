# SPDX-License-Identifier: Apache-2.0
"""The end of an mcap file: its summary compared with what was really read, footer and magic."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from pathlib import Path

from mcap import records as mcap
from mcap.opcode import Opcode

from musculoskeletal_ae.bags.channels import Channels
from musculoskeletal_ae.bags.chunk import Chunk
from musculoskeletal_ae.bags.records import DAMAGED, MAGIC, Records, parse
from musculoskeletal_ae.exceptions import BagError

_FOOTER = struct.Struct('<QQI')

# Where a chunk is and what its index must say: offset, length, start, end, compression, sizes.
_Place = tuple[int, int, int, int, str, int, int]


class Summary:
    """Collects what is read from the data and compares it with what the summary says.

    Attributes:
        attachments: Attachments read.
        metadata: Metadata records read.
    """

    def __init__(self, path: Path, channels: Channels, counts: Counter[int]) -> None:
        """Compare the summary of `path` with topics and counts that are still being read."""
        self._path, self._channels, self._counts = path, channels, counts
        self._chunks: list[_Place] = []
        self.attachments = self.metadata = 0

    def add_chunk(self, offset: int, length: int, chunk: Chunk) -> None:
        """Take note of a chunk that was read."""
        self._chunks.append(
            (
                offset,
                length,
                chunk.start,
                chunk.end,
                chunk.compression,
                chunk.compressed_size,
                len(chunk.content),
            )
        )

    def read(self, records: Records) -> bool:
        """Read from the end of the data to the end of the file.

        Returns:
            Whether there were statistics to compare with.

        Raises:
            Cut: If the file ends early.
            BagError: If anything does not fit.
        """
        begin, records.crc = records.offset, 0
        first_offset = 0
        statistics: mcap.Statistics | None = None
        indexed: list[_Place] = []
        while True:
            record = records.head()
            content = records.content(record)
            try:
                if record.opcode == Opcode.FOOTER:
                    crc = zlib.crc32(b'\x02' + struct.pack('<Q', len(content)), records.crc_before)
                    self._footer(content, begin, record.offset, first_offset, crc)
                    self._compare(statistics, indexed)
                    break
                if record.opcode == Opcode.SCHEMA:
                    self._channels.add_schema(content)
                elif record.opcode == Opcode.CHANNEL:
                    self._channels.add_channel(content)
                elif record.opcode == Opcode.STATISTICS:
                    if statistics:
                        raise ValueError('there are two statistics')
                    statistics = parse(mcap.Statistics, content)
                elif record.opcode == Opcode.CHUNK_INDEX:
                    indexed.append(_place(parse(mcap.ChunkIndex, content)))
                elif record.opcode == Opcode.ATTACHMENT_INDEX:
                    parse(mcap.AttachmentIndex, content)
                elif record.opcode == Opcode.METADATA_INDEX:
                    parse(mcap.MetadataIndex, content)
                elif record.opcode == Opcode.SUMMARY_OFFSET:
                    parse(mcap.SummaryOffset, content)
                    first_offset = first_offset or record.offset
                else:
                    raise ValueError(f'record {record.opcode:#04x} does not belong in the summary')
            except ValueError as error:
                raise self._damaged(record.offset, str(error)) from error
        if records.take(len(MAGIC), record.offset) != MAGIC:
            raise self._damaged(
                records.offset - len(MAGIC), 'the file does not end as mcap files do'
            )
        if records.offset != records.size:
            problem = f'{records.size - records.offset} bytes after the end'
            raise self._damaged(records.offset, problem)
        return statistics is not None

    def _footer(self, content: bytes, begin: int, end: int, first_offset: int, crc: int) -> None:
        if len(content) != _FOOTER.size:
            raise ValueError('the footer has a wrong length')
        summary_start, offset_start, claimed = _FOOTER.unpack(content)
        # Some writers point to an empty summary, some do not.
        legal = {begin} if end > begin else {0, begin}
        if summary_start not in legal or offset_start not in {first_offset, 0, end}:
            raise ValueError('the footer points to where the summary is not')
        if claimed not in (0, zlib.crc32(content[:16], crc)):
            raise ValueError('the checksum of the summary does not fit')

    def _compare(self, statistics: mcap.Statistics | None, indexed: list[_Place]) -> None:
        if indexed and sorted(indexed) != self._chunks:
            raise ValueError(f'{len(indexed)} chunk indexes do not fit {len(self._chunks)} chunks')
        if statistics is None:
            return
        recorded = {
            'messages': (statistics.message_count, self._counts.total()),
            'channels': (statistics.channel_count, len(self._channels.by_id)),
            'schemas': (statistics.schema_count, self._channels.schema_count),
            'chunks': (statistics.chunk_count, len(self._chunks)),
            'attachments': (statistics.attachment_count, self.attachments),
            'metadata records': (statistics.metadata_count, self.metadata),
        }
        for what, (said, read) in recorded.items():
            if said != read:
                raise ValueError(f'the summary counts {said} {what}, {read} were read')
        said_counts = {key: n for key, n in statistics.channel_message_counts.items() if n}
        if said_counts and said_counts != dict(self._counts):
            raise ValueError('the summary counts other messages by topic than were read')

    def _damaged(self, offset: int, problem: str) -> BagError:
        return BagError(self._path, offset, problem, DAMAGED)


def _place(index: mcap.ChunkIndex) -> _Place:
    return (
        index.chunk_start_offset,
        index.chunk_length,
        index.message_start_time,
        index.message_end_time,
        index.compression,
        index.compressed_size,
        index.uncompressed_size,
    )
