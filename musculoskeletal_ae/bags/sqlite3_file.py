# SPDX-License-Identifier: Apache-2.0
"""Reads sqlite3 files of rosbag2 with the library rosbags.

A recorder that was killed leaves a write-ahead log (`-wal`) with its last messages, or a journal
(`-journal`) that undoes an incomplete change. The library ignores both. If one exists, this module
lets sqlite apply it to a private copy, and reads the copy. The recording is not modified.
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
    DAMAGED,
    LATEST,
    BagMessage,
    BagTopic,
    absolute,
    add_topic,
    open_file,
    reading,
    topic_problem,
)
from musculoskeletal_ae.exceptions import BagError

MAGIC = b'SQLite format 3\0'  # recognise a sqlite3 file by its first bytes
#: remedy for a damaged file
RECOVER = f'{DAMAGED}, or save what can be read with `record --recover BAG`'
MESSAGES = 'messages'  # name of the table that contains the messages
MOST_ROWS = 1 << 40  # end the search for the next readable row after this many ids
_ROWS = 'SELECT id, topic_id, timestamp, data FROM messages WHERE id >= ? ORDER BY id'
_INSERT = 'INSERT INTO messages (id, topic_id, timestamp, data) VALUES (?, ?, ?, ?)'
_LOGS = '-wal', '-journal'  # recognise sqlite's logs of changes by these ends of their names
_DEFINITION_ENCODINGS = {
    MessageDefinitionFormat.NONE: '',
    MessageDefinitionFormat.MSG: MSG,
    MessageDefinitionFormat.IDL: 'ros2idl',
}


class Sqlite3File:
    """Reads a sqlite3 file of rosbag2, a format without checksums."""

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
        if logs := logs_of(path):
            names = ' and '.join(log.name for log in logs)
            self.unfinished = f'{path.name} was not closed; {names} was read as well'
            self._apply(logs)
        with reading(path, RECOVER), Reader(self._read) as reader:
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

    def _apply(self, logs: list[Path]) -> None:
        """Let sqlite apply its logs to a copy of the file, and read this copy from now on."""
        try:
            self._copy = TemporaryDirectory(prefix='musculoskeletal_ae-')
            for file in (self.path, *logs):
                shutil.copyfile(file, Path(self._copy.name) / file.name)
        except OSError as error:
            size = sum(file.stat().st_size for file in (self.path, *logs)) / 1e6
            problem = f'cannot be copied to {gettempdir()} in order to apply {logs[0].name}'
            remedy = f'set TMPDIR to a folder with {size:.0f} MB of free space'
            raise BagError(self.path, f'{problem}: {error.strerror}', remedy) from error
        self._read = Path(self._copy.name) / self.path.name
        with reading(self.path), closing(sqlite3.connect(self._read)) as connection:
            connection.execute('PRAGMA journal_mode=DELETE')  # moves the log into the file

    def _check_integrity(self) -> None:
        with _read_only(self._read) as connection:
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


def is_damaged(path: Path) -> bool:
    """Return whether a file begins like a sqlite3 file, but cannot be read as a whole."""
    with open_file(path) as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            return False
    try:
        Sqlite3File(path)
    except BagError:
        return True
    return False


def logs_of(path: Path) -> list[Path]:
    """Return sqlite's logs of changes that a killed recorder has left beside a file."""
    logs = (path.with_name(f'{path.name}{end}') for end in _LOGS)
    return [log for log in logs if log.exists() and log.stat().st_size]


def _read_only(path: Path) -> closing[sqlite3.Connection]:
    """Return a connection through which sqlite neither changes nor locks a file."""
    address = f'{path.absolute().as_uri()}?mode=ro&immutable=1'
    return closing(sqlite3.connect(address, uri=True))


def salvage(path: Path, target: Path) -> int:
    """Salvage a damaged file: copy all rows that sqlite can read to a new file.

    Rows are read in the order of their ids. After a row that cannot be read, the next readable id
    is found with steps that double, and then by bisection, because a damaged page contains
    successive ids. Rows whose values are not of the types of a message are left out. Damage within
    the data of a message cannot be noticed, because the format has no checksums.

    Args:
        path: The damaged file, which stays as it is.
        target: The new file.

    Returns:
        The number of copied messages.

    Raises:
        BagError: If the topics cannot be read.
    """
    with reading(path), _read_only(path) as damaged, closing(sqlite3.connect(target)) as copy:
        tables = damaged.execute(
            "SELECT name, sql FROM sqlite_master WHERE type = 'table' AND sql IS NOT NULL"
        ).fetchall()
        for name, definition in tables:
            copy.execute(definition)
            if name != MESSAGES:
                rows = damaged.execute(f'SELECT * FROM "{name}"').fetchall()  # noqa: S608
                for row in rows:
                    marks = ', '.join('?' * len(row))
                    copy.execute(f'INSERT INTO "{name}" VALUES ({marks})', row)  # noqa: S608
        count, place = 0, _next_readable(damaged, 1)
        while place is not None:
            try:
                for row in damaged.execute(_ROWS, (place,)):
                    if _is_message(row):
                        copy.execute(_INSERT, row)
                        count += 1
                    place = row[0] + 1
                break
            except sqlite3.DatabaseError:
                place = _next_readable(damaged, place + 1)
        copy.commit()
    return count


def _next_readable(connection: sqlite3.Connection, place: int) -> int | None:
    """Return the first id, at or after `place`, whose row can be read; None if none can."""
    if _is_readable(connection, place):
        return place
    step = 1
    while not _is_readable(connection, place + step):
        step *= 2
        if step > MOST_ROWS:
            return None
    low, high = place + step // 2, place + step
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if _is_readable(connection, middle) else (middle, high)
    return high


def _is_readable(connection: sqlite3.Connection, place: int) -> bool:
    """Return whether the first row with this or a larger id can be read; False without a row."""
    try:
        return connection.execute(f'{_ROWS} LIMIT 1', (place,)).fetchone() is not None
    except sqlite3.DatabaseError:
        return False


def _is_message(row: tuple[object, ...]) -> bool:
    types = (int, int, int, bytes)
    return len(row) == len(types) and all(map(isinstance, row, types))
