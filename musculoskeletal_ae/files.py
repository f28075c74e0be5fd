# SPDX-License-Identifier: Apache-2.0
"""Reading files that a user names, and writing files whole.

Only regular files are read, and no more of them than a limit. All functions that read take
`refuse`, which makes the error that they raise of a file and what is wrong with it.
"""

import csv
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import msgspec
import yaml

T = TypeVar('T')
Refuse = Callable[[Path, str], Exception]

LARGEST = 5_000_000  # [bytes] of a text
LARGEST_YAML = 1 << 19  # [bytes]; it is slow to read
LARGEST_CSV = 1 << 20  # [bytes]; each cell takes fifty
MOST_ENTRIES = 100_000  # in a YAML file, what aliases stand for included
DEEPEST = 50  # levels of a YAML file

_Loader = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)


def open_regular(file: Path, refuse: Refuse) -> BinaryIO:
    """Open a regular file for reading: a pipe would block, and a device may never end."""
    try:
        if file.exists() and not file.is_file():
            raise refuse(file, 'cannot be read: it is no regular file')
        return file.open('rb')
    except OSError as error:
        raise refuse(file, f'cannot be read: {error.strerror}') from error
    except ValueError as error:  # a NUL in the path
        raise refuse(file, f'cannot be read: {error}') from error


def read_bytes(file: Path, refuse: Refuse, largest: int = LARGEST) -> bytes:
    """Return the content of a regular file of at most `largest` bytes."""
    with open_regular(file, refuse) as stream:
        try:
            data = stream.read(largest + 1)
        except OSError as error:
            raise refuse(file, f'cannot be read: {error.strerror}') from error
    if len(data) > largest:
        raise refuse(file, f'is larger than {largest} bytes')
    return data


def read_text(file: Path, refuse: Refuse, largest: int = LARGEST) -> str:
    """Return the text of a UTF-8 file of at most `largest` bytes."""
    try:
        return read_bytes(file, refuse, largest).decode('utf-8-sig')  # tables of Windows
    except UnicodeDecodeError as error:
        raise refuse(file, f'is not text in UTF-8 (byte {error.start})') from error


def read_yaml(file: Path, refuse: Refuse) -> Any:
    """Return what a YAML file holds, by `parse_yaml`."""
    text = read_text(file, refuse, LARGEST_YAML)
    try:
        return parse_yaml(text)
    except ValueError as error:
        raise refuse(file, f'not valid YAML: {error}') from error


def read_csv(
    file: Path, columns: Sequence[str], refuse: Refuse
) -> list[tuple[int, str, list[str]]]:
    """Return (line number, line, cells) below a table's head, but of lines that begin with #."""
    rows = []
    for number, line in enumerate(read_text(file, refuse, LARGEST_CSV).splitlines(), 1):
        if line.strip() and not line.startswith('#'):
            try:
                cells = next(csv.reader([line]))
            except csv.Error as error:
                raise refuse(file, f'line {number}: no line of a table: {error}') from error
            rows.append((number, line, [cell.strip() for cell in cells]))
    if not rows or rows[0][2] != list(columns):
        head = repr(rows[0][1][:80]) if rows else 'nothing'
        raise refuse(file, f'expected the columns {",".join(columns)}, got {head}')
    return rows[1:]


def read_table(code: str, name: str, kind: type[T]) -> T:
    """Return the table of a YAML file that is beside the code that uses it."""
    return msgspec.yaml.decode(Path(code).with_name(name).read_bytes(), type=kind)


def parse_yaml(text: str) -> Any:
    """Return what one YAML document holds: strings, numbers, lists, mappings, dates.

    Raises:
        ValueError: If it is not YAML, writes a key twice, or is larger or deeper than the limits
            above once its aliases are replaced by what they stand for.
    """
    try:
        _check(text)
        return yaml.load(text, Loader=_Loader)  # noqa: S506 - a safe loader
    # PyYAML lets TypeError, OverflowError and others out of dates and numbers that are none.
    except Exception as error:
        raise ValueError(' '.join(str(error).split())[:300] or type(error).__name__) from error


@dataclass
class _Collection:
    """A list or mapping that is being read."""

    anchor: str
    first: int  # entries of the text before it
    is_mapping: bool
    keys: set[str] = field(default_factory=set)
    at_key: bool = True  # a key comes next


def _check(text: str) -> None:
    """Read the events of a YAML text, which builds nothing.

    The loader would end the process where levels are too deep, take all memory where merge keys
    multiply, and keep the last of two values of one key.
    """
    count = 0
    sizes: dict[str, int] = {}  # entries that each alias stands for
    within: list[_Collection] = []
    for event in yaml.parse(text, Loader=_Loader):
        where = f'line {event.start_mark.line + 1 if event.start_mark else 0}'
        if isinstance(event, yaml.CollectionEndEvent):
            ended = within.pop()
            sizes[ended.anchor] = count - ended.first
        if not isinstance(event, yaml.NodeEvent):
            continue
        anchor = event.anchor or ''
        if within and within[-1].is_mapping:
            mapping = within[-1]
            if mapping.at_key and isinstance(event, yaml.ScalarEvent):
                if event.value in mapping.keys:
                    raise ValueError(f'{where}: key {event.value[:60]!r} is written twice')
                mapping.keys.add(event.value)
            mapping.at_key = not mapping.at_key
        if isinstance(event, yaml.AliasEvent):
            if anchor not in sizes:
                raise ValueError(f'{where}: *{anchor[:60]} stands for nothing before it')
            count += sizes[anchor]
        else:
            count += 1
            sizes[anchor] = 1
        if isinstance(event, yaml.CollectionStartEvent):
            del sizes[anchor]  # it cannot stand for itself
            is_mapping = isinstance(event, yaml.MappingStartEvent)
            within.append(_Collection(anchor, count - 1, is_mapping))
        if count > MOST_ENTRIES:
            raise ValueError(f'{where}: more than {MOST_ENTRIES} entries, aliases included')
        if len(within) > DEEPEST:
            raise ValueError(f'{where}: more than {DEEPEST} levels')


def write_whole(file: Path, data: bytes, previous: Path | None = None) -> None:
    """Write a file so that a reader sees the old one or the new one, never a part.

    The old one is kept as `previous`, where that is given. Between the two renames there is only
    that one.
    """
    descriptor, temporary = tempfile.mkstemp(dir=file.parent, prefix=f'.{file.name}.')
    try:
        with os.fdopen(descriptor, 'wb') as stream:
            stream.write(data)
            stream.flush()
            os.fchmod(stream.fileno(), 0o644)  # mkstemp makes it private
            os.fsync(stream.fileno())
        if previous is not None and file.exists():
            file.replace(previous)
        Path(temporary).replace(file)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    # The new name survives a power cut only once the directory is on disk too.
    directory = os.open(file.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)
