# SPDX-License-Identifier: Apache-2.0
"""Read files that a user names, write files atomically, and lock directories.

A file of a user is read only if it is a regular file up to a size limit. The functions that read
such files have an argument `refuse(file, problem)`, which returns the exception to raise; by
default, it is that of `file_error`.
"""

import csv
import fcntl
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, TextIO, TypeVar

import msgspec
import yaml

from musculoskeletal_ae.exceptions import MusculoskeletalError

T = TypeVar('T')
Refuse = Callable[[Path, str], Exception]

LARGEST = 5_000_000  # refuse a larger file, unless the caller states another limit [bytes]
LARGEST_YAML = 1 << 19  # refuse a larger YAML file, because parsing YAML is slow [bytes]
#: refuse a CSV file that is larger than this [bytes], because each cell takes fifty bytes of memory
LARGEST_CSV = 1 << 20
MOST_ENTRIES = 100_000  # refuse a YAML file with more entries after aliases are expanded
DEEPEST = 50  # refuse a YAML file that is nested more deeply than this number of levels

_Loader = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)


def file_error(file: Path, problem: str) -> MusculoskeletalError:
    """Return the usual error for a file, whose text names the file and the problem."""
    return MusculoskeletalError(f'{file}: {problem}')


def open_regular(file: Path, refuse: Refuse = file_error) -> BinaryIO:
    """Open a regular file for reading.

    Other files are refused, because reading a pipe could block and a device may never end.
    """
    try:
        if file.exists() and not file.is_file():
            raise refuse(file, 'cannot be read: it is not a regular file')
        return file.open('rb')
    except OSError as error:
        raise refuse(file, f'cannot be read: {error.strerror}') from error
    except ValueError as error:  # a NUL in the path raises a ValueError
        raise refuse(file, f'cannot be read: {error}') from error


def read_bytes(file: Path, refuse: Refuse = file_error, largest: int = LARGEST) -> bytes:
    """Return the content of a regular file of at most `largest` bytes.

    If the file is larger or cannot be read, the exception of `refuse` is raised.
    """
    with open_regular(file, refuse) as stream:
        try:
            data = stream.read(largest + 1)
        except OSError as error:
            raise refuse(file, f'cannot be read: {error.strerror}') from error
    if len(data) > largest:
        raise refuse(file, f'is larger than {largest} bytes, the largest legal size')
    return data


def read_text(file: Path, refuse: Refuse = file_error, largest: int = LARGEST) -> str:
    """Return the text of a UTF-8 file of at most `largest` bytes, without a byte-order mark.

    If the file is larger, is not UTF-8, or cannot be read, the exception of `refuse` is raised.
    """
    try:
        # Windows programs put a byte-order mark before tables; 'utf-8-sig' removes it.
        return read_bytes(file, refuse, largest).decode('utf-8-sig')
    except UnicodeDecodeError as error:
        raise refuse(file, f'is not UTF-8 text (byte {error.start})') from error


def read_yaml(file: Path, refuse: Refuse = file_error) -> Any:
    """Return the content of a YAML file, parsed and checked by `parse_yaml`."""
    text = read_text(file, refuse, LARGEST_YAML)
    try:
        return parse_yaml(text)
    except ValueError as error:
        raise refuse(file, f'not valid YAML: {error}') from error


def read_csv(
    file: Path, columns: Sequence[str], refuse: Refuse = file_error
) -> list[tuple[int, str, list[str]]]:
    """Return (line number, line, cells) of each row below the header of a CSV table.

    The header must consist of `columns`. Empty lines and lines that begin with # are skipped.
    """
    rows = []
    for number, line in enumerate(read_text(file, refuse, LARGEST_CSV).splitlines(), 1):
        if line.strip() and not line.startswith('#'):
            try:
                cells = next(csv.reader([line]))
            except csv.Error as error:
                raise refuse(file, f'line {number}: not valid CSV: {error}') from error
            rows.append((number, line, [cell.strip() for cell in cells]))
    if not rows or rows[0][2] != list(columns):
        header = repr(rows[0][1][:80]) if rows else 'nothing'
        raise refuse(file, f'expected the columns {",".join(columns)}, got {header}')
    return rows[1:]


def read_table(code: str, name: str, kind: type[T]) -> T:
    """Return the content of a YAML file that lies in the folder of a Python file.

    Args:
        code: Path of the Python file.
        name: Name of the YAML file.
        kind: Type to which the content is converted.
    """
    return msgspec.yaml.decode(Path(code).with_name(name).read_bytes(), type=kind)


