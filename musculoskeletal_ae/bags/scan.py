# SPDX-License-Identifier: Apache-2.0
"""One mcap file read from end to end, chunk by chunk: whether it is whole, and where things are.

Nothing is used before this has passed: framing, checksums, definitions, the indexes and the
summary are compared with the messages that are really there.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from mcap import records as mcap
from mcap.opcode import Opcode

from musculoskeletal_ae.bags.channels import Channels
from musculoskeletal_ae.bags.chunk import read_chunk
from musculoskeletal_ae.bags.records import DAMAGED, MAGIC, Cut, Record, Records, parse, split
from musculoskeletal_ae.bags.summary import Summary
from musculoskeletal_ae.exceptions import BagError

MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, sequence, log time, publish time
_INDEX_HEAD = struct.Struct('<HI')
_INDEX_ENTRY = struct.Struct('<QQ')
_LATEST = (1 << 63) - 1  # ROS time is signed
_CDR = (b'\x00\x01', b'\x00\x00')
_LONGEST_RUN = 1 << 20


class Block(NamedTuple):
    """A piece of the file that is read at once: a chunk, or a run of messages outside of chunks.

    Attributes:
        offset: Where its first record begins.
        length: From there to the end of the last one.
        start: Earliest log time [ns].
        end: Latest log time [ns].
        channels: Those it has messages of.
        chunk: Whether it is a chunk.
    """

    offset: int
    length: int
    start: int
    end: int
    channels: frozenset[int]
    chunk: bool


@dataclass
class Scan:
    """What was found in one file.

    Attributes:
        path: The file.
        channels: Its topics.
        counts: Messages by channel.
        blocks: Where the messages are.
        cut: Where the last, incomplete record begins; None in a file that was ended properly.
        summarised: Whether the counts were compared with the file's own statistics.
    """

    path: Path
    channels: Channels = field(default_factory=Channels)
    counts: Counter[int] = field(default_factory=Counter)
    blocks: list[Block] = field(default_factory=list)
    cut: int | None = None
    summarised: bool = False


# (log time, offset) of each channel's messages in one chunk.
_Index = dict[int, list[tuple[int, int]]]


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
        self._found = Scan(records.path)
        self._summary = Summary(records.path, self._found.channels, self._found.counts)
        self._index: _Index = {}
        self._run: list[int] = []  # offset and length of the run of messages that is being read

    def run(self) -> Scan:
        records, path = self._records, self._records.path
        if records.size == 0:
            raise BagError(path, 0, 'the file is empty', 'nothing was recorded: record again')
        try:
            if records.take(len(MAGIC), 0) != MAGIC:
                raise BagError(path, 0, 'this is no mcap file', 'name a bag directory or a .mcap')
            self._data()
            self._end()
        except Cut as cut:
            self._close_run()
            with path.open('rb') as file:
                file.seek(max(0, records.size - len(MAGIC)))
                if file.read() == MAGIC and records.size > len(MAGIC):
                    problem = 'a record reaches beyond the end of the file'
                    raise BagError(path, cut.offset, problem, DAMAGED) from None
            self._found.cut = cut.offset
        return self._found

    def _data(self) -> None:
        header = self._records.head()
        if header.opcode != Opcode.HEADER:
            raise self._damaged(header, 'the file does not begin with a header')
        profile = self._parse(mcap.Header, header).profile
        if profile not in ('ros2', ''):
            raise self._damaged(header, f'profile {profile[:40]!r} is not ros2')
        while True:
            record = self._records.head()
            if record.opcode != Opcode.MESSAGE:
                self._close_run()
            if record.opcode == Opcode.DATA_END:
                crc = self._records.crc_before
                claimed = self._parse(mcap.DataEnd, record).data_section_crc
                if claimed not in (0, crc):
                    raise self._damaged(record, 'the checksum of all data before does not fit')
                return
            self._take(record)

    def _take(self, record: Record) -> None:
        if record.opcode == Opcode.ATTACHMENT:
            self._summary.attachments += 1
            self._records.skip(record)
            return
        content = self._records.content(record)
        try:
            if record.opcode == Opcode.CHUNK:
                self._chunk(record, content)
            elif record.opcode == Opcode.MESSAGE:
                self._message_outside(record, content)
            elif record.opcode == Opcode.MESSAGE_INDEX:
                self._message_index(content)
            elif record.opcode == Opcode.SCHEMA:
                self._found.channels.add_schema(content)
            elif record.opcode == Opcode.CHANNEL:
                self._found.channels.add_channel(content)
            elif record.opcode == Opcode.METADATA:
                parse(mcap.Metadata, content)
                self._summary.metadata += 1
            else:
                raise ValueError(f'record {record.opcode:#04x} does not belong here')
        except ValueError as error:
            raise self._damaged(record, str(error)) from error

    def _chunk(self, record: Record, content: bytes) -> None:
        chunk = read_chunk(content)
        self._index = {}
        for opcode, position, begin, end in split(chunk.content):
            if opcode == Opcode.MESSAGE:
                channel, time = self._message(chunk.content, begin, end)
                self._index.setdefault(channel, []).append((time, position))
            elif opcode == Opcode.SCHEMA:
                self._found.channels.add_schema(chunk.content[begin:end])
            elif opcode == Opcode.CHANNEL:
                self._found.channels.add_channel(chunk.content[begin:end])
            else:
                raise ValueError(f'record {opcode:#04x} does not belong in a chunk')
        times = [time for entries in self._index.values() for time, _ in entries]
        if times and (min(times), max(times)) != (chunk.start, chunk.end):
            raise ValueError('the times of the chunk are not those of its messages')
        length = self._records.offset - record.offset
        self._summary.add_chunk(record.offset, length, chunk)
        if times:
            self._found.blocks.append(
                Block(
                    record.offset, length, chunk.start, chunk.end, frozenset(self._index), True
                )
            )

    def _message(self, data: bytes, begin: int, end: int) -> tuple[int, int]:
        payload = begin + MESSAGE_HEAD.size
        if end < payload:
            raise ValueError('a message is shorter than its head')
        channel, _, time, published = MESSAGE_HEAD.unpack_from(data, begin)
        if channel not in self._found.channels.by_id:
            raise ValueError(f'a message of channel {channel}, which is not there')
        if time > _LATEST or published > _LATEST:
            raise ValueError('a message has a time beyond all ROS times')
        if data[payload : payload + 2] not in _CDR and not self._found.channels.by_id[channel].refused:
            raise ValueError('a message is not in CDR')
        self._found.counts[channel] += 1
        return channel, time

    def _message_outside(self, record: Record, content: bytes) -> None:
        channel, time = self._message(content, 0, len(content))
        if self._run and record.offset - self._run[0] > _LONGEST_RUN:
            self._close_run()
        if not self._run:
            self._run, self._index = [record.offset, 0], {}
        self._run[1] = self._records.offset - self._run[0]
        self._index.setdefault(channel, []).append((time, record.offset))

    def _close_run(self) -> None:
        if self._run:
            times = [time for entries in self._index.values() for time, _ in entries]
            self._found.blocks.append(
                Block(*self._run, min(times), max(times), frozenset(self._index), False)
            )
            self._run, self._index = [], {}

    def _message_index(self, content: bytes) -> None:
        channel, length = _INDEX_HEAD.unpack_from(content) if len(content) >= 6 else (0, -1)
        if length != len(content) - _INDEX_HEAD.size or length % _INDEX_ENTRY.size:
            raise ValueError('a message index has a wrong length')
        entries = sorted(_INDEX_ENTRY.iter_unpack(content[_INDEX_HEAD.size :]))
        if entries != sorted(self._index.get(channel, [])):
            raise ValueError('a message index does not fit the chunk before it')

    def _end(self) -> None:
        self._found.summarised = self._summary.read(self._records)

    def _parse(self, kind: type, record: Record) -> mcap.McapRecord:
        try:
            return parse(kind, self._records.content(record))
        except ValueError as error:
            raise self._damaged(record, str(error)) from error

    def _damaged(self, record: Record, problem: str) -> BagError:
        return BagError(self._records.path, record.offset, problem, DAMAGED)
