# SPDX-License-Identifier: Apache-2.0
"""What becomes of a message, live or of a bag: used, or rejected and counted by reason."""

import math
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from musculoskeletal_ae.exceptions import MusculoskeletalError, printable

LONGEST_TEXT = 500
SHOWN = 10.0  # [s] for which the last refusal is shown
# A source time that lies further back than this is another publisher's clock, not a reordering.
REORDERING = 1_000_000_000  # [ns]


class Reception:
    """Counts what is received."""

    def __init__(self, warn: Callable[[str], object]) -> None:
        """Nothing has come yet; `warn` is told of the first rejection for each reason."""
        self._warn = warn
        self.last_rejected = ''  # what was wrong with the last one of them
        self.rejected: Counter[str] = Counter()  # messages, by topic and reason
        #: parts of messages that were not used though the rest was, by topic and what it was
        self.ignored: Counter[str] = Counter()
        #: topics by which somebody asks for something: who asks is to see that it was refused
        self.commands: set[str] = set()
        self._refusal = '', -math.inf  # the last one of a command, and when it was refused [s]
        self._received: Counter[str] = Counter()
        self.numbers: Counter[str] = Counter()  # of the newest message, by topic; 0: not known
        #: how often a message was numbered lower than the one before, by topic: once where a
        #: publisher starts anew, all the time where two take turns
        self.turns: Counter[str] = Counter()

    def of(
        self,
        topic: str,
        callback: Callable[[Any], Any],
        publishers: Callable[[], int],
        is_used_at_once: bool = True,
    ) -> Callable[[Any, dict[str, Any]], None]:
        """Return what to subscribe with: calls `callback` unless the message comes twice or late.

        That is, of one publisher, one sent no later than the last that was taken, and numbered no
        higher: numbers go on when its clock steps back. 0 is not known. The callback raises a
        `MusculoskeletalError` to reject the message. If the message is not used at once, whoever
        uses it calls `note_used`. `publishers` counts who publishes there: a message does not say
        who sent it, and two clocks or counters cannot be compared.
        """
        before, last = 0, 0  # when the last one was sent [ns], and its number

        def is_new(info: dict[str, Any]) -> bool:
            nonlocal before, last
            sent, number = info['source_timestamp'], info['publication_sequence_number']
            late = sent > 0 and 0 <= before - sent < REORDERING and number <= last
            if late and publishers() == 1:
                self.rejected[f'{topic}: repeated or reordered'] += 1
                return False
            if number < last:
                self.turns[topic] += 1
            before = sent
            self.numbers[topic] = last = number
            return True

        def receive(message: Any, info: dict[str, Any]) -> None:
            if is_new(info):
                try:
                    callback(message)
                except MusculoskeletalError as error:
                    self.reject(topic, error.reason, str(error))
                else:
                    self._received[topic] += is_used_at_once

        return receive

    def note_used(self, topic: str) -> None:
        """Count a message that was used later than it was received."""
        self._received[topic] += 1

    def reject(self, source: str, reason: str, detail: str) -> bool:
        """Count a message or request; say whether it is the first for this reason."""
        self.last_rejected = f'{source}: {detail}'[:LONGEST_TEXT]
        self.rejected[f'{source}: {reason}'] += 1
        if source in self.commands:
            self.refuse(self.last_rejected)
        first = self.rejected[f'{source}: {reason}'] == 1
        if first:
            self._warn(f'rejected {self.last_rejected}')
        return first

    def refuse(self, text: str) -> None:
        """Note that something which somebody asked for is not done, and why."""
        self._refusal = text[:LONGEST_TEXT], time.monotonic()

    @property
    def refusal(self) -> str:
        """What was refused in the last seconds, with the reason; ''."""
        text, refused_at = self._refusal
        return text if time.monotonic() - refused_at < SHOWN else ''

    def ignore(self, source: str, part: str) -> None:
        """Count a part of a message that is not used, such as one joint's position."""
        self.ignored[f'{source}: {part}'] += 1
        if self.ignored[f'{source}: {part}'] == 1:
            self._warn(f'ignored {source}: {part}')

    def reject_error(self, source: str, error: Exception) -> bool:
        """Count what a callback let out; say whether it is the first of its kind."""
        kind = type(error).__name__
        return self.reject(source, kind, f'{kind}: {printable(error)}')

    def take_received(self) -> dict[str, int]:
        """Return how many messages were used since the last call, by topic."""
        received = dict(self._received)
        self._received = Counter(dict.fromkeys(received, 0))
        return received
