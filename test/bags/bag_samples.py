# SPDX-License-Identifier: Apache-2.0
"""Small bags in every format that the reader supports."""

import random
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from musculoskeletal_ae.bags import message_types
from musculoskeletal_ae.bags.metadata import offered_qos
from musculoskeletal_ae.bags.topics import DIAGNOSTICS, TOPICS, interface_name
from musculoskeletal_ae.bags.writer import BagWriter

START = 1_800_000_000_000_000_000  # time of the first message [ns]
PERIOD = 10_000_000  # time between two messages [ns]


class Sample(NamedTuple):
    """A message to write: absolute topic, type, times [ns], serialized data."""

    topic: str
    type: str
    log_time: int
    publish_time: int
    data: bytes


def encode(message: object, type_name: str) -> bytes:
    """Return a message as serialized bytes."""
    return bytes(message_types.TYPESTORE.serialize_cdr(message, type_name))


def message_class(type_name: str) -> Any:
    """Return the class of a message type; ROS is not required."""
    return message_types.TYPESTORE.types[type_name]


def filled(type_name: str, rng: random.Random) -> Any:
    """Return a message of a type with a random value in every field."""
    fields = message_types.TYPESTORE.fielddefs[type_name][1]
    return message_class(type_name)(
        **{
            field: _value(node, rng)
            for field, node in fields
            if field != 'structure_needs_at_least_one_member'
        }
    )


def _value(node: Any, rng: random.Random) -> Any:
    kind, detail = node
    if kind == Nodetype.BASE:
        return _basic(detail[0], rng)
    if kind == Nodetype.NAME:
        return filled(detail, rng)
    (inner, inner_detail), count = detail
    count = count if kind == Nodetype.ARRAY else rng.randrange(4)
    values = [_value((inner, inner_detail), rng) for _ in range(count)]
    if inner != Nodetype.BASE or inner_detail[0] == 'string':
        return values
    name = {'bool': 'bool', 'byte': 'uint8', 'char': 'uint8'}.get(inner_detail[0], inner_detail[0])
    return np.array(values, dtype=name)


def _basic(name: str, rng: random.Random) -> Any:
    if name == 'string':
        return ''.join(rng.choices('abc µθ_/', k=rng.randrange(12)))
    if name == 'bool':
        return rng.random() < 0.5
    return rng.uniform(-1.0, 1.0) if name.startswith('float') else rng.randrange(100)


def samples(count: int, namespace: str = '', seed: int = 0) -> list[Sample]:
    """Return `count` messages in the order of time, on one topic of the interface after another."""
    rng = random.Random(seed)
    content = []
    for i, name in zip(range(count), list(TOPICS) * (count // len(TOPICS) + 1), strict=False):
        data = encode(filled(TOPICS[name].type, rng), TOPICS[name].type)
        topic = name if name == DIAGNOSTICS else f'{namespace}/{name}'
        time = START + i * PERIOD
        content.append(Sample(topic, TOPICS[name].type, time, time - rng.randrange(100_000), data))
    return content


def write_ours(
    path: Path, content: list[Sample], compression: str = 'zstd', finish: bool = True
) -> None:
    """Write a bag with the writer of this package, in chunks of ten messages.

    Without `finish`, the bag stays incomplete, as after the recorder was killed by SIGKILL.
    """
    writer = BagWriter(path, compression)
    for i, sample in enumerate(content):
        if sample.topic not in writer.topics:
            topic = TOPICS.get(interface_name(sample.topic))
            latched = topic is not None and topic.latched
            writer.add_topic(sample.topic, sample.type, [offered_qos(latched)])
        writer.write(sample.topic, *sample[2:])
        if i % 10 == 9:
            writer.flush()
    if finish:
        writer.close()
    else:
        writer.flush()


def write_mcap(
    path: Path, content: list[Sample], with_definitions: bool = True, **options: Any
) -> None:
    """Write a single file with the mcap library, as recorders of other projects do."""
    with path.open('wb') as file:
        writer = Writer(file, **({'chunk_size': 2000, 'enable_data_crcs': True} | options))
        writer.start(profile='ros2')
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for topic, kind, log_time, publish_time, data in content:
            if kind not in schemas:
                text = message_types.definition(kind).encode() if with_definitions else b''
                encoding = message_types.MSG if with_definitions else ''
                schemas[kind] = writer.register_schema(kind, encoding, text)
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, 'cdr', schemas[kind])
            writer.add_message(channels[topic], log_time, data, publish_time)
        writer.finish()


def write_rosbags(
    path: Path, content: list[Sample], storage: StoragePlugin = StoragePlugin.MCAP
) -> None:
    """Write a bag directory with the rosbags library, which computes no checksums."""
    with RosbagsWriter(path, version=9, storage_plugin=storage) as writer:
        connections: dict[str, Any] = {}
        for topic, kind, log_time, _, data in content:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, kind, typestore=message_types.TYPESTORE
                )
            writer.write(connections[topic], log_time, data)


BARE: dict[str, dict[str, Any]] = {
    'zstd chunks': {},
    'lz4 chunks': {'compression': CompressionType.LZ4},
    'no chunks': {'use_chunking': False},
    'no summary': {
        'index_types': IndexType.NONE,
        'repeat_channels': False,
        'repeat_schemas': False,
        'use_statistics': False,
        'use_summary_offsets': False,
    },
}
