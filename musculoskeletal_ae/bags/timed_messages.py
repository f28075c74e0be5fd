# SPDX-License-Identifier: Apache-2.0
"""Messages of a recording with the best times that are known, for training and replay.

A recorder on a busy computer may be blocked for a moment, and then write many messages late and in
bunches, with almost the same log time. The publish times are then more accurate, but the
publisher's clock may differ from that of the recorder. With the delay d = log time − publish time
of each message, the best time is

    publish time + min(d)

The minimum is over all messages of the topic. Topics without bunches keep their log times, because
publish times have errors of their own: the clock of another computer drifts, and the clock of a
recorder with `use_sim_time` runs at another rate.

Log times may also jump forward, because the recorder was paused, or because its clock was set.
Jumps of more than `LONGEST_PAUSE` count as pauses. Backward jumps are refused when an mcap file is
opened; rosbags reads messages of sqlite3 files in the order of their log times.
"""

from __future__ import annotations

import heapq
from array import array
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Ints
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.storage import LATEST, LONGEST_PAUSE, BagMessage
from musculoskeletal_ae.report import duration

# Use publish times instead of the log times of a topic, because it was written late and in bunches,
# only if all of the following conditions hold.
FEW = 20  # the topic has at least this many messages
BUNCHED = 50_000_000  # its delays (log time minus publish time) differ by more than this [ns]
MANY = 0.1  # more than this share of its messages was written together with the message before


class Pause(NamedTuple):
    """A pause of more than 10 s (LONGEST_PAUSE), in which nothing was recorded."""

    begin: int  # log time of the last message before it [ns]
    end: int  # log time of the first message after it [ns]

    def text(self, start: int) -> str:
        """Return a sentence about the pause in a bag that begins at the log time `start` [ns]."""
        begin = duration((self.begin - start) / 1e9)
        length = duration((self.end - self.begin) / 1e9)
        return f'the log times jump forward by {length}, {begin} after the start of the bag'


def find_pauses(times: Iterable[Sequence[int] | Ints]) -> list[Pause]:
    """Return the pauses of more than `LONGEST_PAUSE` between messages.

    Args:
        times: The log times [ns] of each topic.
    """
    ordered = np.sort(np.concatenate([np.zeros(0, dtype=np.int64), *times]))
    before = np.flatnonzero(np.diff(ordered) > LONGEST_PAUSE).tolist()
    return [Pause(int(ordered[n]), int(ordered[n + 1])) for n in before]


class _Bunched(NamedTuple):
    """A topic whose messages were written late and in bunches, with its times to correct."""

    offset: int  # add this to a publish time to get the best time [ns]: the smallest delay, min(d)
    longest: int  # log times are later than the best times by at most this [ns]


class TimedMessages:
    """The messages of some topics of a recording, with the best times that are known.

    Attributes:
        bag: The recording.
        topics: Recorded names of the topics.
        pauses: The pauses of the recording, in order.
        note: A text that names the topics with corrected times; '' if there are none.
    """

    def __init__(self, bag: Bag, topics: Iterable[str], stop: int = LATEST) -> None:
        """Find the pauses of the recording, and the topics with bunched log times.

        Args:
            bag: The recording.
            topics: Recorded names of the topics.
            stop: Latest log time of the messages to check [ns].
        """
        self.bag, self.topics = bag, frozenset(topics)
        times = _read_times(bag, self.topics, stop)
        self.pauses = find_pauses(log_time for log_time, _ in times.values())
        self._bunched = _find_bunched(times)
        self.note = ''
        if self._bunched:
            problem = 'the recorder wrote messages late and in bunches'
            self.note = f'{", ".join(self._bunched)}: {problem}; their publish times are used'

    def messages(
        self, topics: Collection[str], start: int = 0, stop: int = LATEST
    ) -> Iterator[BagMessage]:
        """Yield messages from start to stop [ns], both included, with their best times as log time.

        The messages are sorted by these times.

        Args:
            topics: Recorded names of the topics to read.
            start: Earliest time [ns]. If it is the start of the bag, messages that were published
                earlier, but recorded late, are included.
            stop: Latest time [ns].
        """
        start = start if start > self.bag.start else 0
        longest = max(
            (self._bunched[name].longest for name in topics if name in self._bunched), default=0
        )
        waiting: list[tuple[int, int, BagMessage]] = []  # heap, ordered by corrected time
        for n, message in enumerate(self.bag.messages(topics, start, stop + longest)):
            # No later message of the bag has a corrected time before `log_time - longest`.
            while waiting and waiting[0][0] < message.log_time - longest:
                yield heapq.heappop(waiting)[2]
            bunched = self._bunched.get(message.topic)
            time = message.publish_time + bunched.offset if bunched else message.log_time
            if start <= time <= stop:
                heapq.heappush(waiting, (time, n, message._replace(log_time=time)))
        while waiting:
            yield heapq.heappop(waiting)[2]


def _read_times(bag: Bag, topics: Collection[str], stop: int) -> dict[str, tuple[Ints, Ints]]:
    """Return the log times and the publish times [ns] of the messages of each topic."""
    times = {topic: (array('q'), array('q')) for topic in topics}
    for message in bag.messages(topics, stop=stop):
        log, sent = times[message.topic]
        log.append(message.log_time)
        sent.append(message.publish_time)
    return {
        topic: (np.array(log, dtype=np.int64), np.array(sent, dtype=np.int64))
        for topic, (log, sent) in times.items()
    }


def _find_bunched(times: dict[str, tuple[Ints, Ints]]) -> dict[str, _Bunched]:
    bunched = {}
    for topic in sorted(times):
        log_time, publish_time = times[topic]
        if len(log_time) < FEW or not (publish_time > 0).all():
            continue
        if (np.diff(publish_time) < 0).any():
            continue
        delay = log_time - publish_time
        together = np.diff(log_time) < 0.1 * np.median(np.diff(publish_time))
        if np.ptp(delay) > BUNCHED and together.mean() > MANY:
            bunched[topic] = _Bunched(int(delay.min()), int(np.ptp(delay)))
    return bunched
