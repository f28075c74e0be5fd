# SPDX-License-Identifier: Apache-2.0
"""Message types as ROS 2 Jazzy defines them.

Libraries that read bags compile the definitions found in them. Here messages are decoded with the
types that rosbags ships; a recorded definition is parsed and compared with them, never compiled.
"""

from functools import cache, lru_cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
# Far above any message here; the payload's own length bounds it further.
TYPESTORE.max_sequence_length = 1 << 26

CDR = 'cdr'  # the message encoding of ROS 2
MSG = 'ros2msg'  # the encoding of definitions that are written as .msg files
_LITTLE_ENDIAN = {b'\0\0': False, b'\0\1': True}  # by the first bytes of a message in CDR
_LONGEST_DEFINITION = 1 << 16  # [bytes], several times that of any type here


@cache
def definition(type_name: str) -> str:
    """Return the .msg text of a type and all it contains, concatenated as rosbag2 does."""
    return TYPESTORE.generate_msgdef(type_name, ros_version=2)[0]


@cache
def type_hash(type_name: str) -> str:
    """Return the RIHS01 hash of a type."""
    return TYPESTORE.hash_rihs01(type_name)


def is_known(type_name: str) -> bool:
    """Return whether this is a message type of ROS 2 Jazzy."""
    return type_name in TYPESTORE.fielddefs


def decode(data: bytes, type_name: str) -> Any:
    """Return the message in serialized bytes; raises various errors if they are not of the type.

    Bytes may follow the message: rmw_fastrtps sends all the space that it reserved. (For those the
    type store's own `deserialize_cdr` raises an error.)
    """
    message_type = TYPESTORE.get_msgdef(type_name)
    if _LITTLE_ENDIAN[bytes(data[:2])]:
        deserialize = message_type.deserialize_cdr_le
    else:
        deserialize = message_type.deserialize_cdr_be
    return deserialize(data[4:], 0, message_type.cls, TYPESTORE)[0]


def mismatch(type_name: str, encoding: str, text: bytes, recorded_hash: str) -> str:
    """Return why messages of a recorded type cannot be decoded; '' if they can.

    The name says which type is meant. The RIHS01 hash and a definition in .msg format must agree
    with ROS 2 Jazzy; recorders may leave out both ('' and an empty encoding).
    """
    if not is_known(type_name):
        return f'has the type {type_name[:80]!r}, which ROS 2 Jazzy does not define'
    if recorded_hash not in ('', type_hash(type_name)):
        differs = f'the hash {recorded_hash[:80]!r} instead of {type_hash(type_name)!r}'
    elif encoding == MSG:
        differs = _differing_fields(type_name, text)
    else:
        differs = ''
    return differs and f'was recorded with another {type_name} than that of ROS 2 Jazzy: {differs}'


def _differing_fields(type_name: str, text: bytes) -> str:
    if len(text) > _LONGEST_DEFINITION:
        return f'its definition is longer than {_LONGEST_DEFINITION} bytes'
    try:
        recorded = _fields(type_name, text.decode())
    except Exception as error:  # noqa: BLE001 - the parser raises many kinds
        return f'its definition cannot be read ({" ".join(str(error).split())[:100]})'
    for name, fields in _fields(type_name, definition(type_name)).items():
        if recorded.get(name) != fields:
            return f'the fields of {name} differ'
    return ''


@lru_cache(maxsize=100)
def _fields(type_name: str, text: str) -> dict[str, Any]:
    # Fields of a type and of all it contains, without constants and defaults. The parser accepts
    # neither comments everywhere nor the line ends of Windows.
    text = '\n'.join(line.split('#')[0].strip() for line in text.splitlines())
    return {name: fields for name, (_, fields) in get_types_from_msg(text, type_name).items()}
