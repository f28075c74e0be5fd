# SPDX-License-Identifier: Apache-2.0
"""What becomes of a message that arrives: used, or rejected and counted by reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from musculoskeletal_ae.exceptions import MessageError, MusculoskeletalError

# A source time that lies further back than this is another publisher's clock, not a reordering.
REORDERING = int(1e9)  # [ns]


class Reception:
    """Counts what a node receives.

    Attributes:
        rejected: How many messages were rejected, by topic and reason.
    """

    def __init__(self) -> None:
        """Nothing has come yet."""
        self.rejected: Counter[str] = Counter()
        self._received: Counter[str] = Counter()
        self._last_source: dict[str, int] = {}

    def of(
        self, topic: str, callback: Callable[[Any], None]
    ) -> Callable[[Any, dict[str, Any]], None]:
        """Return what to subscribe with: calls `callback` unless the message comes twice or late.

        The callback raises a `MusculoskeletalError` to reject the message.
        """

        def receive(message: Any, info: dict[str, Any]) -> None:
            source = info['source_timestamp']
            behind = self._last_source.get(topic, 0) - source
            if 0 <= behind < REORDERING and source > 0:
                self.rejected[f'{topic}: repeated or reordered'] += 1
                return
            self._last_source[topic] = source
            try:
                callback(message)
            except MessageError as error:
                self.rejected[f'{topic}: {error.reason}'] += 1
            except MusculoskeletalError as error:
                self.rejected[f'{topic}: {error}'] += 1
            else:
                self._received[topic] += 1

        return receive

    def take_received(self) -> dict[str, int]:
        """Return how many messages were used since the last call, by topic."""
        received = dict(self._received)
        self._received = Counter(dict.fromkeys(received, 0))
        return received
