# SPDX-License-Identifier: Apache-2.0
"""Makes a finished bag of what a killed recorder left."""

from __future__ import annotations

import shutil
from itertools import count
from pathlib import Path

from musculoskeletal_ae.bags.metadata import FILE, read_qos
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.writer import BagWriter
from musculoskeletal_ae.exceptions import BagError


def recover(path: Path, out: Path | None = None) -> tuple[Path, int, Path | None]:
    """Write all complete messages of an unfinished bag, directory or .mcap, into a finished one.

    Without a new directory `out`, a directory is replaced, and the original kept beside it as
    `DIR.unfinished`; of `FILE.mcap` becomes `FILE_recovered`. Returned are the finished bag, its
    number of messages, and where the original is now if it was moved.
    """
    bag, finished = _open(path)
    if finished and out is None:
        raise BagError(path, 'the recording is finished', 'there is nothing to recover')
    if out is not None or not path.is_dir():
        target = out or path.with_name(f'{path.stem}_recovered')
        return target, _copy(bag, target), None
    # The new bag is complete before the old one is touched; its file carries the final name.
    path = path.resolve()
    backup, scratch = _free(path, '.unfinished'), _free(path, '.recovering')
    try:
        messages = _copy(bag, scratch / path.name)
    except BaseException:
        shutil.rmtree(scratch, ignore_errors=True)
        raise
    path.rename(backup)
    (scratch / path.name).rename(path)
    scratch.rmdir()
    return path, messages, backup


def _open(path: Path) -> tuple[Bag, bool]:
    """Open what is there, whatever metadata.yaml says; also return whether the bag is finished."""
    try:
        bag = Bag.open(path, unfinished=True)
    except BagError as error:
        files = sorted(path.glob('*.mcap')) if path.is_dir() else []
        # metadata.yaml may be what is wrong: the messages are in the mcap file.
        if len(files) == 1 and error.file == path / FILE:
            return Bag.open(files[0], unfinished=True), False
        raise
    return bag, not bag.unfinished


def _copy(bag: Bag, target: Path) -> int:
    """Write a bag anew and read it again; return its number of messages."""
    with BagWriter(target) as writer:
        numbers = {
            topic.name: writer.add_topic(topic.name, topic.type, read_qos(topic.qos), topic.schema)
            for topic in bag.topics.values()
        }
        for topic, log_time, publish_time, data, *_ in bag.messages():
            writer.write(numbers[topic], log_time, publish_time, data)
    return Bag.open(target).message_count


def _free(path: Path, suffix: str) -> Path:
    names = (path.with_name(f'{path.name}{suffix}{n or ""}') for n in count())
    return next(name for name in names if not name.exists())
