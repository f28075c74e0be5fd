# SPDX-License-Identifier: Apache-2.0
"""Messages of the blocks of one or more mcap files by time, holding as few blocks as that needs."""

from __future__ import annotations

import heapq
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode

from musculoskeletal_ae.bags.blocks import MESSAGE_HEAD, Block
from musculoskeletal_ae.bags.chunk import read_chunk
from musculoskeletal_ae.bags.records import DAMAGED, split
from musculoskeletal_ae.bags.scan import Scan
from musculoskeletal_ae.exceptions import BagError

# Decompressed blocks that may be held at once to bring messages into order.
_MOST_PENDING = 256 << 20  # [bytes]
_RECORD_HEAD = 9


class BagMessage(NamedTuple):
    """A message as it was recorded.

    Attributes:
        topic: Absolute name.
        log_time: When it was received [ns].
        publish_time: When it was sent [ns].
        data: Serialized.
        file: The mcap file it is from.
        offset: Where in the file its chunk begins.
    """

    topic: str
    log_time: int
    publish_time: int
    data: bytes
    file: Path
    offset: int


class _Source(NamedTuple):
    """A block that has messages to be read; sorts by its earliest one, then as in the files."""

    start: int
    number: int
    path: Path
    block: Block
    topics: dict[int, str]


class _Open(NamedTuple):
    """A block that is being read; sorts by its next message, then as in the files."""

    log_time: int
    number: int
    message: BagMessage
    rest: Iterator[BagMessage]
    size: int


def in_order(
    scans: Collection[Scan], topics: Collection[str], start: int, stop: int
) -> Iterator[BagMessage]:
    """Yield the messages of these topics with start <= log time <= stop [ns], by log time.

    Equal times keep the order of the files.

    Raises:
        BagError: If a file has changed, or is so far out of order that memory would not do.
    """
    sources = sorted(_sources(scans, topics, start, stop), reverse=True)
    heap: list[_Open] = []
    pending = 0
    while sources or heap:
        while sources and (not heap or sources[-1].start <= heap[0].log_time):
            source = sources.pop()
            messages, size = _read(source, start, stop)
            rest = iter(messages)
            if first := next(rest, None):
                heapq.heappush(heap, _Open(first.log_time, source.number, first, rest, size))
                pending += size
            if pending > _MOST_PENDING:
                problem = f'messages are out of order by more than {_MOST_PENDING >> 20} MiB'
                raise BagError(source.path, source.block.offset, problem, 'sort the file first')
        if not heap:
            continue
        _, number, message, rest, size = heap[0]
        yield message
        if following := next(rest, None):
            heapq.heapreplace(heap, _Open(following.log_time, number, following, rest, size))
        else:
            heapq.heappop(heap)
            pending -= size


def _sources(
    scans: Collection[Scan], topics: Collection[str], start: int, stop: int
) -> Iterator[_Source]:
    number = 0
    for found in scans:
        names = {
            key: channel.topic
            for key, channel in found.channels.by_id.items()
            if channel.topic in topics
        }
        for block in found.blocks:
            number += 1
            overlaps = block.start <= stop and block.end >= start
            if overlaps and not block.channels.isdisjoint(names):
                yield _Source(block.start, number, found.path, block, names)


def _read(source: _Source, start: int, stop: int) -> tuple[list[BagMessage], int]:
    """Return the wanted messages of a block, and the memory [bytes] they come in."""
    path, block = source.path, source.block
    found = []
    try:
        with path.open('rb') as file:
            file.seek(block.offset)
            content = file.read(block.length)
        if len(content) != block.length:
            raise ValueError('the file has become shorter while it was read')
        if block.chunk:
            content = read_chunk(content[_RECORD_HEAD:]).content
        for opcode, _, begin, end in split(content):
            if opcode != Opcode.MESSAGE:
                continue
            channel, _, log_time, published = MESSAGE_HEAD.unpack_from(content, begin)
            if channel in source.topics and start <= log_time <= stop:
                data = content[begin + MESSAGE_HEAD.size : end]
                topic = source.topics[channel]
                found.append(BagMessage(topic, log_time, published, data, path, block.offset))
    except (OSError, ValueError, struct.error) as error:
        raise BagError(path, block.offset, str(error), DAMAGED) from error
    found.sort(key=lambda message: message.log_time)
    return found, len(content)
