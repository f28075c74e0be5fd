# SPDX-License-Identifier: Apache-2.0
"""One mcap file read from end to end, chunk by chunk: whether it is whole, and where things are.

Nothing is used before this has passed: framing, checksums, definitions, the indexes and the
summary are compared with the messages that are really there.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap import records as mcap
from mcap.opcode import Opcode

from musculoskeletal_ae.bags.blocks import Block, Blocks
from musculoskeletal_ae.bags.channels import Channels
from musculoskeletal_ae.bags.chunk import read_chunk
from musculoskeletal_ae.bags.records import DAMAGED, MAGIC, Cut, Record, Records, parse
from musculoskeletal_ae.bags.summary import Summary
from musculoskeletal_ae.exceptions import BagError


@dataclass(frozen=True)
class Scan:
    """What was found in one file.

    Attributes:
        path: The file.
        size: Its length [bytes].
        channels: Its topics.
        counts: Messages by channel.
        blocks: Where the messages are.
        backward: How many messages have an earlier log time than the one before them.
        cut: Where the incomplete last record begins; None in a file that was ended properly.
        checked: Whether checksums cover all messages.
        summarised: Whether the counts were compared with the file's own statistics.
    """

    path: Path
    size: int
    channels: Channels
    counts: Counter[int]
    blocks: list[Block]
    backward: int
    cut: int | None
    checked: bool
    summarised: bool


def scan(path: Path) -> Scan:
    """Read a file from end to end.

    Raises:
        BagError: If it is damaged. That it was not ended is no error here: see `Scan.cut`.
    """
    try:
        with path.open('rb') as file:
            return _Scanner(Records(file, path)).run()
    except OSError as error:
        reason = error.strerror or str(error)
        raise BagError(path, None, f'cannot be read: {reason}', 'choose another file') from error


class _Scanner:
    def __init__(self, records: Records) -> None:
        self._records = records
        self._channels = Channels()
        self._blocks = Blocks(self._channels)
        self._checked = True
        self._summary = Summary(records.path, self._channels, self._blocks.counts)

    def run(self) -> Scan:
        records, path = self._records, self._records.path
        if records.size == 0:
            raise BagError(path, 0, 'the file is empty', 'nothing was recorded: record again')
        if records.size < len(MAGIC) or records.take(len(MAGIC), 0) != MAGIC:
            raise BagError(path, 0, 'this is no mcap file', 'name a bag directory or a .mcap')
        cut, summarised = None, False
        try:
            self._data()
            summarised = self._summary.read(records)
        except Cut as early:
            cut = early.offset
            if self._ends_properly():
                problem = 'a record reaches beyond the end of the file'
                raise BagError(path, cut, problem, DAMAGED) from early
        self._blocks.close_run()
        return Scan(
            path,
            records.size,
            self._channels,
            self._blocks.counts,
            self._blocks.found,
            self._blocks.backward,
            cut,
            self._checked,
            summarised,
        )

    def _ends_properly(self) -> bool:
        """Say whether the file has the end of a complete one, so that a cut means damage."""
        with self._records.path.open('rb') as file:
            file.seek(self._records.size - len(MAGIC))
            return file.read() == MAGIC and self._records.size > len(MAGIC)

    def _data(self) -> None:
        header = self._records.head()
        if header.opcode != Opcode.HEADER:
            raise self._damaged(header, 'the file does not begin with a header')
        profile = self._parse(mcap.Header, header).profile
        if profile not in ('ros2', ''):
            raise self._damaged(header, f'profile {profile[:40]!r} is not ros2')
        while True:
            record = self._records.head()
            if record.opcode == Opcode.DATA_END:
                crc = self._records.crc_before
                claimed = self._parse(mcap.DataEnd, record).data_section_crc
                # A checksum of 0 says that the recorder computed none.
                if claimed not in (0, crc):
                    raise self._damaged(record, 'the checksum of all data before does not fit')
                self._checked |= claimed != 0
                return
            if record.opcode == Opcode.ATTACHMENT:
                self._summary.attachments += 1
                self._records.skip(record)
                continue
            content = self._records.content(record)
            try:
                self._take(record, content)
            except ValueError as error:
                raise self._damaged(record, str(error)) from error

    def _take(self, record: Record, content: bytes) -> None:
        if record.opcode == Opcode.CHUNK:
            chunk, length = read_chunk(content), self._records.offset - record.offset
            self._checked &= chunk.checked
            self._blocks.add_chunk(record.offset, length, chunk)
            self._summary.add_chunk(record.offset, length, chunk)
        elif record.opcode == Opcode.MESSAGE:
            self._checked = False
            self._blocks.add_message(record, content, self._records.offset)
        elif record.opcode == Opcode.MESSAGE_INDEX:
            self._blocks.compare_index(content)
        elif record.opcode == Opcode.SCHEMA:
            self._channels.add_schema(content)
        elif record.opcode == Opcode.CHANNEL:
            self._channels.add_channel(content)
        elif record.opcode == Opcode.METADATA:
            parse(mcap.Metadata, content)
            self._summary.metadata += 1
        else:
            raise ValueError(f'record {record.opcode:#04x} does not belong here')

    def _parse(self, kind: type, record: Record) -> Any:
        try:
            return parse(kind, self._records.content(record))
        except ValueError as error:
            raise self._damaged(record, str(error)) from error

    def _damaged(self, record: Record, problem: str) -> BagError:
        return BagError(self._records.path, record.offset, problem, DAMAGED)
