# SPDX-License-Identifier: Apache-2.0
"""Message types as ROS 2 Jazzy defines them.

Other libraries compile the definitions that they find in a bag. This module decodes messages with
the types that rosbags ships. It parses recorded definitions to compare them with these types, but
never compiles them.
"""

from functools import cache, lru_cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)  # decode all messages with these types
# Refuse messages with a longer sequence than this: no sequence in the messages of this package is
# nearly as long. Sequences that are longer than the rest of their message are refused anyway.
TYPESTORE.max_sequence_length = 1 << 26

CDR = 'cdr'  # the message encoding of ROS 2
MSG = 'ros2msg'  # the encoding of definitions in .msg format
#: read from the first two bytes of a CDR message whether it is little-endian
_LITTLE_ENDIAN = {b'\0\0': False, b'\0\1': True}
#: refuse a longer definition [bytes]; those of the types in the interface are several times shorter
_LONGEST_DEFINITION = 1 << 16


@cache
def definition(type_name: str) -> str:
    """Return the .msg text of a type and its nested types, concatenated as rosbag2 does."""
    return TYPESTORE.generate_msgdef(type_name, ros_version=2)[0]


@cache
def type_hash(type_name: str) -> str:
    """Return the RIHS01 hash by which recorders identify a definition; '' for unknown types."""
    return TYPESTORE.hash_rihs01(type_name) if is_known(type_name) else ''


def is_known(type_name: str) -> bool:
    """Return whether ROS 2 Jazzy defines this message type."""
    return type_name in TYPESTORE.fielddefs


def decode(data: bytes, type_name: str) -> Any:
    """Decode a serialized message; raises various exceptions if the bytes do not fit the type.

    Surplus bytes after the message are ignored, because rmw_fastrtps sends its whole buffer. The
    type store's own `deserialize_cdr` would raise an error for them.
    """
    message_type = TYPESTORE.get_msgdef(type_name)
    if _LITTLE_ENDIAN[bytes(data[:2])]:
        deserialize = message_type.deserialize_cdr_le
    else:
        deserialize = message_type.deserialize_cdr_be
    return deserialize(data[4:], 0, message_type.cls, TYPESTORE)[0]


def mismatch(type_name: str, encoding: str, text: bytes, recorded_hash: str) -> str:
    """Return why the messages of a recorded type cannot be decoded; '' if they can.

    A recorder may store the RIHS01 hash and the definition of a type. Each of them that is stored
    must agree with the type of this name in ROS 2 Jazzy. Only definitions in .msg format are
    compared.

    Args:
        type_name: Name of the type.
        encoding: Format of the definition; '' if none was recorded.
        text: The definition; empty if none was recorded.
        recorded_hash: The hash; '' if none was recorded.
    """
    if not is_known(type_name):
        return f'has the type {type_name[:80]!r}, which ROS 2 Jazzy does not define'
    if recorded_hash not in ('', type_hash(type_name)):
        differs = f'the hash {recorded_hash[:80]!r} instead of {type_hash(type_name)!r}'
    elif encoding == MSG and text.strip():
        differs = _differing_fields(type_name, text)
    else:
        differs = ''
    return differs and f'was recorded with a {type_name} that differs from ROS 2 Jazzy: {differs}'


def _differing_fields(type_name: str, text: bytes) -> str:
    if len(text) > _LONGEST_DEFINITION:
        return f'its definition is longer than {_LONGEST_DEFINITION} bytes'
    try:
        recorded = _fields(type_name, text.decode())
    except Exception as error:  # noqa: BLE001 - the parser raises many types
        return f'its definition cannot be read ({" ".join(str(error).split())[:100]})'
    for name, fields in _fields(type_name, definition(type_name)).items():
        if recorded.get(name) != fields:
            return f'the fields of {name} differ'
    return ''


@lru_cache(maxsize=100)
def _fields(type_name: str, text: str) -> dict[str, Any]:
    # The parser does not accept comments and Windows line ends everywhere, so remove them.
    text = '\n'.join(line.split('#')[0].strip() for line in text.splitlines())
    return {name: fields for name, (_, fields) in get_types_from_msg(text, type_name).items()}
