# SPDX-License-Identifier: Apache-2.0
"""Writes metadata.yaml of a rosbag2 directory in version 9, and reads from it the storage files.

The recorder writes metadata.yaml when recording starts and replaces it when recording ends. Readers
of a bag take times and counts from the storage files instead.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct, convert, yaml
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2.metadata import dump_qos_v9

from musculoskeletal_ae.bags.message_types import type_hash
from musculoskeletal_ae.bags.storage import CONVERT, NAME_A_BAG, BagTopic, reading
from musculoskeletal_ae.exceptions import BagError
from musculoskeletal_ae.files import read_yaml

FILE = 'metadata.yaml'  # name of the file in a bag directory
VERSION = 9  # write the format of metadata.yaml that ROS 2 Jazzy writes
SUFFIXES = ('.mcap', '.db3')  # read files with these suffixes if metadata.yaml cannot be used

_NO_TIME = (1 << 63) - 1  # write this start time [ns] for a bag without messages, as rosbag2 does
_FOREVER = QosTime(9223372036, 854775807)  # QoS duration of a deadline that never passes


class _Information(Struct):
    relative_file_paths: Annotated[list[str], Meta(min_length=1)]
    message_count: int | None = None
    compression_mode: str | None = None


class _Document(Struct):
    rosbag2_bagfile_information: _Information


def offered_qos(latched: bool, reliable: bool = True) -> Qos:
    """Return the QoS profile that a publisher offers.

    Args:
        latched: Whether subscribers that join later receive the last message.
        reliable: Whether lost messages are sent again.
    """
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if latched else 10,
        reliability=QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=_FOREVER,
        lifespan=_FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_FOREVER,
        avoid_ros_namespace_conventions=False,
    )


def qos_text(profiles: Sequence[Qos]) -> str:
    """Return QoS profiles in rosbag2's format for a channel's metadata."""
    return yaml.encode(dump_qos_v9(list(profiles))).decode() if profiles else ''


def write_metadata(
    directory: Path,
    name: str,
    topics: Iterable[BagTopic],
    times: tuple[int, int] | None,
    finished: bool,
    custom: Mapping[str, str] | None = None,
) -> None:
    """Write metadata.yaml atomically.

    Args:
        directory: The bag directory.
        name: Name of its only mcap file.
        topics: The topics, with the numbers of their messages.
        times: The earliest and the latest log time [ns]; None without messages.
        finished: Whether the recording has ended; the file is then synchronised to disk, to
            survive a power failure.
        custom: Further entries, under `custom_data`.
    """
    start, end = times or (_NO_TIME, _NO_TIME)
    duration = {'nanoseconds': end - start}
    starting_time = {'nanoseconds_since_epoch': start}
    entries = [_topic_entry(topic) for topic in topics]
    count = sum(entry['message_count'] for entry in entries)
    file = {
        'path': name,
        'starting_time': starting_time,
        'duration': duration,
        'message_count': count,
    }
    information = {
        'version': VERSION,
        'storage_identifier': 'mcap',
        'duration': duration,
        'starting_time': starting_time,
        'message_count': count,
        'topics_with_message_count': entries,
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [name],
        'files': [file],
        'custom_data': dict(custom) if custom else None,
        'ros_distro': 'jazzy',
    }
    new = directory / f'{FILE}.new'
    with new.open('wb') as stream:
        stream.write(yaml.encode({'rosbag2_bagfile_information': information}))
        if finished:
            stream.flush()
            os.fsync(stream.fileno())
    new.replace(directory / FILE)


def _topic_entry(topic: BagTopic) -> Mapping[str, Any]:
    metadata = {
        'name': topic.name,
        'type': topic.type,
        'serialization_format': topic.encoding,
        'offered_qos_profiles': dump_qos_v9(topic.qos),
        'type_description_hash': type_hash(topic.type),
    }
    return {'topic_metadata': metadata, 'message_count': topic.message_count}


def read_metadata(directory: Path) -> tuple[list[Path], int | None, str]:
    """Read from metadata.yaml which storage files a bag has.

    If metadata.yaml is missing or invalid, all storage files in the directory are returned.

    Returns:
        The files, the number of their messages or None if it is unknown, and why the list of files
        may be incomplete, or '' if it is complete.

    Raises:
        BagError: If there are no storage files, or rosbag2 compressed the files or messages.
    """
    try:
        metadata = convert(read_yaml(directory / FILE, _unusable), _Document)
    except ValueError as error:
        with reading(directory):
            files = sorted(file for file in directory.iterdir() if file.suffix in SUFFIXES)
        if not files:
            problem = f'has neither a readable {FILE} nor mcap or sqlite3 files'
            raise BagError(directory, problem, NAME_A_BAG) from error
        problem = f'{FILE} cannot be used ({error}); reading all files of the directory'
        return files, None, problem
    information = metadata.rosbag2_bagfile_information
    mode = information.compression_mode or 'none'
    if mode.lower() != 'none':
        problem = (
            f'{FILE} states compression_mode {mode!r:.100}; legal: none '
            '(compressed chunks within an mcap file are legal)'
        )
        raise BagError(directory, problem, f'{CONVERT}, without this compression')
    names = dict.fromkeys(Path(name).name for name in information.relative_file_paths)
    return [directory / name for name in names], information.message_count, ''


def _unusable(_: Path, problem: str) -> ValueError:
    return ValueError(problem)
