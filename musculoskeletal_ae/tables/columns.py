# SPDX-License-Identifier: Apache-2.0
"""Finds the joint or muscle to which each column of a table belongs, and the column's unit.

    header = [WORD] NAME [WORD] [unit], as in `elbow`, `elbow angle (deg)`, `length_biceps_mm`

NAME is that of a joint or muscle, and WORD says what was measured. Upper and lower case, spaces and
the characters _ . / : - make no difference. A user can name the columns and units instead.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tables.table import TableError


class Kind(Enum):
    """A kind of quantity in a column; the value is its name in the option --units."""

    ANGLE = 'angle'
    TRAVEL = 'travel'
    LENGTH = 'length'
    TENSION = 'tension'
    TIME = 'time'


_METRES = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3}  # size of each unit of length [m]
#: accept these units for each kind of quantity, with the size of each in SI units; the first one is
#: the default
UNITS: dict[Kind, dict[str, float]] = {
    Kind.ANGLE: {'rad': 1.0, 'deg': np.pi / 180.0, '°': np.pi / 180.0},
    Kind.TRAVEL: _METRES,
    Kind.LENGTH: _METRES,
    Kind.TENSION: {'N': 1.0, 'kN': 1e3, 'A': 1.0, 'mA': 1e-3},
    Kind.TIME: {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9},
}
#: accept these units of motor currents only for a robot with `tension_source: current`
CURRENTS = 'A', 'mA'
#: a header with the name of a joint may also contain one of these words
POSITION_WORDS = 'angle', 'joint', 'position', 'theta'
#: a header with the name of a muscle and one of these words states a length
LENGTH_WORDS = ('length',)
#: a header with the name of a muscle and one of these words states a tension
TENSION_WORDS = 'tension', 'force', 'current'
TIME_HEADERS = 'time', 't', 'timestamp', 'stamp'  # recognise the column of times by these headers


class Key(NamedTuple):
    """The quantity in a column: its kind, and the joint or muscle to which it belongs."""

    kind: Kind
    number: int  # index of the joint or muscle; 0 for the time


class Column(NamedTuple):
    """A column of a file that is used, with its quantity and unit."""

    place: int  # index among the columns of the file
    key: Key
    header: str
    unit: str  # as the user wrote it; '' for an SI unit that nobody stated
    scale: float  # size of the unit in SI units


def find_columns(
    robot: Robot, headers: Sequence[str], chosen: Mapping[str, str], units: Mapping[str, str]
) -> tuple[Column, ...]:
    """Return the columns of a file that a robot can use.

    Args:
        robot: The robot.
        headers: Header of each column.
        chosen: Headers of columns by their contents, which are the name of a joint,
            `length:MUSCLE`, `tension:MUSCLE` or `time`. The header '' states that a joint was not
            measured.
        units: Unit of each kind of quantity, by the values of `Kind`; a number is the size of the
            unit in SI units. By default, the unit is that of the header, or an SI unit.

    Raises:
        TableError: If a column is missing, appears twice or has an unknown unit.
    """
    known = {kind.value: kind for kind in Kind}
    if unknown := [name for name in units if name not in known]:
        raise TableError(f'units of {unknown[0]!r}: expected one of {", ".join(known)}')
    stated = {known[name]: unit for name, unit in units.items()}
    keys = _chosen_keys(robot)
    if wrong := [name for name in chosen if name not in keys]:
        raise TableError(
            f'column of {wrong[0]!r}: expected a joint, length:MUSCLE, tension:MUSCLE or time; '
            f'joints: {", ".join(robot.joints)}; muscles: {", ".join(robot.muscles)}'
        )
    by_name, found = _names(robot), dict[Key, Column]()
    taken = {header: name for name, header in chosen.items() if header}
    if absent := [header for header in taken if header not in headers]:
        raise TableError(
            f'there is no column {absent[0]!r} for {taken[absent[0]]}; columns: '
            f'{", ".join(headers)}'
        )
    for place, header in enumerate(headers):
        if header in taken:
            key = keys[taken[header]]
            unit = _split(header)[1] or _suffix(header, _legal_units(robot, key.kind))[1]
        else:
            matched, unit = _match(header, by_name)
            if matched is None or matched in {keys[name] for name in chosen}:
                continue
            key = matched
        if key in found:
            raise TableError(
                f'the columns {found[key].header!r} and {header!r} both contain '
                f'{_text(robot, key)}; rename one of them, or choose with --columns'
            )
        unit = stated.get(key.kind, unit)
        found[key] = Column(place, key, header, unit, _scale(robot, key, unit, header))
    _check_units(tuple(found.values()))
    _check_complete(robot, found, headers, {keys[name] for name, h in chosen.items() if not h})
    return tuple(found.values())


def _position_kind(robot: Robot, joint: int) -> Kind:
    return Kind.TRAVEL if robot.units.slides[joint] else Kind.ANGLE


def _chosen_keys(robot: Robot) -> dict[str, Key]:
    """Return the quantity that each legal name in the option --columns stands for."""
    keys = {'time': Key(Kind.TIME, 0)}
    keys |= {name: Key(_position_kind(robot, j), j) for j, name in enumerate(robot.joints)}
    for kind in (Kind.LENGTH, Kind.TENSION):
        keys |= {f'{kind.value}:{name}': Key(kind, i) for i, name in enumerate(robot.muscles)}
    return keys


def _plain(text: str) -> str:
    return re.sub(r'[\s_./:\-]+', '_', text.strip().lower()).strip('_')


def _names(robot: Robot) -> dict[str, Key]:
    """Return the quantity that each header stands for, by the header as `_plain` simplifies it."""
    names = {word: Key(Kind.TIME, 0) for word in TIME_HEADERS}
    for kind, words in ((Kind.LENGTH, LENGTH_WORDS), (Kind.TENSION, TENSION_WORDS)):
        for i, name in enumerate(map(_plain, robot.muscles)):
            for word in words:
                names |= dict.fromkeys((f'{word}_{name}', f'{name}_{word}'), Key(kind, i))
    for j, name in enumerate(map(_plain, robot.joints)):
        key = Key(_position_kind(robot, j), j)
        for before in ('', *POSITION_WORDS):
            for after in ('', *POSITION_WORDS):
                names[_plain(f'{before}_{name}_{after}')] = key
    return names


def _split(header: str) -> tuple[str, str]:
    """Return a header without its unit in brackets, and this unit or ''."""
    match = re.fullmatch(r'(.*?)\s*[\[(]\s*([^\[\]()]+?)\s*[\])]', header.strip())
    return (match[1], match[2]) if match else (header, '')


def _match(header: str, names: Mapping[str, Key]) -> tuple[Key | None, str]:
    """Return what a header means and its unit, or None and ''."""
    name, unit = _split(header)
    if (key := names.get(_plain(name))) is not None:
        return key, unit
    for kind, legal in UNITS.items():
        stem, unit = _suffix(header, legal)
        key = names.get(stem)
        if unit and key is not None and key.kind is kind:
            return key, unit
    return None, ''


def _suffix(header: str, legal: Iterable[str]) -> tuple[str, str]:
    """Return a header in the form of `_plain` without the unit at its end, and this unit or ''."""
    stem, _, last = _plain(header).rpartition('_')
    for symbol in legal:
        if stem and symbol.lower() == last:
            return stem, symbol
    return _plain(header), ''


def _legal_units(robot: Robot, kind: Kind) -> dict[str, float]:
    """Return the units of a kind of quantity that a robot can have, with their sizes."""
    return {
        symbol: size
        for symbol, size in UNITS[kind].items()
        if symbol not in CURRENTS or robot.tension_source.is_current
    }


def _scale(robot: Robot, key: Key, unit: str, header: str) -> float:
    legal = _legal_units(robot, key.kind)
    currents = robot.tension_source.newton_per_ampere
    try:
        size = legal[unit] if unit in legal else float(unit or 1.0)
    except ValueError:
        raise TableError(
            f'column {header!r}: unknown unit {unit!r}; expected one of {", ".join(legal)}, or a '
            f'factor that converts it to SI units: --units {key.kind.value}=UNIT'
        ) from None
    if not np.isfinite(size) or size == 0.0:
        raise TableError(f'column {header!r}: the unit {unit!r} must be a number other than 0')
    return size * float(currents[key.number]) if currents is not None and unit in CURRENTS else size


def _text(robot: Robot, key: Key) -> str:
    """Return the name of a quantity, as in the option --columns."""
    if key.kind is Kind.TIME:
        return 'time'
    if key.kind in (Kind.LENGTH, Kind.TENSION):
        return f'{key.kind.value}:{robot.muscles[key.number]}'
    return robot.joints[key.number]


def _check_complete(
    robot: Robot, found: Mapping[Key, Column], headers: Sequence[str], unmeasured: set[Key]
) -> None:
    needed = [key for key in _chosen_keys(robot).values() if key.kind is not Kind.TIME]
    if not robot.tension_source.is_known:
        needed = [key for key in needed if key.kind is not Kind.TENSION]
    missing = [_text(robot, key) for key in needed if key not in found and key not in unmeasured]
    if not missing:
        return
    remedy = f'name it with --columns {missing[0]}=HEADER'
    if missing[0] in robot.joints:
        remedy += f', or state with --columns {missing[0]}= that it was not measured'
    if missing[0].startswith(Kind.TENSION.value):
        remedy += ', or set `tension_source: none` and `actuation: position` in muscles.yaml'
    more = '' if len(missing) == 1 else f' (and for {", ".join(missing[1:])})'
    raise TableError(
        f'there is no column for {missing[0]}{more}; columns: {", ".join(headers)}; {remedy}'
    )


def _check_units(columns: Sequence[Column]) -> None:
    """Raise a TableError if only some headers of a kind state a unit."""
    for kind in Kind:
        of_kind = [column for column in columns if column.key.kind is kind]
        stated, silent = ([c for c in of_kind if bool(c.unit) is has] for has in (True, False))
        if stated and silent:
            raise TableError(
                f'the column {silent[0].header!r} states no unit, but {stated[0].header!r} does; '
                f'state one unit for all of them with --units {kind.value}={stated[0].unit}, or '
                'write the unit in each header'
            )


def gather(columns: Sequence[Column], cells: Array, kinds: Sequence[Kind], count: int) -> Array:
    """Gather the columns of some kinds in one array in SI units, (N, count).

    Args:
        columns: The columns that are used.
        cells: All cells of the file as numbers, (N, columns of the file).
        kinds: The kinds of quantities to gather.
        count: Number of joints or muscles. Those without a column have NaN.
    """
    values = np.full((len(cells), count), np.nan)
    for column in columns:
        if column.key.kind in kinds:
            values[:, column.key.number] = column.scale * cells[:, column.place]
    return values
