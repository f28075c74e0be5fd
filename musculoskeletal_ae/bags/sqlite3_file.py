# SPDX-License-Identifier: Apache-2.0
"""Read sqlite3 files of rosbag2 with the library rosbags."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path

from mcap.records import Schema
from rosbags.interfaces import ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2 import Reader

from musculoskeletal_ae.bags.message_types import MSG
from musculoskeletal_ae.bags.storage import (
    LATEST,
    BagMessage,
    BagTopic,
    absolute,
    add_topic,
    reading,
    topic_problem,
)

MAGIC = b'SQLite format 3\0'  # first bytes of a file
_DEFINITION_ENCODINGS = {
    MessageDefinitionFormat.NONE: '',
    MessageDefinitionFormat.MSG: MSG,
    MessageDefinitionFormat.IDL: 'ros2idl',
}


class Sqlite3File:
    """A sqlite3 file of rosbag2, a format without checksums."""

    has_checksums = False

    def __init__(self, path: Path) -> None:
        """Read and check the whole file.

        Raises:
            BagError: If the file is damaged.
        """
        self.path = path
        self.topics: dict[str, BagTopic] = {}
        self.start, self.end = LATEST, 0
        self.unfinished = ''
        for journal in ('-wal', '-journal'):
            file = path.with_name(f'{path.name}{journal}')
            if file.exists() and file.stat().st_size:
                self.unfinished = f'{path.name} was not closed: {file.name} is not read'
        with reading(path), Reader(path) as reader:
            self._check_integrity()
            for connection in reader.connections:
                assert isinstance(connection.ext, ConnectionExtRosbag2)
                definition = connection.msgdef
                encoding = _DEFINITION_ENCODINGS[definition.format]
                topic = BagTopic(
                    absolute(connection.topic),
                    connection.msgtype,
                    connection.ext.offered_qos_profiles,
                    connection.ext.serialization_format,
                    Schema(0, definition.data.encode(), encoding, connection.msgtype),
                    message_count=connection.msgcount,
                )
                topic.problem = topic_problem(topic, connection.digest)
                add_topic(self.topics, topic, path)
        for message in self.messages(self.topics):
            self.start = min(self.start, message.log_time)
            self.end = max(self.end, message.log_time)

    def _check_integrity(self) -> None:
        address = f'{self.path.absolute().as_uri()}?mode=ro&immutable=1'
        with closing(sqlite3.connect(address, uri=True)) as connection:
            ((result,),) = connection.execute('PRAGMA integrity_check(1)')
        if result != 'ok':
            raise ValueError(result)

    def messages(
        self, topics: Collection[str], start: int = 0, stop: int = LATEST
    ) -> Iterator[BagMessage]:
        """Yield messages of these topics from start to stop [ns], both included."""
        with reading(self.path), Reader(self.path) as reader:
            wanted = [c for c in reader.connections if absolute(c.topic) in topics]
            if not wanted:
                return
            for connection, time, data in reader.messages(wanted):
                if not isinstance(time, int) or not isinstance(data, bytes) or time < 0:
                    raise ValueError('a row in its table of messages is not a valid message')
                if start <= time <= stop:
                    yield BagMessage(absolute(connection.topic), time, 0, data, self.path)
