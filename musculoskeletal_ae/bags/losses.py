# SPDX-License-Identifier: Apache-2.0
"""Counts the messages that a recorder has missed, by the sequence numbers of their publishers."""

from collections import Counter
from collections.abc import Callable

#: ignore these sequence numbers, which come from middleware that does not number messages
UNNUMBERED = 0, (1 << 64) - 1


class Losses:
    """Counts the messages of each topic that were published, but not received.

    Every publisher numbers its own messages, so a lost message leaves a gap in the sequence
    numbers. A message does not name its publisher. Gaps are therefore only counted while a topic
    has a single publisher.
    """

    def __init__(self) -> None:
        self.lost: Counter[str] = Counter()  # messages by topic, without topics that lost none
        self._last: dict[str, int] = {}  # newest sequence number by topic
        self._gaps: Counter[str] = Counter()  # missing numbers by topic since the last `settle`

    def note(self, topic: str, number: int) -> None:
        """Note the sequence number of a received message."""
        if number in UNNUMBERED:
            return
        # A restarted publisher begins with a small number again, which gives no positive gap.
        gap = number - self._last.get(topic, number) - 1
        if gap > 0:
            self._gaps[topic] += gap
        self._last[topic] = number

    def settle(self, publishers: Callable[[str], int]) -> None:
        """Add the messages that were missed since the last call to `lost`.

        Gaps in the sequence numbers of a topic with several publishers are discarded, because each
        publisher numbers its own messages.

        Args:
            publishers: Function that returns the number of publishers of a topic.
        """
        for topic, gap in self._gaps.items():
            if publishers(topic) <= 1:
                self.lost[topic] += gap
        self._gaps.clear()
