# SPDX-License-Identifier: Apache-2.0
"""Pieces of an mcap file that hold messages, and whether each message in them is sound."""

from __future__ import annotations

import struct
from collections import Counter
from typing import NamedTuple

from mcap.opcode import Opcode

from musculoskeletal_ae.bags.channels import Channels
from musculoskeletal_ae.bags.chunk import Chunk
from musculoskeletal_ae.bags.records import Record, split

MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, sequence, log time, publish time
_INDEX_HEAD = struct.Struct('<HI')
_INDEX_ENTRY = struct.Struct('<QQ')
_LATEST = (1 << 63) - 1  # ROS time is signed
_CDR = (b'\x00\x01', b'\x00\x00')
_LONGEST_RUN = 1 << 20  # [bytes]


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


class Blocks:
    """Collects the blocks of one file while it is read.

    Attributes:
        found: Blocks so far.
        counts: Messages by channel.
        backward: How many messages have an earlier log time than the one before them.
    """

    def __init__(self, channels: Channels) -> None:
        """Messages must be on these channels."""
        self._channels = channels
        self.found: list[Block] = []
        self.counts: Counter[int] = Counter()
        self.backward = 0
        self._last_time = 0
        # (log time, offset) of the messages of the last chunk or the present run, by channel.
        self._index: dict[int, list[tuple[int, int]]] = {}
        self._run_begin = self._run_end = 0

    def add_chunk(self, offset: int, length: int, chunk: Chunk) -> None:
        """Take a chunk; the schemas and channels in it are added to the file's.

        Raises:
            ValueError: If its content is not sound.
        """
        self.close_run()
        self._index = {}
        for opcode, position, begin, end in split(chunk.content):
            if opcode == Opcode.MESSAGE:
                self._message(chunk.content, begin, end, position)
            elif opcode == Opcode.SCHEMA:
                self._channels.add_schema(chunk.content[begin:end])
            elif opcode == Opcode.CHANNEL:
                self._channels.add_channel(chunk.content[begin:end])
            else:
                raise ValueError(f'record {opcode:#04x} does not belong in a chunk')
        if self._index:
            start, end = self._span()
            if (start, end) != (chunk.start, chunk.end):
                raise ValueError('the times of the chunk are not those of its messages')
            self.found.append(Block(offset, length, start, end, frozenset(self._index), True))

    def add_message(self, record: Record, content: bytes, end: int) -> None:
        """Take a message that is in no chunk; `end` is where its record ends in the file."""
        if self._run_end != record.offset or end - self._run_begin > _LONGEST_RUN:
            self.close_run()
            self._run_begin, self._index = record.offset, {}
        self._message(content, 0, len(content), record.offset)
        self._run_end = end

    def close_run(self) -> None:
        """End the run of messages outside of chunks, if there is one."""
        if self._run_end:
            length = self._run_end - self._run_begin
            channels = frozenset(self._index)
            self.found.append(Block(self._run_begin, length, *self._span(), channels, False))
            self._run_begin = self._run_end = 0
            self._index = {}

    def compare_index(self, content: bytes) -> None:
        """Compare a message index with the chunk before it.

        Raises:
            ValueError: If it does not fit.
        """
        whole = len(content) >= _INDEX_HEAD.size
        channel, length = _INDEX_HEAD.unpack_from(content) if whole else (0, -1)
        if length != len(content) - _INDEX_HEAD.size or length % _INDEX_ENTRY.size:
            raise ValueError('a message index has a wrong length')
        entries = sorted(_INDEX_ENTRY.iter_unpack(content[_INDEX_HEAD.size :]))
        if entries != sorted(self._index.get(channel, [])):
            raise ValueError('a message index does not fit the chunk before it')

    def _span(self) -> tuple[int, int]:
        times = [time for entries in self._index.values() for time, _ in entries]
        return min(times), max(times)

    def _message(self, data: bytes, begin: int, end: int, position: int) -> None:
        payload = begin + MESSAGE_HEAD.size
        if end < payload:
            raise ValueError('a message is shorter than its head')
        number, _, time, published = MESSAGE_HEAD.unpack_from(data, begin)
        channel = self._channels.by_id.get(number)
        if channel is None:
            raise ValueError(f'a message of channel {number}, which is not there')
        if time > _LATEST or published > _LATEST:
            raise ValueError('a message has a time beyond all ROS times')
        if not channel.refused and data[payload : min(payload + 2, end)] not in _CDR:
            raise ValueError('a message is not in CDR')
        self.counts[number] += 1
        self.backward += time < self._last_time
        self._last_time = time
        self._index.setdefault(number, []).append((time, position))