def parse_yaml(text: str) -> Any:
    """Return the content of one YAML document, after a check of its size and its keys.

    Raises:
        ValueError: If the text is not valid YAML, repeats a key, or exceeds MOST_ENTRIES or DEEPEST
            after aliases are expanded.
    """
    try:
        _check(text)
        return yaml.load(text, Loader=_Loader)  # noqa: S506 - a safe loader
    # PyYAML raises TypeError, OverflowError and others for malformed dates and numbers.
    except Exception as error:
        raise ValueError(' '.join(str(error).split())[:300] or type(error).__name__) from error


@dataclass
class _Collection:
    """An open list or mapping of a YAML text that is being checked."""

    anchor: str  # YAML anchor of the mapping or list, '' if it has none
    first: int  # number of entries that precede the collection
    is_mapping: bool
    keys: set[str] = field(default_factory=set)
    at_key: bool = True  # whether the next entry is a key


def _check(text: str) -> None:
    """Check a YAML text by its parser events, without building any object.

    The loader alone is not safe: deep nesting crashes the process, nested merge keys exhaust the
    memory, and of a repeated key it silently keeps the last value.
    """
    count = 0
    sizes: dict[str, int] = {}  # number of entries that an alias of each anchor stands for
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
                raise ValueError(f'{where}: alias *{anchor[:60]} has no anchor before it')
            count += sizes[anchor]
        else:
            count += 1
            sizes[anchor] = 1
        if isinstance(event, yaml.CollectionStartEvent):
            del sizes[anchor]  # an alias inside the collection must not refer to it
            is_mapping = isinstance(event, yaml.MappingStartEvent)
            within.append(_Collection(anchor, count - 1, is_mapping))
        if count > MOST_ENTRIES:
            raise ValueError(
                f'{where}: too many entries; legal: at most {MOST_ENTRIES}, with aliases expanded'
            )
        if len(within) > DEEPEST:
            raise ValueError(f'{where}: nested too deeply; legal: at most {DEEPEST} levels')


@contextmanager
def new_directory(directory: Path, refuse: Refuse = file_error) -> Iterator[None]:
    """Create a directory into which a `with` block writes files; an empty one may exist already.

    After an error or Ctrl-C, its files and folders are removed again, and the directory if it was
    new, so that no partial result remains.
    """
    is_there = os.path.lexists(directory)
    if is_there and (not directory.is_dir() or any(directory.iterdir())):
        raise refuse(directory, 'expected a new or empty directory')
    directory.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for entry in directory.iterdir():
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink()
        if not is_there:
            directory.rmdir()
        raise


def locked(file: Path) -> TextIO:
    """Open a file, which is created if it does not exist, and lock it for this process.

    The lock ends when the returned file is closed.

    Raises:
        BlockingIOError: If another process has locked the file.
        OSError: If the file cannot be opened.
    """
    lock = file.open('w', encoding='utf-8')
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        lock.close()
        if isinstance(error, BlockingIOError):
            raise BlockingIOError(f'another process uses {file.parent}') from error
        raise
    return lock


def write_whole(file: Path, data: bytes, previous: Path | None = None) -> None:
    """Write a file atomically: a reader sees the old content or the new content, never a part.

    If `previous` is set, it becomes the old file. At every moment, `file` exists if it did before.
    """
    descriptor, temporary = tempfile.mkstemp(dir=file.parent, prefix=f'.{file.name}.')
    try:
        with os.fdopen(descriptor, 'wb') as stream:
            stream.write(data)
            stream.flush()
            os.fchmod(stream.fileno(), 0o644)  # mkstemp lets only the owner read the file
            os.fsync(stream.fileno())
        if previous is not None and file.exists():
            _keep(file, previous, Path(f'{temporary}.previous'))
        Path(temporary).replace(file)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    # The new name survives a power failure only after the directory is on disk too.
    directory = os.open(file.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def _keep(file: Path, previous: Path, temporary: Path) -> None:
    """Make `previous` the same file, atomically, before the file is replaced.

    `temporary` is a new name in the same folder.
    """
    try:
        try:
            temporary.hardlink_to(file)
        except OSError:  # this file system has no hard links
            shutil.copy2(file, temporary)
            with temporary.open('rb') as copy:
                os.fsync(copy.fileno())
        temporary.replace(previous)
    finally:
        if temporary.exists():  # `replace` leaves it if both were links to one file already
            temporary.unlink()
