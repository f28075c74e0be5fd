# SPDX-License-Identifier: Apache-2.0
"""Reads the readings of an arm from a CSV file, as other programs write them.

The first line names the columns (`columns.py`); a file without names has the columns #1, #2, ….
Cells are separated by commas, semicolons, tabs or spaces. If commas do not separate cells, they are
decimal commas. Empty cells, and the texts in `NOTHING`, are missing values.
"""

from __future__ import annotations

import csv
import io
import re
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.files import read_text
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tables.columns import Column, Kind, find_columns, gather
from musculoskeletal_ae.tables.table import Table, TableError

LARGEST = 256 << 20  # refuse a larger file [bytes]
#: separate cells by the first of these marks that the first line contains
DELIMITERS = ';', '\t', ',', ' '
#: read a cell with one of these texts, in upper or lower case, as a missing value
NOTHING = '', 'nan', 'na', 'n/a', 'null', 'none', '-'
MOST_SHOWN = 40  # show at most this many characters of a cell in an error
#: conclude that rows are a sequence, as in a motion, if successive postures differ by less than
#: this share of the difference between postures in random order
SEQUENCE_SHARE = 0.1


def read_csv(
    file: Path,
    robot: Robot,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    rate: float | None = None,
) -> tuple[Table, tuple[Column, ...]]:
    """Read a CSV file.

    With a column of times, or with a rate, the rows are successive readings. Otherwise, each row is
    a resting posture.

    Args:
        file: The file.
        robot: The robot whose readings the file contains.
        columns: Headers of columns by their contents, required where a header does not state its
            contents: the name of a joint, `length:MUSCLE`, `tension:MUSCLE` or `time`. The header
            '' states that a joint was not measured.
        units: Unit of each kind of quantity: angle, travel, length, tension or time. A number is
            the size of the unit in SI units, such as -0.01 for a spool of 1 cm that winds in.
        rate: Rows per second [Hz], if the file has no times.

    Returns:
        The table, and the columns that were used.

    Raises:
        TableError: If the file or its columns cannot be used.
    """
    try:
        headers, cells = _read_cells(file)
        found = find_columns(robot, headers, columns or {}, units or {})
        has_time = any(column.key.kind is Kind.TIME for column in found)
        time = None
        if has_time and rate is not None:
            raise TableError('the file has a column of times; leave out --rate')
        if has_time:
            time = gather(found, cells, [Kind.TIME], 1)[:, 0]
        elif rate is not None:
            time = np.arange(len(cells)) / rate
        table = Table.of(
            robot,
            gather(found, cells, [Kind.ANGLE, Kind.TRAVEL], robot.joint_count),
            gather(found, cells, [Kind.LENGTH], robot.muscle_count),
            gather(found, cells, [Kind.TENSION], robot.muscle_count),
            time,
        )
    except TableError as error:
        raise TableError(f'{file}: {error}') from error
    return table, found


def looks_like_a_sequence(table: Table) -> bool:
    """Return whether the postures of successive rows are close to each other, as in a motion."""
    theta = table.rows.theta
    if not table.at_rest or len(theta) < 20:
        return False
    shuffled = theta[np.random.default_rng(0).permutation(len(theta))]
    near, far = (np.nanmedian(np.abs(np.diff(each, axis=0))) for each in (theta, shuffled))
    return bool(near < SEQUENCE_SHARE * far)


def _refusal(_: Path, problem: str) -> TableError:
    return TableError(problem)


def _read_cells(file: Path) -> tuple[list[str], Array]:
    """Read the headers, and the cells as numbers (N, columns), with NaN for missing values."""
    text = read_text(file, _refusal, LARGEST)
    first = next((line for line in text.splitlines() if _has_content(line)), '')
    delimiter = next((mark for mark in DELIMITERS if mark in first.strip()), ',')
    lines = io.StringIO(text, newline='')
    reader = csv.reader(
        (line.strip() for line in lines) if delimiter == ' ' else lines,
        delimiter=delimiter,
        skipinitialspace=delimiter != '\t',
    )
    headers, values = list[str](), array('d')
    try:
        for cells in reader:
            if not _has_content(''.join(cells)):
                continue
            cells = [cell.strip() for cell in cells]
            if not headers:
                headers = cells
                if _are_readings(cells):
                    headers = [f'#{place}' for place in range(1, len(cells) + 1)]
                else:
                    _check_headers(headers)
                    continue
            if len(cells) != len(headers):
                raise TableError(
                    f'line {reader.line_num} has {len(cells)} cells, but the first line has '
                    f'{len(headers)} (separated by {delimiter!r}); write the same number of cells '
                    'in each line' + _comma_hint(delimiter, len(cells), len(headers))
                )
            values.extend(
                _number(cell, reader.line_num, header, delimiter)
                for cell, header in zip(cells, headers)
            )
    except csv.Error as error:
        raise TableError(f'line {reader.line_num}: not valid CSV: {error}') from error
    if not values:
        raise TableError('the file has no rows of readings; write one line for each reading')
    return headers, np.array(values).reshape(-1, len(headers))


def _has_content(line: str) -> bool:
    """Return whether a line is neither empty nor a comment."""
    return bool(line.strip()) and not re.match(r'\s*#(?!\d)', line)


def _check_headers(headers: list[str]) -> None:
    named = [header for header in headers if header]
    if twice := [header for header in dict.fromkeys(named) if named.count(header) > 1]:
        raise TableError(f'two columns are named {twice[0]!r}; rename one of them')


def _comma_hint(delimiter: str, cells: int, headers: int) -> str:
    if delimiter == ',' and cells > headers:
        return '. If commas are decimal commas, separate the cells by semicolons'
    return ''


def _are_readings(cells: Sequence[str]) -> bool:
    """Return whether the cells of a row are numbers and missing values, and not headers."""
    given = [cell for cell in cells if cell.lower() not in NOTHING]
    return bool(given) and all(map(_is_number, given))


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(',', '.'))
    except ValueError:
        return False
    return True


def _number(cell: str, line: int, header: str, delimiter: str) -> float:
    if cell.lower() in NOTHING:
        return np.nan
    text = cell if delimiter == ',' else cell.replace(',', '.')
    try:
        return float(text)
    except ValueError:
        raise TableError(
            f'line {line}, column {header!r}: {cell[:MOST_SHOWN]!r} is not a number; write numbers '
            'without units and thousands separators, and leave cells of missing values empty'
        ) from None
