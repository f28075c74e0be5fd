# SPDX-License-Identifier: Apache-2.0
"""Accepts or rejects messages, live or from a bag, and counts the reasons for rejection."""

import math
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from musculoskeletal_ae.exceptions import MusculoskeletalError, printable

LONGEST_TEXT = 500
SHOWN = 10.0  # report refusals and internal errors for this time [s]
#: longest time between two messages of a stream [s]; `ros2 topic pub` sends one message a second
STREAM_GAP = 1.5
# A source time that lies further back than this comes from another clock, not from reordering.
REORDERING = 1_000_000_000  # [ns]


class Reception:
    """Counts used and rejected messages, and ignored parts of messages."""

    def __init__(
        self, warn: Callable[[str], object], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Start with empty counters.

        Args:
            warn: Called with a text at the first rejection for each reason.
            clock: Returns the time by which the silence of topics is measured [s].
        """
        self._warn, self._clock = warn, clock
        self.last_rejected = ''  # source and fault of the last rejected message
        self.rejected: Counter[str] = Counter()  # messages by topic and reason
        #: unused parts of messages that were otherwise used, by topic and part
        self.ignored: Counter[str] = Counter()
        #: topics that carry requests, whose senders must see a refusal
        self.commands: set[str] = set()
        self._refusal = '', -math.inf  # text of the last refusal, and its time [s]
        self._received: Counter[str] = Counter()
        self._rates_taken_at = time.monotonic()  # [s]
        self._started_at = clock()  # [s]
        self._used_at: dict[str, float] = {}  # time of the last used message by topic [s]
        #: sequence number of the newest message by topic; 0: unknown
        self.numbers: Counter[str] = Counter()
        #: time at which the newest message was sent, by the publisher's clock [ns], by topic; 0:
        #: unknown
        self.source_times: Counter[str] = Counter()
        #: how often the sequence number decreased, by topic: once when a publisher restarts,
        #: continually when two publishers alternate
        self.turns: Counter[str] = Counter()

    def of(
        self,
        topic: str,
        callback: Callable[[Any], Any],
        publishers: Callable[[], int],
        is_used_at_once: bool = True,
    ) -> Callable[[Any, dict[str, Any]], None]:
        """Return a subscription callback that skips repeated and reordered messages.

        A message is skipped if neither its source time nor its sequence number is higher than that
        of the message before. Both are checked, because only the numbers keep rising when the
        publisher's clock steps back. The check needs a single publisher: a message does not name
        its sender, and two clocks or counters cannot be compared.

        Args:
            topic: The name under which messages are counted.
            callback: Receives the message; raises a MusculoskeletalError to reject it.
            publishers: Returns the number of publishers on the topic.
            is_used_at_once: If false, the code that uses the message calls `note_used` later.
        """
        before, last = 0, 0  # source time [ns] and sequence number of the message before

        def is_new(info: dict[str, Any]) -> bool:
            nonlocal before, last
            sent, number = info['source_timestamp'], info['publication_sequence_number']
            late = sent > 0 and 0 <= before - sent < REORDERING and number <= last
            if late and publishers() == 1:
                self.rejected[f'{topic}: repeated or reordered'] += 1
                return False
            if number < last:
                self.turns[topic] += 1
            self.source_times[topic] = before = sent
            self.numbers[topic] = last = number
            return True

        def receive(message: Any, info: dict[str, Any]) -> None:
            if is_new(info):
                try:
                    callback(message)
                except MusculoskeletalError as error:
                    self.reject(topic, error.reason, str(error))
                else:
                    if is_used_at_once:
                        self.note_used(topic)

        return receive

    def note_used(self, topic: str) -> None:
        """Count a message that was used, perhaps later than it was received."""
        self._received[topic] += 1
        self._used_at[topic] = self._clock()

    def silence(self, topic: str) -> float:
        """Return the time since the last used message of a topic, or since the start [s]."""
        return self._clock() - self._used_at.get(topic, self._started_at)

    def was_used(self, topic: str) -> bool:
        """Whether any message of a topic was used."""
        return topic in self._used_at

    def reject(self, source: str, reason: str, detail: str) -> bool:
        """Count a rejected message or request; return whether it is the first for this reason."""
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
        """Count an unused part of a message, such as one joint's position."""
        self.ignored[f'{source}: {part}'] += 1
        if self.ignored[f'{source}: {part}'] == 1:
            self._warn(f'ignored {source}: {part}')

    def reject_error(self, source: str, error: Exception) -> bool:
        """Count an exception that escaped a callback; return whether its type is new."""
        kind = type(error).__name__
        return self.reject(source, kind, f'{kind}: {printable(error)}')

    def take_rates(self) -> dict[str, float]:
        """Return the rate [Hz] of messages that were used since the last call, by topic.

        A topic of which a message was ever used stays in the result, with a rate of 0 if necessary.
        """
        now = time.monotonic()
        elapsed, self._rates_taken_at = now - self._rates_taken_at, now
        received, self._received = self._received, Counter(dict.fromkeys(self._received, 0))
        return {topic: count / elapsed for topic, count in received.items()}


class Streams:
    """Distinguishes the first message of a stream from those that follow it.

    A message follows another in a stream if it arrives at most STREAM_GAP seconds after it.
    """

    def __init__(self) -> None:
        self._last: dict[str, float] = {}  # time of the newest message [s], by topic

    def begins(self, topic: str, now: float) -> bool:
        """Record a message that arrived at `now` [s]; return whether it begins a stream."""
        before, self._last[topic] = self._last.get(topic, -math.inf), now
        return now - before > STREAM_GAP


class Stamps:
    """Distinguishes new messages of one publisher from repeated ones, by their stamps."""

    def __init__(self) -> None:
        self._last: int | None = None  # [ns]

    def is_new(self, stamp: Any) -> bool:
        """Record a stamp; return whether it is new.

        It is new if it is later than the previous one, or at least REORDERING earlier, because the
        clock was then set back.
        """
        time, last = stamp.sec * 1_000_000_000 + stamp.nanosec, self._last
        if last is not None and last - REORDERING < time <= last:
            return False
        self._last = time
        return True
