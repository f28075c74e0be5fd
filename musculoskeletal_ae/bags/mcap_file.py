# SPDX-License-Identifier: Apache-2.0
"""One mcap file read from end to end, before anything in it is used (https://mcap.dev/spec).

The library reads the records and compares checksums. What it takes as it comes is refused here:
records that are cut, do not belong or whose lengths do not fit, chunks that decompress to more than
they say, topics of other types than they say, and messages in other numbers than the file counts.
"""

from __future__ import annotations

import os
import re
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap import records as mcap
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader

from musculoskeletal_ae.bags import message_types
from musculoskeletal_ae.exceptions import BagError
from musculoskeletal_ae.files import open_regular

# No record, and no chunk once decompressed, is larger: what a damaged file can ask for is bounded.
LARGEST = 64 << 20  # [bytes]
DAMAGED = 'the file is damaged: use a copy or another recording'

_MAGIC = b'\x89MCAP0\r\n'
_HEAD = 9  # [bytes] of a record: opcode and length
_ANYWHERE = frozenset(Opcode)
_IN_CHUNK = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE})
_LONGEST_RUN = 1 << 20  # [bytes]
_LATEST = (1 << 63) - 1  # [ns]; ROS time is signed
_CDR = (b'\x00\x01', b'\x00\x00')
_NAME = re.compile(r'/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*', re.ASCII)
_LONGEST_NAME = 256


@dataclass
class BagTopic:
    """A topic of a bag."""

    name: str  # absolute, as recorded
    type: str
    qos: str  # offered profiles, YAML as rosbag2 writes it
    refused: str  # why its messages cannot be used, '' if they can
    schema: mcap.Schema  # the recorded definition, to be copied and never used
    message_count: int = 0


@dataclass
class Block:
    """A piece of the file that is read at once: a chunk, or a run of messages outside of chunks."""

    offset: int  # where it begins
    stop: int  # where it ends
    start: int  # earliest log time [ns]
    end: int  # latest log time [ns]
    topics: set[str]
    chunk: bool


