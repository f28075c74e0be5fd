# SPDX-License-Identifier: Apache-2.0
"""Message types as ROS 2 Jazzy defines them; a bag's own definitions are compared, never used.

Libraries that read bags compile the definitions found in them. Here a definition is only parsed and
compared, and messages are decoded with the fixed types of rosbags.
"""

from functools import cache, lru_cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
# Far above any message here; the payload's own length bounds it further.
TYPESTORE.max_sequence_length = 1 << 26

ENCODING = 'ros2msg'
ORDERS = {b'\0\0': False, b'\0\1': True}  # of bytes: whether the lowest comes first
_LONGEST = 1 << 18  # [bytes] of a definition, ten times that of any type here


def known(type_name: str) -> bool:
    """Say whether it is a message type of ROS 2 Jazzy."""
    return type_name in TYPESTORE.fielddefs


@cache
def definition(type_name: str) -> str:
    """Return the .msg text of a type and all it contains, concatenated as rosbag2 does."""
    return TYPESTORE.generate_msgdef(type_name, ros_version=2)[0]


@cache
def type_hash(type_name: str) -> str:
    """Return the RIHS01 hash of a type."""
    return TYPESTORE.hash_rihs01(type_name)


def decode(data: bytes, type_name: str) -> Any:
    """Return the message in serialized bytes; a ValueError says that they are none of the type.

    As for ROS, more may follow: rmw_fastrtps sends all that it reserved, and it reserves too much.
    """
    little_endian = ORDERS.get(bytes(data[:2]))
    if little_endian is None:
        raise ValueError(f'not a {type_name}: {data[:2].hex()} is no encapsulation of CDR')
    try:
        kind = TYPESTORE.get_msgdef(type_name)
        read = kind.deserialize_cdr_le if little_endian else kind.deserialize_cdr_be
        return read(data[4:], 0, kind.cls, TYPESTORE)[0]
    # The library lets KeyError, IndexError, OverflowError, MemoryError and others out of bytes
    # that are not a message; all of them mean the same.
    except Exception as error:
        raise ValueError(f'not a {type_name}: {error}') from error


def contradiction(type_name: str, encoding: str, text: bytes, recorded_hash: str) -> str:
    """Say where a recorded definition of a known type differs from ROS 2 Jazzy's; '' if nowhere.

    The encoding says how the definition is written; the RIHS01 hash is '' where none was recorded.
    """
    if encoding != ENCODING:
        return f'is written in {encoding[:40]!r}, not {ENCODING!r}'
    if recorded_hash not in ('', type_hash(type_name)):
        return f'has the hash {recorded_hash[:80]!r}, not {type_hash(type_name)!r}'
    if len(text) > _LONGEST:
        return f'is longer than {_LONGEST} bytes'
    try:
        recorded = _fields(type_name, text.decode())
    except Exception as error:  # noqa: BLE001 - whatever the parser lets out, it is no definition
        return f'cannot be read: {" ".join(str(error).split())[:100]}'
    for name, fields in _fields(type_name, definition(type_name)).items():
        if recorded.get(name) != fields:
            return f'has other fields for {name} than ROS 2 Jazzy'
    return ''


@lru_cache(maxsize=100)
def _fields(type_name: str, text: str) -> dict[str, Any]:
    # Of a type and all it contains, constants and defaults left out. The parser takes neither
    # comments everywhere nor the line ends of Windows.
    text = '\n'.join(line.split('#')[0].strip() for line in text.splitlines())
    return {name: fields for name, (_, fields) in get_types_from_msg(text, type_name).items()}
