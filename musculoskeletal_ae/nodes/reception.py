# SPDX-License-Identifier: Apache-2.0
"""What becomes of a message that arrives: used, or rejected and counted by reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from musculoskeletal_ae.exceptions import MusculoskeletalError

# A source time that lies further back than this is another publisher's clock, not a reordering.
REORDERING = int(1e9)  # [ns]
LONGEST_TEXT = 500


class Reception:
    """Counts what a node receives.

    Attributes:
        rejected: How many messages were rejected, by topic and reason.
        last_rejected: What was wrong with the last one of them, or ''.
    """

    def __init__(self, warn: Callable[[str], object]) -> None:
        """Nothing has come yet; `warn` is told of the first rejection for each reason."""
        self._warn = warn
        self.last_rejected = ''
        self.rejected: Counter[str] = Counter()
        self._received: Counter[str] = Counter()
        self._last: dict[str, tuple[int, int]] = {}

    def of(
        self, topic: str, callback: Callable[[Any], None], publishers: Callable[[], int]
    ) -> Callable[[Any, dict[str, Any]], None]:
        """Return what to subscribe with: calls `callback` unless the message comes twice or late.

        Args:
            topic: To count under.
            callback: Raises a `MusculoskeletalError` to reject the message.
            publishers: Counts who publishes there: a message does not say who sent it, and two
                clocks or counters cannot be compared.
        """

        def receive(message: Any, info: dict[str, Any]) -> None:
            time, number = info['source_timestamp'], info['publication_sequence_number']
            last_time, last_number = self._last.get(topic, (0, 0))
            late = 0 <= last_time - time < REORDERING and number <= last_number
            if late and time > 0 and publishers() == 1:
                self.rejected[f'{topic}: repeated or reordered'] += 1
                return
            self._last[topic] = time, number
            try:
                callback(message)
            except MusculoskeletalError as error:
                self.last_rejected = f'{topic}: {error}'[:LONGEST_TEXT]
                self.rejected[f'{topic}: {error.reason}'] += 1
                if self.rejected[f'{topic}: {error.reason}'] == 1:
                    self._warn(f'rejected {self.last_rejected} (counted in /diagnostics)')
            else:
                self._received[topic] += 1

        return receive

    def take_received(self) -> dict[str, int]:
        """Return how many messages were used since the last call, by topic."""
        received = dict(self._received)
        self._received = Counter(dict.fromkeys(received, 0))
        return received