@dataclass
class McapFile:
    """What is in one file.

    Attributes:
        path: The file.
        size: Its length [bytes].
        channels: Its topics by channel number.
        blocks: Where the messages are.
        backward: How many messages have an earlier log time than the one before them.
        cut: Where the incomplete last record begins; None in a file that was ended properly.
        checked: Whether checksums cover all messages.
        summarised: Whether the messages were compared with the file's own count.
    """

    path: Path
    size: int
    channels: dict[int, BagTopic] = field(default_factory=dict)
    blocks: list[Block] = field(default_factory=list)
    backward: int = 0
    cut: int | None = None
    checked: bool = True
    summarised: bool = False

    @classmethod
    def read(cls, path: Path) -> McapFile:
        """Read a file from end to end.

        Raises:
            BagError: If it is damaged. That it was not ended is no error here: see `cut`.
        """
        with open_regular(path, _unreadable) as stream:
            file = cls(path, os.fstat(stream.fileno()).st_size)
            if file.size == 0:
                raise BagError(path, 0, 'the file is empty', 'nothing was recorded: record again')
            if stream.read(len(_MAGIC)) != _MAGIC:
                raise BagError(path, 0, 'this is no mcap file', 'name a bag directory or a .mcap')
            stream.seek(-len(_MAGIC), os.SEEK_END)
            ended = file.size > len(_MAGIC) and stream.read() == _MAGIC
            stream.seek(0)
            source = _Source(stream, file.size, _ANYWHERE)
            try:
                file._scan(source)
            # The library lets many kinds of errors out of bytes that are no records.
            except Exception as error:
                if ended or not isinstance(error, EOFError) or not source.exhausted:
                    raise BagError(path, source.begin, str(error), DAMAGED) from error
                file.cut = source.begin
        return file

    def messages(self, block: Block) -> Iterator[tuple[str, mcap.Message]]:
        """Yield (topic, message) of a block in the order they have in it.

        Raises:
            BagError: If the file has changed.
        """
        try:
            with open_regular(self.path, _unreadable) as stream:
                stream.seek(block.offset)
                data = stream.read(block.stop - block.offset)
            if len(data) != block.stop - block.offset:
                raise EOFError('it has become shorter')
            for record in _records(data, _ANYWHERE):
                for inner in _contents(record):
                    if isinstance(inner, mcap.Message):
                        yield self.channels[inner.channel_id].name, inner
        except Exception as error:
            raise BagError(self.path, block.offset, f'has changed: {error}', DAMAGED) from error

    def _scan(self, source: _Source) -> None:
        schemas: dict[int, mcap.Schema] = {}
        channels: dict[int, mcap.Channel] = {}
        statistics: mcap.Statistics | None = None
        latest = 0
        for record in _reader(source, validate_crcs=True, record_size_limit=LARGEST).records:
            if source.begin == len(_MAGIC) and not isinstance(record, mcap.Header):
                raise ValueError('the file does not begin with a header')
            match record:
                case mcap.Header() if record.profile not in ('ros2', ''):
                    raise ValueError(f'profile {record.profile[:40]!r} is not ros2')
                case mcap.Chunk():
                    # A checksum of 0 says that the recorder computed none.
                    self.checked &= record.uncompressed_crc != 0
                case mcap.Message():
                    self.checked = False
                case mcap.DataEnd():
                    self.checked |= record.data_section_crc != 0
                    source.crc = 0
                case mcap.Statistics():
                    statistics = record
                case mcap.Footer() if record.summary_crc not in (0, source.crc_before):
                    raise ValueError('the checksum of the summary does not fit')
            for inner in _contents(record):
                match inner:
                    case mcap.Message():
                        self._add(inner, source, isinstance(record, mcap.Chunk))
                        self.backward += inner.log_time < latest
                        latest = inner.log_time
                    case mcap.Schema():
                        if inner.id == 0 or schemas.setdefault(inner.id, inner) != inner:
                            raise ValueError(f'schema {inner.id} is given twice and differs')
                    case mcap.Channel():
                        if channels.setdefault(inner.id, inner) != inner:
                            raise ValueError(f'channel {inner.id} is given twice and differs')
                        if inner.id not in self.channels:
                            self.channels[inner.id] = _topic(inner, schemas)
        if source.offset != source.size:
            raise ValueError(f'{source.size - source.offset} bytes after the end')
        if statistics is not None:
            total = sum(topic.message_count for topic in self.channels.values())
            if statistics.message_count != total:
                counted = statistics.message_count
                raise ValueError(f'the summary counts {counted} messages, {total} were read')
            for number, counted in statistics.channel_message_counts.items():
                topic = self.channels.get(number)
                if counted != (topic.message_count if topic else 0):
                    raise ValueError(f'channel {number} has not the {counted} messages it says')
            self.summarised = True

    def _add(self, message: mcap.Message, source: _Source, chunk: bool) -> None:
        """Take note of a message in the record that the source has just read."""
        topic = self.channels.get(message.channel_id)
        if topic is None:
            raise ValueError(f'a message of channel {message.channel_id}, which is not there')
        if max(message.log_time, message.publish_time) > _LATEST:
            raise ValueError('a message has a time beyond all ROS times')
        if not topic.refused and message.data[:2] not in _CDR:
            raise ValueError('a message is not in CDR')
        topic.message_count += 1
        time, begin, stop = message.log_time, source.begin, source.offset
        last = self.blocks[-1] if self.blocks else None
        if last and (
            begin == last.offset
            if chunk
            else not last.chunk and begin == last.stop and stop - last.offset <= _LONGEST_RUN
        ):
            last.stop = stop
            last.start, last.end = min(last.start, time), max(last.end, time)
            last.topics.add(topic.name)
        else:
            self.blocks.append(Block(begin, stop, time, time, {topic.name}, chunk))


