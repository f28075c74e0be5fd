# SPDX-License-Identifier: Apache-2.0
"""Message types as ROS 2 Jazzy defines them; a bag's own definitions are compared, never used.

Libraries that read bags compile the definitions found in them. Here a definition is only split
into lines and compared, and messages are decoded with the fixed types of rosbags.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

_TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
# Far above any message here; the payload's own length bounds it further.
_TYPESTORE.max_sequence_length = 1 << 26

ENCODING = 'ros2msg'
# Kinds of field types: a number or string, a message, and arrays of these.
BASE, NAME, ARRAY = int(Nodetype.BASE), int(Nodetype.NAME), int(Nodetype.ARRAY)

# Fields (type, name) of each type by its name.
Fields = dict[str, list[tuple[str, str]]]


def known(type_name: str) -> bool:
    """Say whether it is a message type of ROS 2 Jazzy."""
    return type_name in _TYPESTORE.fielddefs


@cache
def definition(type_name: str) -> str:
    """Return the .msg text of a type and all it contains, concatenated as rosbag2 does."""
    return _TYPESTORE.generate_msgdef(type_name, ros_version=2)[0]


@cache
def type_hash(type_name: str) -> str:
    """Return the RIHS01 hash of a type."""
    return _TYPESTORE.hash_rihs01(type_name)


def decode(data: bytes, type_name: str) -> Any:
    """Return the message in serialized bytes.

    Raises:
        ValueError: If the bytes are not a message of that type.
    """
    try:
        return _TYPESTORE.deserialize_cdr(data, type_name)
    # The library lets KeyError, IndexError, OverflowError, MemoryError and others out of bytes
    # that are not a message; all of them mean the same.
    except Exception as error:
        raise ValueError(f'not a {type_name}: {error}') from error


def encode(message: object, type_name: str) -> bytes:
    """Return a message of the fixed types as serialized bytes."""
    return bytes(_TYPESTORE.serialize_cdr(message, type_name))


def message_class(type_name: str) -> Any:
    """Return the class of a type's messages, without ROS."""
    return _TYPESTORE.types[type_name]


def fields(type_name: str) -> Any:
    """Return name and type of a type's fields as rosbags describes them."""
    return _TYPESTORE.fielddefs[type_name][1]


def contradiction(type_name: str, encoding: str, text: bytes, recorded_hash: str) -> str:
    """Say where a recorded definition differs from that of ROS 2 Jazzy; '' if nowhere.

    Args:
        type_name: A known type.
        encoding: How the definition is written.
        text: The definition.
        recorded_hash: RIHS01 hash, '' where none was recorded.
    """
    if encoding != ENCODING:
        return f'is written in {encoding[:40]!r}, not {ENCODING!r}'
    if recorded_hash not in ('', type_hash(type_name)):
        return f'has the hash {recorded_hash[:80]!r}, not {type_hash(type_name)!r}'
    try:
        recorded = _fields(type_name, text.decode())
    except ValueError as error:
        return f'cannot be read: {str(error)[:100]}'
    for name, fields in _expected(type_name).items():
        if recorded.get(name) != fields:
            return f'has other fields for {name} than ROS 2 Jazzy'
    return ''


@cache
def _expected(type_name: str) -> Fields:
    return _fields(type_name, definition(type_name))


def _fields(type_name: str, text: str) -> Fields:
    """Return the fields of a concatenated definition; comments, constants, defaults left out."""
    package, _, name = type_name.split('/')
    current = f'{package}/{name}'
    found: Fields = {current: []}
    for line in text.splitlines():
        words = line.split('#', 1)[0].split(None, 2)
        if not words or set(words[0]) == {'='}:
            continue
        if words[0] == 'MSG:':
            current = words[1].replace('/msg/', '/') if len(words) == 2 else ''
            package = current.split('/')[0]
            if current in found:
                raise ValueError(f'{current!r} is defined twice')
            found[current] = []
        elif len(words) < 2:
            raise ValueError(f'line {line[:60]!r} has no name')
        elif '=' not in words[1] and not ''.join(words[2:]).startswith('='):
            found[current].append((_full_type(words[0], package), words[1]))
    return found


def _full_type(field_type: str, package: str) -> str:
    base, bracket, count = field_type.partition('[')
    if base == 'Header':
        base = 'std_msgs/Header'
    elif base[:1].isupper():
        base = f'{package}/{base}'
    return base.replace('/msg/', '/') + bracket + count
