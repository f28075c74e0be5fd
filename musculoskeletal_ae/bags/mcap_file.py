# SPDX-License-Identifier: Apache-2.0
"""Reads mcap files with the library mcap, with limits on size and disorder."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import parse_qos

from musculoskeletal_ae.bags.storage import (
    CONVERT,
    LATEST,
    LONGEST_DISORDER,
    LONGEST_PAUSE,
    BagMessage,
    BagTopic,
    absolute,
    add_topic,
    open_file,
    reading,
    topic_problem,
)
from musculoskeletal_ae.exceptions import BagError

#: recognise an mcap file by these bytes at its start, and a complete file also by those at its end
MAGIC = b'\x89MCAP0\r\n'
LARGEST_RECORD = 64 << 20  # refuse a larger record or decompressed chunk [bytes]
#: Refuse a file that decompresses to more than MOST_EXPANDED bytes plus LARGEST_EXPANSION times its
#: size. A malicious file of a few kB could otherwise take hours to read.
MOST_EXPANDED, LARGEST_EXPANSION = 8 << 20, 100

#: remedy if log times go back
_JUMP = 'record again without `replay --loop`, a second publisher of /clock, or other jumps of time'
_LONGEST_QOS = 10_000  # ignore QoS profiles with more characters of YAML than this


class _Span(NamedTuple):
    """Log times and topics of a chunk; the reader decompresses only chunks that it needs."""

    start: int  # earliest log time [ns]
    end: int  # latest log time [ns]
    topics: frozenset[str]

    def has_any(self, topics: Collection[str], start: int, stop: int) -> bool:
        """Return whether the chunk may have messages of these topics from start to stop [ns]."""
        return self.start <= stop and self.end >= start and not self.topics.isdisjoint(topics)


class McapFile:
    """Reads an mcap file, up to the last complete record if its recorder was killed."""

    def __init__(self, path: Path) -> None:
        """Read the whole file and verify its checksums.

        Raises:
            BagError: If the file is damaged, or if its messages are too far out of order to be
                sorted: by more than 1 s within a topic, or by more than 10 s between topics.
        """
        self.path = path
        self.topics: dict[str, BagTopic] = {}
        self.start, self.end = LATEST, 0
        self.unfinished = ''
        self.has_checksums = True
        self._channels: dict[int, BagTopic] = {}
        self._chunks: list[_Span] = []
        self._size = path.stat().st_size
        self._expanded = 0  # bytes of decompressed chunks so far
        self._complete = 0  # position at which the last complete record ends [bytes]
        self._newest: dict[str, int] = {}  # latest log time so far [ns], by topic
        with reading(path), open_file(path) as file:
            self._survey(_ExactStream(file))

    def messages(
        self, topics: Collection[str], start: int = 0, stop: int = LATEST
    ) -> Iterator[BagMessage]:
        """Yield messages of these topics from start to stop [ns], both included."""
        chunks = iter(self._chunks)
        with reading(self.path), open_file(self.path) as file:
            stream = _ExactStream(file)
            for record in _record_reader(stream, validate_crcs=False).records:
                if isinstance(record, DataEnd):
                    return
                if isinstance(record, Chunk) and not next(chunks).has_any(topics, start, stop):
                    contents = []
                else:
                    contents = _contents(record)
                for message in contents:
                    if isinstance(message, Message):
                        topic = self._channels[message.channel_id].name
                        time = message.log_time
                        if topic in topics and start <= time <= stop:
                            yield BagMessage(
                                topic, time, message.publish_time, message.data, self.path
                            )
                if stream.position >= self._complete:
                    return

    def _survey(self, stream: _ExactStream) -> None:
        """Find topics, times and the last complete record; check sizes, order and checksums."""
        records = _record_reader(stream, validate_crcs=True).records
        schemas: dict[int, Schema] = {}
        statistics = None
        in_data = True  # false in the summary, which repeats schemas and channels
        while True:
            try:
                record = next(records)
            except StopIteration:
                break
            except EndOfFile:
                self._note_truncation()
                return
            if isinstance(record, Statistics):
                statistics = record
            elif isinstance(record, DataEnd):
                in_data = False
                self.has_checksums |= record.data_section_crc != 0
            elif in_data:
                self._survey_record(record, schemas)
            self._complete = stream.position
        count = sum(topic.message_count for topic in self.topics.values())
        if statistics is not None and statistics.message_count != count:
            raise ValueError(
                f'its summary counts {statistics.message_count} messages, but it contains {count}'
            )

    def _note_truncation(self) -> None:
        """Set `unfinished` to a text which says that the file ends within a record.

        Raises:
            ValueError: If the file contains no complete record, or if it was closed properly: the
                stated length of a record must then be wrong.
        """
        if self._complete == 0:
            raise ValueError('it ends within its first record')
        with open_file(self.path) as file:
            file.seek(-len(MAGIC), 2)
            if file.read() == MAGIC:  # the file is not truncated, so a stated length is wrong
                raise ValueError('a record reaches beyond the end of the file')
        self.unfinished = (
            f'{self.path.name} ends within a record at byte {self._size}; '
            f'the data after byte {self._complete} are lost'
        )

    def _survey_record(self, record: McapRecord, schemas: dict[int, Schema]) -> None:
        if isinstance(record, Chunk):
            self._expanded += record.uncompressed_size
            most = MOST_EXPANDED + LARGEST_EXPANSION * self._size
            if self._expanded > most:
                problem = f'its {self._size} bytes decompress to more than {most} bytes'
                raise ValueError(f'{problem}, the largest legal size')
            self.has_checksums &= record.uncompressed_crc != 0
        elif isinstance(record, Message):
            self.has_checksums = False
        messages = []
        for inner in _contents(record):
            if isinstance(inner, Schema):
                schemas[inner.id] = inner
            elif isinstance(inner, Channel):
                self._add_channel(inner, schemas)
            elif isinstance(inner, Message):
                self._survey_message(inner)
                messages.append(inner)
        if isinstance(record, Chunk):
            times = [message.log_time for message in messages]
            topics = frozenset(self._channels[message.channel_id].name for message in messages)
            self._chunks.append(_Span(min(times, default=LATEST), max(times, default=0), topics))

    def _add_channel(self, channel: Channel, schemas: dict[int, Schema]) -> None:
        schema = schemas[channel.schema_id] if channel.schema_id else Schema(0, b'', '', '')
        topic = BagTopic(
            absolute(channel.topic),
            schema.name,
            _qos(channel.metadata.get('offered_qos_profiles', '')),
            channel.message_encoding,
            schema,
        )
        topic.problem = topic_problem(topic, channel.metadata.get('topic_type_hash', ''))
        topic = add_topic(self.topics, topic, self.path)
        if self._channels.setdefault(channel.id, topic) is not topic:
            raise ValueError(f'channel {channel.id} is declared for two topics')

    def _survey_message(self, message: Message) -> None:
        topic = self._channels[message.channel_id]
        topic.message_count += 1
        time = message.log_time
        if max(time, message.publish_time) > LATEST:
            largest = max(time, message.publish_time)
            raise ValueError(f'a message has the time {largest} ns; legal: at most {LATEST} ns')
        newest = self._newest[topic.name] = max(self._newest.get(topic.name, 0), time)
        self.start, self.end = min(self.start, time), max(self.end, time)
        if newest - time > LONGEST_DISORDER:
            problem = (
                f'the log times of {topic.name} go back by {(newest - time) / 1e9:.3g} s; '
                f'legal: at most {LONGEST_DISORDER / 1e9:g} s'
            )
            raise BagError(self.path, problem, _JUMP)
        if self.end - time > LONGEST_PAUSE:
            problem = (
                f'a message is {(self.end - time) / 1e9:.3g} s older than the newest before it; '
                f'legal: at most {LONGEST_PAUSE / 1e9:g} s'
            )
            raise BagError(self.path, problem, CONVERT)


class _ExactStream:
    """A stream whose `read` returns exactly the requested bytes or raises EndOfFile."""

    def __init__(self, stream: BinaryIO) -> None:
        self.position = 0
        self._stream = stream

    def read(self, size: int) -> bytes:
        if size < 0:
            raise ValueError('the lengths in a record are inconsistent')
        data = self._stream.read(size)
        self.position += len(data)
        if len(data) < size:
            raise EndOfFile
        return data


def _record_reader(stream: Any, validate_crcs: bool) -> StreamReader:
    return StreamReader(
        stream, emit_chunks=True, validate_crcs=validate_crcs, record_size_limit=LARGEST_RECORD
    )


def _contents(record: McapRecord) -> list[McapRecord]:
    """Return the records that a chunk contains; return any other record alone, in a list."""
    if not isinstance(record, Chunk):
        return [record]
    # The library would decompress any amount, but `_decompress` stops at the stated size.
    data = _decompress(record)
    if len(data) != record.uncompressed_size:
        size = record.uncompressed_size
        raise ValueError(f'a chunk does not decompress to {size} bytes, the size that it states')
    return breakup_chunk(replace(record, compression='', data=data), validate_crc=True)


def _decompress(chunk: Chunk) -> bytes:
    size = chunk.uncompressed_size
    if size > LARGEST_RECORD:
        raise ValueError(f'a chunk has {size} bytes uncompressed; legal: at most {LARGEST_RECORD}')
    if chunk.compression == 'zstd':
        decompressor = zstandard.ZstdDecompressor(max_window_size=2 * LARGEST_RECORD)
        return decompressor.stream_reader(chunk.data, read_across_frames=True).read(size + 1)
    if chunk.compression == 'lz4':
        data: bytes = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        return data
    if chunk.compression:
        raise ValueError(f'compression {chunk.compression[:40]!r} is neither zstd nor lz4')
    return chunk.data


def _qos(text: str) -> list[Qos]:
    """Return the offered QoS profiles in a channel's metadata, [] if they cannot be read."""
    if len(text) > _LONGEST_QOS:
        return []
    try:
        return list(_parse_qos(text))
    except Exception:  # noqa: BLE001 - the library raises many types; profiles are only a hint
        return []


@lru_cache(maxsize=64)  # most topics have equal profiles, and the library parses them slowly
def _parse_qos(text: str) -> tuple[Qos, ...]:
    return tuple(parse_qos(text))