class _Source:
    """What the library reads records from: exactly the bytes it asks for, or an error.

    Attributes:
        size: How many bytes there are.
        begin: Where the present record begins.
        offset: How far it has been read.
        crc: CRC-32 of what was read since it was set to 0; `crc_before`: without the last piece.
    """

    def __init__(self, stream: BinaryIO, size: int, legal: Collection[int]) -> None:
        """Read a stream of `size` bytes in which records of `legal` kinds belong."""
        self._stream, self.size, self._legal = stream, size, legal
        self.begin = self.offset = self._end = 0
        self.crc = self.crc_before = 0

    @property
    def exhausted(self) -> bool:
        """Whether the present record reaches beyond the end."""
        return self._end > self.size

    def read(self, count: int) -> bytes:
        """Return exactly `count` bytes of the present record, or of the next one after its end.

        Raises:
            EOFError: If there are not so many.
            ValueError: If the record has not so many, or does not belong here.
        """
        if self.offset == self._end:
            # One byte of opcode is read first; what is read as a whole is the magic.
            self.begin = self.offset
            self._end += _HEAD if count == 1 else count
        if self._end > self.size:
            raise EOFError('a record reaches beyond the end')
        if not 0 <= count <= self._end - self.offset:
            raise ValueError('the lengths in a record do not fit')
        data = self._stream.read(count)
        if len(data) != count:
            raise EOFError('the file has become shorter')
        self.offset += count
        self.crc_before, self.crc = self.crc, zlib.crc32(data, self.crc)
        if self.offset == self.begin + 1 and data[0] not in self._legal:
            raise ValueError(f'record {data[0]:#04x} does not belong here')
        if self.offset == self.begin + _HEAD:
            self._end = self.offset + int.from_bytes(data, 'little')
            if self._end == self.offset:
                raise ValueError('the lengths in a record do not fit: it is empty')
        return data


def _reader(source: _Source, **options: Any) -> StreamReader:
    # It calls nothing but `read`.
    return StreamReader(source, emit_chunks=True, **options)  # type: ignore[arg-type]


def _records(data: bytes, legal: Collection[int]) -> Iterator[mcap.McapRecord]:
    """Yield the records in a piece of a file or in the content of a chunk."""
    source = _Source(BytesIO(data), len(data), legal)
    records = _reader(source, skip_magic=True).records
    while source.offset < source.size:
        yield next(records)


def _contents(record: mcap.McapRecord) -> Iterator[mcap.McapRecord]:
    """Yield the records in a chunk; a record that is no chunk comes as it is."""
    if not isinstance(record, mcap.Chunk):
        yield record
        return
    size, data = record.uncompressed_size, record.data
    if size > LARGEST:
        raise ValueError(f'the chunk claims {size} bytes when decompressed, at most {LARGEST}')
    # No more is decompressed than is claimed, whatever the compressed data says.
    if record.compression == 'zstd':
        zstd = zstandard.ZstdDecompressor(max_window_size=2 * LARGEST)
        data = zstd.stream_reader(data, read_across_frames=True).read(size + 1)
    elif record.compression == 'lz4':
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    elif record.compression:
        raise ValueError(f'compression {record.compression[:40]!r} is none of zstd, lz4')
    if len(data) != size:
        raise ValueError(f'the chunk does not have the {size} bytes it claims when decompressed')
    if record.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError('the checksum of the chunk does not fit')
    yield from _records(data, _IN_CHUNK)


def _topic(channel: mcap.Channel, schemas: dict[int, mcap.Schema]) -> BagTopic:
    """Return the topic of a channel, its definition compared with the known type."""
    name = channel.topic
    if len(name) > _LONGEST_NAME or not _NAME.fullmatch(name):
        raise ValueError(f'{name[:60]!r} is not the name of a topic')
    schema = schemas.get(channel.schema_id, mcap.Schema(id=0, name='', encoding='', data=b''))
    if schema.id != channel.schema_id:
        raise ValueError(f'topic {name} has schema {channel.schema_id}, which is not there')
    refused = ''
    if channel.message_encoding != 'cdr':
        refused = f'is encoded as {channel.message_encoding[:40]!r}, not cdr'
    elif not message_types.known(schema.name):
        refused = f'has the type {schema.name[:80]!r}, which is none of ROS 2 Jazzy'
    else:
        type_hash = channel.metadata.get('topic_type_hash', '')
        lie = message_types.contradiction(schema.name, schema.encoding, schema.data, type_hash)
        if lie:
            raise ValueError(f'the definition of {schema.name}, type of topic {name}, {lie}')
    qos = channel.metadata.get('offered_qos_profiles', '')
    return BagTopic(f'/{name.lstrip("/")}', schema.name, qos, refused, schema)


def _unreadable(file: Path, problem: str) -> BagError:
    return BagError(file, None, problem, 'choose another file')
