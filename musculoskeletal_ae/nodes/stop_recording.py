# SPDX-License-Identifier: Apache-2.0
"""Saves the last seconds before a latched stop as a bag that `replay` plays.

The controller keeps the recent messages that it received and published. When it stops the arm, a
thread writes these messages to `stop_DATE-TIME/` in ROS's log directory (`log/` under bringup.sh).
The thread does not delay the commands of the stop. If there are more recordings than the user wants
to keep, the oldest ones are deleted.
"""

import shutil
import threading
import time
from collections import deque
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from rclpy.logging import get_logging_directory

from musculoskeletal_ae.bags.metadata import offered_qos
from musculoskeletal_ae.bags.topics import TOPICS, Topic
from musculoskeletal_ae.bags.writer import BagWriter
from musculoskeletal_ae.exceptions import MusculoskeletalError

SECONDS = 10.0  # let a recording begin this long before the stop [s]
MOST = 50_000  # keep at most this many messages, the newest ones
MOST_BYTES = 16 << 20  # keep messages of at most this total size [bytes]
LARGEST_MESSAGE = 4 << 20  # leave out a larger message [bytes]; a typical network has half a MB
FILE = 'cause.txt'  # file in the bag's directory with the cause of the stop; written last
#: count the directories whose names match this pattern as recordings, of which the oldest ones are
#: deleted; it also matches bags that are incomplete because the process was killed
NAMES = f'stop_{"[0-9]" * 8}-{"[0-9]" * 6}-{"[0-9]" * 6}'


#: Time of arrival [ns], topic, and serialized message. Messages are kept as bytes: Python's garbage
#: collector would traverse tens of thousands of message objects and delay a command by 10 ms.
Heard = tuple[int, str, bytes]


class StopRecording:
    """Keeps the last seconds of some topics, and writes them on request."""

    def __init__(
        self,
        resolve: Any,
        directory: Path | None = None,
        topics: Mapping[str, Topic] = TOPICS,
    ) -> None:
        """Start without messages.

        Args:
            resolve: Returns the full name of a topic.
            directory: Where bags are written; by default ROS's log directory.
            topics: The topics that may be kept, by name.
        """
        self._resolve, self._topics = resolve, topics
        self._directory = directory or Path(get_logging_directory())
        self._recent: deque[Heard] = deque()
        self._recent_size = 0  # size of the recent messages [bytes]
        #: for each latched topic, the newest message that is no longer in `_recent`
        self._latched: dict[str, Heard] = {}
        self._writing: threading.Thread | None = None
        self.left_out = 0  # number of messages that were too large
        self.problem = ''  # error of the last recording, or ''
        self.saved: Path | None = None  # directory of the last recording

    def heard(self, topic: str, data: bytes) -> None:
        """Keep a serialized message (CDR) of one of the topics.

        If it is too large, only count it in `left_out`.
        """
        if len(data) > LARGEST_MESSAGE:
            self.left_out += 1
            return
        now = time.time_ns()
        self._recent.append((now, topic, data))
        self._recent_size += len(data)
        while self._recent and (
            len(self._recent) > MOST
            or self._recent_size > MOST_BYTES
            or self._recent[0][0] < now - int(SECONDS * 1e9)
        ):
            left = self._recent.popleft()
            self._recent_size -= len(left[2])
            if self._topics[left[1]].latched:
                self._latched[left[1]] = left

    def save(self, cause: str, most: int) -> None:
        """Save the kept messages in the background, and delete the oldest recordings.

        Nothing happens while an earlier recording is still being written.

        Args:
            cause: Cause of the stop, as text.
            most: Largest number of recordings to keep; if it is 0, nothing is written.
        """
        messages = list(self._recent)
        if not (messages and most) or (self._writing is not None and self._writing.is_alive()):
            return
        begin = messages[0][0]
        before = [(begin, *kept[1:]) for kept in self._latched.values()]
        self._writing = threading.Thread(target=self._save, args=(cause, most, before + messages))
        self._writing.start()

    def close(self) -> None:
        """Wait until a recording that is being written is complete."""
        if self._writing is not None:
            self._writing.join()

    def _save(self, cause: str, most: int, messages: list[Heard]) -> None:
        bag = self._directory / f'stop_{datetime.now():%Y%m%d-%H%M%S-%f}'  # noqa: DTZ005 - local
        try:
            self._write(bag, cause, messages)
        except (MusculoskeletalError, OSError) as error:
            self.problem = f'the stop recording could not be written: {error}'
            return
        self.saved, self.problem = bag, ''
        for old in sorted(self._directory.glob(NAMES))[:-most]:
            shutil.rmtree(old, ignore_errors=True)  # the next recording tries to delete it again

    def _write(self, bag: Path, cause: str, messages: list[Heard]) -> None:
        """Write a bag and the cause of the stop; delete the bag if that fails."""
        bag.mkdir(parents=True)
        try:
            with BagWriter(bag) as writer:
                names = {t: self._resolve(t) for t in {topic for _, topic, _ in messages}}
                for topic, name in names.items():
                    kind, latched, _ = self._topics[topic]
                    writer.add_topic(name, kind, [offered_qos(latched)])
                for when, topic, message in messages:
                    writer.write(names[topic], when, when, message)
            (bag / FILE).write_text(f'{cause}\n', encoding='utf-8')
        except BaseException:
            shutil.rmtree(bag, ignore_errors=True)
            raise
