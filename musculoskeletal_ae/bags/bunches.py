# SPDX-License-Identifier: Apache-2.0
"""Finds topics whose messages a recorder wrote late and in bunches.

A recorder on a busy computer is blocked for a moment, and then writes many messages with almost the
same log time. The publish times are then more accurate, but the publisher's clock may differ from
that of the recorder. With the delay d = log time − publish time of each message, the best time is

    publish time + min(d)

The minimum is over all messages of the topic. Training and replay both use this time.
"""

from array import array
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.storage import LATEST, BagMessage

# The log times of a topic count as bunched if all of these conditions hold.
FEW = 20  # it has at least this number of messages
BUNCHED = 50_000_000  # the delays of its messages differ by more than this [ns]
MANY = 0.1  # more than this fraction of its messages was written together with the message before


class Bunch(NamedTuple):
    """The times of a topic with bunched log times."""

    offset: int  # min(d) [ns], to be added to a publish time
    longest: int  # longest time by which a log time is later than the best time [ns]

    def time(self, message: BagMessage) -> int:
        """Return the best time of a message of the topic [ns]."""
        return message.publish_time + self.offset


def bunches(bag: Bag, topics: Iterable[str], stop: int = LATEST) -> dict[str, Bunch]:
    """Return the topics with bunched log times.

    Args:
        bag: The recording.
        topics: Recorded names of the topics to check.
        stop: Latest log time of the messages to check [ns].
    """
    times = {topic: (array('q'), array('q')) for topic in topics}
    for message in bag.messages(list(times), stop=stop):
        times[message.topic][0].append(message.log_time)
        times[message.topic][1].append(message.publish_time)
    bunched = {}
    for topic, parts in times.items():
        log, sent = (np.array(part, dtype=np.int64) for part in parts)
        if len(log) < FEW or not (sent > 0).all() or (np.diff(sent) < 0).any():
            continue
        delay = log - sent
        together = (np.diff(log) < 0.1 * np.median(np.diff(sent))).mean()
        if np.ptp(delay) > BUNCHED and together > MANY:
            bunched[topic] = Bunch(int(delay.min()), int(np.ptp(delay)))
    return bunched
