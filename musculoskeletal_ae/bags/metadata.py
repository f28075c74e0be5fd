# SPDX-License-Identifier: Apache-2.0
"""metadata.yaml of a rosbag2 directory: written in version 9, read in all versions.

It is written when recording starts, with a mark that it is not ended, and replaced when it ends.
The classes name and order its entries as rosbag2 does.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct, convert, yaml
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

from musculoskeletal_ae.exceptions import BagError
from musculoskeletal_ae.files import parse_yaml, read_yaml

FILE = 'metadata.yaml'
VERSION = 9
CONVERT = 'use `ros2 bag convert`, or rosbags-convert of the Python package rosbags'
REMEDY = 'if the mcap file is sound, `record --recover` makes a new metadata.yaml'

Qos = Mapping[str, Any]  # a profile as rosbag2 writes it in version 9

_MARK = 'musculoskeletal_ae_unfinished'
_NO_TIME = (1 << 63) - 1  # [ns] rosbag2's starting time of a bag without messages
_FOREVER = {'sec': 9223372036, 'nsec': 854775807}


class _Duration(Struct):
    nanoseconds: int


class _Time(Struct):
    nanoseconds_since_epoch: int


class Topic(Struct):
    """A topic."""

    name: str  # absolute
    type: str
    serialization_format: str = 'cdr'
    offered_qos_profiles: Any = ()  # a list of `Qos`; text in older versions
    type_description_hash: str = ''


class TopicCount(Struct):
    """A topic and its number of messages."""

    topic_metadata: Topic
    message_count: int


class Metadata(Struct, kw_only=True):
    """What metadata.yaml says."""

    version: int
    storage_identifier: str
    duration: _Duration
    starting_time: _Time
    message_count: int
    topics_with_message_count: list[TopicCount]
    compression_format: Any = ''
    compression_mode: Any = ''
    relative_file_paths: list[str]
    files: Any = ()  # not in older versions
    custom_data: Any = None
    ros_distro: Any = 'jazzy'

    @property
    def finished(self) -> bool:
        """Whether the recording was ended."""
        return not (isinstance(self.custom_data, dict) and _MARK in self.custom_data)


class _Document(Struct):
    rosbag2_bagfile_information: Metadata


def offered_qos(latched: bool, reliable: bool = True) -> Qos:
    """Return a QoS profile as a publisher offers it."""
    return {
        'history': 'keep_last',
        'depth': 1 if latched else 10,
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
    return yaml.encode(profiles).decode() if profiles else ''


def read_qos(text: str) -> Sequence[Qos]:
    """Return the profiles of a channel's metadata; [] where they cannot be read."""
    try:
        return dump_qos_v9(parse_qos(parse_yaml(text)))
    except Exception:  # noqa: BLE001 - the library lets many kinds out; QoS is a hint only
        return []


def write_metadata(
    directory: Path, name: str, topics: list[TopicCount], times: list[int], finished: bool
) -> None:
    """Write metadata.yaml in one step: a reader sees the old one or the new one.

    `name` is that of the one mcap file; `times` its earliest and latest log time [ns], [] without
    messages.
    """
    start, end = times or (_NO_TIME, _NO_TIME)
    time, span = _Time(start), _Duration(end - start)
    count = sum(topic.message_count for topic in topics)
    metadata = Metadata(
        version=VERSION,
        storage_identifier='mcap',
        duration=span,
        starting_time=time,
        message_count=count,
        topics_with_message_count=topics,
        relative_file_paths=[name],
        files=[{'path': name, 'starting_time': time, 'duration': span, 'message_count': count}],
        custom_data=None if finished else {_MARK: 'true'},
    )
    new = directory / f'{FILE}.new'
    with new.open('wb') as stream:
        stream.write(yaml.encode(_Document(metadata)))
        if finished:
            stream.flush()
            os.fsync(stream.fileno())
    new.replace(directory / FILE)


def read_metadata(directory: Path) -> Metadata | None:
    """Return metadata.yaml, None where there is none; a BagError says why it cannot be used."""
    file = directory / FILE
    if not os.path.lexists(file):
        return None
    try:
        metadata = convert(read_yaml(file, _unusable), _Document).rosbag2_bagfile_information
        _check(metadata, file)
        return metadata
    except ValueError as error:
        raise _unusable(file, str(error)) from error


def _check(metadata: Metadata, file: Path) -> None:
    if not 1 <= metadata.version <= VERSION:
        raise ValueError(f'version {metadata.version} is none of 1 … {VERSION}')
    if (storage := metadata.storage_identifier) != 'mcap':
        raise BagError(file, f'storage {storage[:40]!r} is not mcap', CONVERT)
    if (mode := str(metadata.compression_mode or 'none')[:8].lower()) != 'none':
        whole = 'message' if mode == 'message' else 'file'
        raise BagError(file, f'rosbag2 compressed each {whole} by itself', CONVERT)
    names = metadata.relative_file_paths
    # A bag names files beside its metadata.yaml and nothing else on this machine.
    if any(Path(name).name != name or name in ('', '.', '..') for name in names):
        raise ValueError('relative_file_paths must name files in the same directory')
    if not names or len(set(names)) != len(names):
        raise ValueError('relative_file_paths must name each file once')
    counts = [topic.message_count for topic in metadata.topics_with_message_count]
    if sum(counts) != metadata.message_count:
        raise ValueError('message_count is not the sum over the topics')


def _unusable(file: Path, problem: str) -> BagError:
    return BagError(file, f'cannot be used: {problem}', REMEDY)
