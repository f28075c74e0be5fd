# SPDX-License-Identifier: Apache-2.0
"""Read sqlite3 files of rosbag2 with the library rosbags.

A recorder that was killed leaves its last messages in the write-ahead log of sqlite (`-wal`), or a
journal that undoes an incomplete change (`-journal`). The library reads the file alone. In this
case, sqlite applies the log to a private copy, which is read instead; the recording stays as it is.
"""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

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
from musculoskeletal_ae.exceptions import BagError

MAGIC = b'SQLite format 3\0'  # first bytes of a file
_LOGS = '-wal', '-journal'  # ends of the names of sqlite's logs of changes
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
            BagError: If the file is damaged, or has a log of changes and cannot be copied.
        """
        self.path = self._read = path
        self.topics: dict[str, BagTopic] = {}
        self.start, self.end = LATEST, 0
        self.unfinished = ''
        if logs := [log for log in map(self._log, _LOGS) if log.exists() and log.stat().st_size]:
            names = ' and '.join(log.name for log in logs)
            self.unfinished = f'{path.name} was not closed; {names} was read as well'
            self._apply(logs)
        with reading(path), Reader(self._read) as reader:
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

    def _log(self, end: str) -> Path:
        return self.path.with_name(f'{self.path.name}{end}')

    def _apply(self, logs: list[Path]) -> None:
        """Let sqlite apply its logs to a copy of the file, and read this copy from now on."""
        try:
            self._copy = TemporaryDirectory(prefix='musculoskeletal_ae-')
            for file in (self.path, *logs):
                shutil.copyfile(file, Path(self._copy.name) / file.name)
        except OSError as error:
            size = sum(file.stat().st_size for file in (self.path, *logs)) / 1e6
            problem = f'cannot be copied to {gettempdir()}, to apply {logs[0].name}'
            remedy = f'set TMPDIR to a folder with {size:.0f} MB of free space'
            raise BagError(self.path, f'{problem}: {error.strerror}', remedy) from error
        self._read = Path(self._copy.name) / self.path.name
        with reading(self.path), closing(sqlite3.connect(self._read)) as connection:
            connection.execute('PRAGMA journal_mode=DELETE')  # moves the log into the file

    def _check_integrity(self) -> None:
        address = f'{self._read.absolute().as_uri()}?mode=ro&immutable=1'
        with closing(sqlite3.connect(address, uri=True)) as connection:
            ((result,),) = connection.execute('PRAGMA integrity_check(1)')
        if result != 'ok':
            raise ValueError(result)

    def messages(
        self, topics: Collection[str], start: int = 0, stop: int = LATEST
    ) -> Iterator[BagMessage]:
        """Yield messages of these topics from start to stop [ns], both included."""
        with reading(self.path), Reader(self._read) as reader:
            wanted = [c for c in reader.connections if absolute(c.topic) in topics]
            if not wanted:
                return
            for connection, time, data in reader.messages(wanted):
                if not isinstance(time, int) or not isinstance(data, bytes) or time < 0:
                    raise ValueError('a row in its table of messages is not a valid message')
                if start <= time <= stop:
                    yield BagMessage(absolute(connection.topic), time, 0, data, self.path)
