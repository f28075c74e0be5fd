# SPDX-License-Identifier: Apache-2.0
"""Makes a finished bag of what a killed recorder left."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path

from musculoskeletal_ae.bags.metadata import read_qos
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.writer import BagWriter
from musculoskeletal_ae.exceptions import BagError


def recover(path: Path, out: Path | None = None) -> tuple[Path, int, Path | None]:
    """Write all complete messages of a bag into a finished one.

    Args:
        path: An unfinished bag: a directory or a bare .mcap.
        out: The new directory. None: a directory is replaced, and the original kept beside it as
            `DIR.unfinished`; of `FILE.mcap` becomes `FILE_recovered`.

    Returns:
        The finished bag, its number of messages, and where the original is now if it was moved.

    Raises:
        BagError: If the bag is damaged otherwise, or is finished already.
    """
    try:
        finished = not Bag.open(path).unfinished
    except BagError:
        finished = False
    if finished and out is None:
        raise BagError(path, None, 'the recording is finished', 'there is nothing to recover')
    bag = _open(path)
    backup = None
    if out is None and path.is_dir():
        path = path.resolve()
        backup = _free(path, '.unfinished')
    elif out is None:
        out = path.with_name(f'{path.stem}_recovered')
    # The new bag is complete before the old one is touched; its file carries the final name.
    target = out or _free(path, '.recovering') / path.name
    try:
        _copy(bag, target)
        count = Bag.open(target).message_count
    except BaseException:
        if backup is not None:
            shutil.rmtree(target.parent, ignore_errors=True)
        raise
    if backup is not None:
        path.rename(backup)
        target.rename(path)
        target.parent.rmdir()
        target = path
    return target, count, backup


def _copy(bag: Bag, target: Path) -> None:
    with BagWriter(target) as writer:
        numbers = {
            topic.name: writer.add_topic(topic.name, topic.type, read_qos(topic.qos), topic.schema)
            for topic in bag.topics.values()
        }
        for message in bag.messages():
            number = numbers[message.topic]
            writer.write(number, message.log_time, message.publish_time, message.data)


def _open(path: Path) -> Bag:
    """Open what is there, whatever metadata.yaml says."""
    try:
        return Bag.open(path, unfinished=True)
    except BagError as error:
        files = sorted(path.glob('*.mcap')) if path.is_dir() else []
        # metadata.yaml may be what is wrong: the messages are in the mcap file.
        if len(files) == 1 and error.file == path / 'metadata.yaml':
            return Bag.open(files[0], unfinished=True)
        raise


def _free(path: Path, suffix: str) -> Path:
    names = (path.with_name(f'{path.name}{suffix}{n or ""}') for n in itertools.count())
    return next(name for name in names if not name.exists())
