# SPDX-License-Identifier: Apache-2.0
"""metadata.yaml of a rosbag2 directory: written in version 9, read in all versions.

It is written when recording starts, with a mark that it is not ended, and replaced when it ends.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

from musculoskeletal_ae.exceptions import BagError, UnfinishedBagError
from musculoskeletal_ae.files import parse_yaml, read_yaml

FILE = 'metadata.yaml'
VERSION = 9
REMEDY = 'if the mcap file is sound, `record --recover` makes a new metadata.yaml'

# A QoS profile as rosbag2 writes it in version 9.
Qos = Mapping[str, Any]

_MARK = 'musculoskeletal_ae_unfinished'
_NO_TIME = (1 << 63) - 1  # [ns] rosbag2's starting time of a bag without messages
_FOREVER = {'sec': 9223372036, 'nsec': 854775807}


class TopicCount(NamedTuple):
    """What metadata.yaml says of a topic."""

    name: str
    type: str
    message_count: int
    qos: Sequence[Qos] = ()
    type_hash: str = ''


class Metadata(NamedTuple):
    """What metadata.yaml says.

    Attributes:
        files: Names of the mcap files in the directory, in order.
        topics: Topics, types, counts.
        start: Earliest log time [ns], None without messages.
        duration: To the latest one [ns].
        finished: Whether the recording was ended.
    """

    files: Sequence[str]
    topics: Sequence[TopicCount]
    start: int | None
    duration: int
    finished: bool


def offered_qos(latched: bool, depth: int = 10, reliable: bool = True) -> Qos:
    """Return a QoS profile as a publisher offers it."""
    return {
        'history': 'keep_last',
        'depth': 1 if latched else depth,
        'reliability': 'reliable' if reliable else 'best_effort',
        'durability': 'transient_local' if latched else 'volatile',
        'deadline': _FOREVER,
        'lifespan': _FOREVER,
        'liveliness': 'automatic',
        'liveliness_lease_duration': _FOREVER,
        'avoid_ros_namespace_conventions': False,
    }


def qos_text(profiles: Sequence[Qos]) -> str:
    """Return QoS profiles as rosbag2 writes them into a channel's metadata."""
    return _yaml(list(profiles)) if profiles else ''


def read_qos(text: str) -> Sequence[Qos]:
    """Return the profiles of a channel's metadata; [] where they cannot be read."""
    try:
        return dump_qos_v9(parse_qos(parse_yaml(text)))
    except Exception:  # noqa: BLE001 - the library lets many kinds out; QoS is a hint only
        return []


def write_metadata(directory: Path, metadata: Metadata) -> None:
    """Write metadata.yaml in one step: a reader sees the old one or the new one."""
    start = {'nanoseconds_since_epoch': _NO_TIME if metadata.start is None else metadata.start}
    duration = {'nanoseconds': metadata.duration}
    count = sum(topic.message_count for topic in metadata.topics)
    content = {
        'version': VERSION,
        'storage_identifier': 'mcap',
        'duration': duration,
        'starting_time': start,
        'message_count': count,
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': topic.name,
                    'type': topic.type,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': list(topic.qos),
                    'type_description_hash': topic.type_hash,
                },
                'message_count': topic.message_count,
            }
            for topic in metadata.topics
        ],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': list(metadata.files),
        'files': [
            {'path': name, 'starting_time': start, 'duration': duration, 'message_count': count}
            for name in metadata.files
        ],
        'custom_data': None if metadata.finished else {_MARK: 'true'},
        'ros_distro': 'jazzy',
    }
    new = directory / f'{FILE}.new'
    with new.open('w', encoding='utf-8') as stream:
        stream.write(_yaml({'rosbag2_bagfile_information': content}))
        if metadata.finished:
            stream.flush()
            os.fsync(stream.fileno())
    new.replace(directory / FILE)


def read_metadata(directory: Path) -> Metadata:
    """Read and check metadata.yaml.

    Raises:
        UnfinishedBagError: If there is none.
        BagError: If it cannot be used.
    """
    file = directory / FILE
    if not os.path.lexists(file):
        problem = 'is missing, so the recording was not ended'
        raise UnfinishedBagError(file, None, problem, 'run `record --recover`')
    try:
        return _checked(read_yaml(file, _unusable))
    except ValueError as error:
        raise _unusable(file, str(error)) from error


def _checked(content: Any) -> Metadata:
    info = _get(content, 'rosbag2_bagfile_information', dict)
    version = _get(info, 'version', int)
    if not 1 <= version <= VERSION:
        raise ValueError(f'version {version} is none of 1 … {VERSION}')
    storage = _get(info, 'storage_identifier', str)
    if storage != 'mcap':
        raise ValueError(f'storage {storage[:40]!r} is not mcap: use `ros2 bag convert`')
    if str(info.get('compression_mode') or 'none')[:8].lower() != 'none':
        raise ValueError('rosbag2 compressed the whole file: use `ros2 bag convert`')
    files = _get(info, 'relative_file_paths', list)
    for name in files:
        # A bag names files beside its metadata.yaml and nothing else on this machine.
        if not isinstance(name, str) or Path(name).name != name or name in ('', '.', '..'):
            raise ValueError('relative_file_paths must name files in the same directory')
    if not files or len(set(files)) != len(files):
        raise ValueError('relative_file_paths must name each file once')
    topics = []
    for entry in _get(info, 'topics_with_message_count', list):
        topic, count = _get(entry, 'topic_metadata', dict), _get(entry, 'message_count', int)
        topics.append(TopicCount(_get(topic, 'name', str), _get(topic, 'type', str), count))
    if sum(topic.message_count for topic in topics) != _get(info, 'message_count', int):
        raise ValueError('message_count is not the sum over the topics')
    start = _get(_get(info, 'starting_time', dict), 'nanoseconds_since_epoch', int)
    duration = _get(_get(info, 'duration', dict), 'nanoseconds', int)
    custom = info.get('custom_data')
    return Metadata(
        files, topics, start, duration, not (isinstance(custom, dict) and _MARK in custom)
    )


def _get(entry: Any, key: str, kind: type) -> Any:
    value = entry.get(key) if isinstance(entry, dict) else None
    if not isinstance(value, kind) or isinstance(value, bool):
        raise ValueError(f'{key} is missing or not of type {kind.__name__}')
    return value


def _yaml(value: object) -> str:
    # Aliases (&id001) are legal YAML, but no one expects them in a bag.
    dumper = type('Plain', (yaml.SafeDumper,), {'ignore_aliases': lambda *_: True})
    return str(yaml.dump(value, Dumper=dumper, sort_keys=False))


def _unusable(file: Path, problem: str) -> BagError:
    return BagError(file, None, f'cannot be used: {problem}', REMEDY)
