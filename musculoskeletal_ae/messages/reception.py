# SPDX-License-Identifier: Apache-2.0
"""Accepts or rejects messages, live or from a bag, and counts the reasons for rejection."""

import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from typing import Any

from musculoskeletal_ae.awake_clock import AwakeClock
from musculoskeletal_ae.exceptions import MusculoskeletalError, printable
from musculoskeletal_ae.messages.arrival import Arrival

LONGEST_TEXT = 500  # cut the text of a refusal or rejection after this many characters
SHOWN = 10.0  # report a refusal or an internal error for this time after it happened [s]


class Reception:
    """Counts rejected messages and ignored parts of messages, and knows when messages arrived.

    Attributes:
        arrivals: When the messages of each topic arrived, by topic.
        last_rejected: Topic and fault of the last rejected message.
        rejected: Number of rejected messages, by topic and reason.
        ignored: Number of unused parts of messages that were otherwise used, by topic and part.
        commands: Topics that carry requests, whose senders must see a refusal.
    """

    def __init__(self, warn: Callable[[str], object], clock: AwakeClock | None = None) -> None:
        """Start with empty counters.

        Args:
            warn: Called with a text at the first rejection for each reason.
            clock: Measures the ages of messages; None for the steady clock.
        """
        self._warn = warn
        self.arrivals = defaultdict[str, Arrival](lambda: Arrival(clock, time.monotonic()))
        self.last_rejected = ''
        self.rejected: Counter[str] = Counter()
        self.ignored: Counter[str] = Counter()
        self.commands: set[str] = set()
        self._refusal = '', -math.inf  # text of the last refusal, and its time [s]

    def of(
        self,
        topic: str,
        callback: Callable[[Any], Any],
        publishers: Callable[[], int],
        is_used_at_once: bool = True,
    ) -> Callable[[Any, dict[str, Any]], None]:
        """Return the callback of a new subscription, which skips repeated and reordered messages.

        Args:
            topic: The name under which messages are counted.
            callback: Receives the message; raises a MusculoskeletalError to reject it.
            publishers: Returns the number of publishers on the topic.
            is_used_at_once: If false, the code that uses the message records its use later.
        """
        arrival = self.arrivals[topic]

        def is_from_one() -> bool:
            return publishers() == 1

        def receive(message: Any, info: dict[str, Any]) -> None:
            now = time.monotonic()
            sent, number = info['source_timestamp'], info['publication_sequence_number']
            if not arrival.receive(now, sent, number, is_from_one):
                self.note_repeated(topic)
            elif self.deliver(topic, callback, message) and is_used_at_once:
                arrival.use(now)

        return receive

    def deliver(self, topic: str, callback: Callable[..., Any], *content: Any) -> bool:
        """Call a function with the content of a message; return whether it accepts the message.

        If the function raises a MusculoskeletalError, the message is rejected and counted for
        `topic`.
        """
        try:
            callback(*content)
        except MusculoskeletalError as error:
            self.reject(topic, error.reason, str(error))
            return False
        return True

    def note_repeated(self, topic: str) -> None:
        """Count a message that is skipped because it was repeated or reordered."""
        self.rejected[f'{topic}: repeated or reordered'] += 1

    def reject(self, source: str, reason: str, detail: str) -> bool:
        """Count a rejected message or request; return whether it is the first for this reason.

        `source` names the topic or service, and `detail` describes this case for users.
        """
        self.last_rejected = f'{source}: {detail}'[:LONGEST_TEXT]
        self.rejected[f'{source}: {reason}'] += 1
        if source in self.commands:
            self.refuse(self.last_rejected)
        first = self.rejected[f'{source}: {reason}'] == 1
        if first:
            self._warn(f'rejected {self.last_rejected}')
        return first

    def refuse(self, text: str) -> None:
        """Record that a request is refused; the text includes the reason."""
        self._refusal = text[:LONGEST_TEXT], time.monotonic()

    @property
    def refusal(self) -> str:
        """The request refused in the last SHOWN seconds, with the reason; '' if there is none."""
        text, refused_at = self._refusal
        return text if time.monotonic() - refused_at < SHOWN else ''

    def ignore(self, source: str, part: str) -> None:
        """Count a part of a message on `source` that is not used, such as a joint's position."""
        self.ignored[f'{source}: {part}'] += 1
        if self.ignored[f'{source}: {part}'] == 1:
            self._warn(f'ignored {source}: {part}')

    def reject_error(self, source: str, error: Exception) -> bool:
        """Count an exception that escaped a callback; return whether its type is new."""
        kind = type(error).__name__
        return self.reject(source, kind, f'{kind}: {printable(error)}')

    def measure_rates(self) -> None:
        """Measure the rate of each topic since the last call."""
        now = time.monotonic()
        for arrival in self.arrivals.values():
            arrival.measure_rate(now)

    @property
    def rates(self) -> dict[str, float]:
        """The rate of each topic whose messages were used [Hz], as last measured."""
        rates = {topic: arrival.rate for topic, arrival in self.arrivals.items()}
        return {topic: rate for topic, rate in rates.items() if not math.isnan(rate)}
