# SPDX-License-Identifier: Apache-2.0
"""What an mcap file says of its topics: schemas and channels, checked against the known types."""

from __future__ import annotations

import re
from typing import NamedTuple

from mcap import records as mcap

from musculoskeletal_ae.bags import definitions
from musculoskeletal_ae.bags.records import parse

_NAME = re.compile(r'/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*', re.ASCII)
_LONGEST_NAME = 256


class Channel(NamedTuple):
    """A topic as one channel of the file has it.

    Attributes:
        topic: Absolute name.
        type: Message type.
        qos: Offered QoS profiles, YAML as rosbag2 writes it.
        refused: Why its messages cannot be used, '' if they can.
        schema: The recorded definition, to be copied and never used.
    """

    topic: str
    type: str
    qos: str
    refused: str
    schema: mcap.Schema


class Channels:
    """Schemas and channels of one file by their numbers."""

    def __init__(self) -> None:
        """Begin without any."""
        self._schemas: dict[int, mcap.Schema] = {}
        self._channels: dict[int, mcap.Channel] = {}
        self.by_id: dict[int, Channel] = {}

    @property
    def schema_count(self) -> int:
        """Number of schemas."""
        return len(self._schemas)

    def add_schema(self, content: bytes) -> None:
        """Take a schema record; one that repeats an earlier one must be the same.

        Raises:
            ValueError: If it is damaged or contradicts an earlier one.
        """
        schema = parse(mcap.Schema, content)
        if schema.id == 0:
            raise ValueError('a schema has number 0, which means none')
        if self._schemas.setdefault(schema.id, schema) != schema:
            raise ValueError(f'schema {schema.id} is given twice and differs')

    def add_channel(self, content: bytes) -> None:
        """Take a channel record; one that repeats an earlier one must be the same.

        Raises:
            ValueError: If it is damaged, contradicts an earlier one or what ROS 2 Jazzy defines.
        """
        channel = parse(mcap.Channel, content)
        if channel.id in self._channels:
            if self._channels[channel.id] != channel:
                raise ValueError(f'channel {channel.id} is given twice and differs')
            return
        topic, type_hash = channel.topic, channel.metadata.get('topic_type_hash', '')
        if len(topic) > _LONGEST_NAME or not _NAME.fullmatch(topic):
            raise ValueError(f'{topic[:60]!r} is not the name of a topic')
        schema = self._schemas.get(channel.schema_id)
        if schema is None and channel.schema_id:
            raise ValueError(f'topic {topic} has schema {channel.schema_id}, which is not there')
        schema = schema or mcap.Schema(id=0, name='', encoding='', data=b'')
        if channel.message_encoding != 'cdr':
            refused = f'is encoded as {channel.message_encoding[:40]!r}, not cdr'
        elif not definitions.known(schema.name):
            refused = f'has the type {schema.name[:80]!r}, which is none of ROS 2 Jazzy'
        else:
            refused = ''
            lie = definitions.contradiction(schema.name, schema.encoding, schema.data, type_hash)
            if lie:
                raise ValueError(f'the definition of {schema.name}, type of topic {topic}, {lie}')
        self._channels[channel.id] = channel
        qos = channel.metadata.get('offered_qos_profiles', '')
        self.by_id[channel.id] = Channel(f'/{topic.lstrip("/")}', schema.name, qos, refused, schema)
