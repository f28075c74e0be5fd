# SPDX-License-Identifier: Apache-2.0
"""One mcap file read from end to end, before anything in it is used (https://mcap.dev/spec).

The library parses the records. What it takes as it comes is refused here: records that are cut, do
not belong or whose lengths do not fit, checksums that differ, chunks that decompress to more than
they say, topics of other types than they say, and messages in other numbers than the file counts.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

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
LATEST = (1 << 63) - 1  # [ns]; ROS time is signed
DAMAGED = 'the file is damaged: use a copy or another recording'
NO_SCHEMA = mcap.Schema(id=0, name='', encoding='', data=b'')  # of a channel that names none

_MAGIC = b'\x89MCAP0\r\n'
_HEAD = struct.Struct('<BQ')  # of a record: opcode and length
_ANYWHERE = frozenset(Opcode)
_IN_CHUNK = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE})
_LONGEST_RUN = 1 << 20  # [bytes]
CDR = 'cdr'  # the encoding of ROS 2
_CDR_HEADS = (b'\x00\x01', b'\x00\x00')
_NAME = re.compile(r'/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*', re.ASCII)
_LONGEST_NAME = 256


@dataclass
class BagTopic:
    """A topic of a bag."""

    name: str  # absolute, as recorded
    type: str
    qos: str  # offered profiles, YAML as rosbag2 writes it
    refused: str  # why its messages cannot be used, '' if they can
    encoding: str  # of its messages
    schema: mcap.Schema  # the recorded definition, to be copied and never used
    message_count: int = 0


class BagMessage(NamedTuple):
    """A message as it was recorded."""

    topic: str  # absolute name
    log_time: int  # when it was received [ns]
    publish_time: int  # when it was sent [ns]
    data: bytes  # serialized
    file: Path  # the mcap file it is from
    offset: int  # where in the file its chunk begins


@dataclass
class Block:
    """A piece of the file that is read at once: a chunk, or a run of messages outside of chunks."""

    offset: int  # where it begins
    stop: int  # where it ends
    start: int  # earliest log time [ns]
    end: int  # latest log time [ns]
    topics: set[str]


@dataclass
class McapFile:
    """What is in one file."""

    path: Path
    size: int  # [bytes]
    ended: bool  # whether it was, properly
    end: int = len(_MAGIC)  # of the last complete record
    channels: dict[int, BagTopic] = field(default_factory=dict)  # by channel number
    blocks: list[Block] = field(default_factory=list)  # where the messages are
    backward: int = 0  # messages with an earlier log time than the one before them
    set_back: int = 0  # [ns] how far the log times of one topic went back at most
    checked: bool = True  # whether checksums cover all messages
    summarised: bool = False  # whether the messages were compared with the file's own count
    _newest: dict[str, int] = field(default_factory=dict)  # log time so far [ns], by topic

    @classmethod
    def read(cls, path: Path) -> McapFile:
        """Read a file from end to end, or raise a BagError that says where it is damaged."""
        with open_regular(path, _unreadable) as stream:
            size, magic = os.fstat(stream.fileno()).st_size, len(_MAGIC)
            if size == 0:
                raise BagError(path, 'the file is empty', 'nothing was recorded: record again', 0)
            if stream.read(magic) != _MAGIC:
                raise BagError(path, 'this is no mcap file', 'name a bag directory or a .mcap', 0)
            ended = os.pread(stream.fileno(), magic, max(size - magic, magic)) == _MAGIC
            file = cls(path, size, ended)
            try:
                file._scan(stream)
            # The library lets many kinds of errors out of bytes that are no records.
            except Exception as error:
                raise BagError(path, str(error), DAMAGED, file.end) from error
        return file

    def messages(self, block: Block) -> Iterator[BagMessage]:
        """Yield the messages of a block in their order; a BagError says that it has changed."""
        try:
            with open_regular(self.path, _unreadable) as stream:
                stream.seek(block.offset)
                data = stream.read(block.stop - block.offset)
            if len(data) != block.stop - block.offset:
                raise EOFError('it has become shorter')
            for record in _records_in(data, _ANYWHERE):
                for m in _contents(record):
                    if isinstance(m, mcap.Message):
                        name, times = self.channels[m.channel_id].name, (m.log_time, m.publish_time)
                        yield BagMessage(name, *times, m.data, self.path, block.offset)
        except Exception as error:
            raise BagError(self.path, f'has changed: {error}', DAMAGED, block.offset) from error

    def _scan(self, stream: BinaryIO) -> None:
        schemas, channels = {0: NO_SCHEMA}, dict[int, mcap.Channel]()
        statistics = footer = None
        crc, latest, size = zlib.crc32(_MAGIC), 0, self.size - self.ended * len(_MAGIC)
        for end, data, record in _records(stream, self.end, size, _ANYWHERE):
            if self.end == len(_MAGIC) and not isinstance(record, mcap.Header):
                raise ValueError('the file does not begin with a header')
            match record:
                case mcap.Header() if record.profile not in ('ros2', ''):
                    raise ValueError(f'profile {record.profile[:40]!r} is not ros2')
                case mcap.Chunk():
                    # A checksum of 0 says that the recorder computed none.
                    self.checked &= record.uncompressed_crc != 0
                case mcap.Message():
                    self.checked = False
                case mcap.DataEnd() if record.data_section_crc not in (0, crc):
                    raise ValueError('the checksum of the data does not fit')
                case mcap.DataEnd():
                    self.checked |= record.data_section_crc != 0
                case mcap.Statistics():
                    statistics = record
                case mcap.Footer():
                    footer = record
                    if footer.summary_crc not in (0, zlib.crc32(data[:-4], crc)):
                        raise ValueError('the checksum of the summary does not fit')
            # One checksum is of all before DataEnd, the other one of what is after it.
            crc = 0 if isinstance(record, mcap.DataEnd) else zlib.crc32(data, crc)
            for inner in _contents(record):
                match inner:
                    case mcap.Message():
                        self._add(inner, end, chunk=inner is not record)
                        self.backward += inner.log_time < latest
                        latest = inner.log_time
                    case mcap.Schema() if schemas.setdefault(inner.id, inner) != inner:
                        raise ValueError(f'schema {inner.id} is given twice and differs')
                    case mcap.Channel() if channels.setdefault(inner.id, inner) != inner:
                        raise ValueError(f'channel {inner.id} is given twice and differs')
                    case mcap.Channel() if inner.id not in self.channels:
                        self.channels[inner.id] = _topic(inner, schemas)
            self.end = end
        if footer and size - self.end >= (1 if self.ended else len(_MAGIC)):
            raise ValueError(f'{size - self.end} bytes after the end')
        if self.ended and not footer:
            raise ValueError('a record reaches beyond the end')
        if self.ended and statistics:
            read = Counter({number: topic.message_count for number, topic in self.channels.items()})
            said = statistics.channel_message_counts
            differ = [number for number, count in said.items() if count != read[number]]
            if statistics.message_count != read.total() or differ:
                problem = f'counts {statistics.message_count} messages, {read.total()} were read'
                raise ValueError(f'the summary {problem}; channels that differ: {differ[:20]}')
            self.summarised = True

    def _add(self, message: mcap.Message, end: int, chunk: bool) -> None:
        """Take note of a message in the record that ends at `end`."""
        topic = self.channels.get(message.channel_id)
        if topic is None:
            raise ValueError(f'a message of channel {message.channel_id}, which is not there')
        if max(message.log_time, message.publish_time) > LATEST:
            raise ValueError('a message has a time beyond all ROS times')
        if not topic.refused and message.data[:2] not in _CDR_HEADS:
            raise ValueError('a message is not in CDR')
        topic.message_count += 1
        time, last = message.log_time, self.blocks[-1] if self.blocks else None
        newest = self._newest[topic.name] = max(self._newest.get(topic.name, 0), time)
        self.set_back = max(self.set_back, newest - time)
        if last and (
            self.end == last.offset
            if chunk
            else self.end == last.stop and end - last.offset <= _LONGEST_RUN
        ):
            last.stop, last.start, last.end = end, min(last.start, time), max(last.end, time)
            last.topics.add(topic.name)
        else:
            self.blocks.append(Block(self.end, end, time, time, {topic.name}))


class _Record(BytesIO):
    """Gives the library exactly the bytes it asks for, or an error."""

    def read(self, count: int | None = -1) -> bytes:
        data = super().read(count)
        if len(data) != count:
            raise ValueError('the lengths in a record do not fit')
        return data


def _records(
    stream: BinaryIO, begin: int, size: int, legal: Collection[int]
) -> Iterator[tuple[int, bytes, mcap.McapRecord]]:
    """Yield (end, bytes, record) up to the footer, or to a record that reaches beyond the end."""
    opcode = 0
    while opcode != Opcode.FOOTER and begin + _HEAD.size <= size:
        head = stream.read(_HEAD.size)
        opcode, length = _HEAD.unpack(head)
        begin += _HEAD.size + length
        if opcode not in legal:
            raise ValueError(f'record {opcode:#04x} does not belong here')
        if length > LARGEST:
            raise ValueError(f'a record claims {length} bytes, which exceeds the limit {LARGEST}')
        if begin > size:
            return
        data = head + stream.read(length)
        reader = StreamReader(_Record(data), skip_magic=True, emit_chunks=True)
        yield begin, data, next(reader.records)


def _records_in(data: bytes, legal: Collection[int]) -> Iterator[mcap.McapRecord]:
    stop = 0
    for end, _, record in _records(BytesIO(data), 0, len(data), legal):
        stop = end
        yield record
    if stop != len(data):
        raise ValueError('a record reaches beyond the end')


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
    yield from _records_in(data, _IN_CHUNK)


def _topic(channel: mcap.Channel, schemas: dict[int, mcap.Schema]) -> BagTopic:
    """Return the topic of a channel, its definition compared with the known type."""
    name = channel.topic
    if len(name) > _LONGEST_NAME or not _NAME.fullmatch(name):
        raise ValueError(f'{name[:60]!r} is not the name of a topic')
    schema = schemas.get(channel.schema_id)
    if schema is None:
        raise ValueError(f'topic {name} has schema {channel.schema_id}, which is not there')
    refused = ''
    if channel.message_encoding != CDR:
        refused = f'is encoded as {channel.message_encoding[:40]!r}, not cdr'
    elif not message_types.known(schema.name):
        refused = f'has the type {schema.name[:80]!r}, which is none of ROS 2 Jazzy'
    else:
        type_hash = channel.metadata.get('topic_type_hash', '')
        lie = message_types.contradiction(schema.name, schema.encoding, schema.data, type_hash)
        if lie:  # as of another distribution of ROS
            refused = f'has a definition of {schema.name} that {lie}'
    qos = channel.metadata.get('offered_qos_profiles', '')
    encoding = channel.message_encoding
    return BagTopic(f'/{name.lstrip("/")}', schema.name, qos, refused, encoding, schema)


def _unreadable(file: Path, problem: str) -> BagError:
    return BagError(file, problem, 'name another bag directory or .mcap')
