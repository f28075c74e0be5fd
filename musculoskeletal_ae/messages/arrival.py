# SPDX-License-Identifier: Apache-2.0
"""When the messages of one topic arrive: their age, delay and rate, and which of them are new.

**Age** is the time since the last message that was used, without the pauses of this process
(`awake_clock`). A topic that should be published continually is silent if its age exceeds SILENCE.

**Order.** A message is new if it was sent later than the one before it, or if the clock of its
publisher was set back. Middleware and messages state when they were sent (`is_later`).

**Delay.** On a busy computer, messages are lost, and others wait and arrive together. The pause
between two receptions is then much shorter than the time in which the values have changed, so a
rate of change must not be computed from times of reception alone. With the time of reception r by
the steady clock of the receiver, and the time of sending s by the clock of the publisher, a message
is late by

    d = r − s − min(r − s)

The minimum is over all messages so far, so d compares a message with the fastest one. Only changes
of s count, so the two clocks need not agree. r − d is the time of sending by the receiver's clock,
except for a constant. What happens if the clock of the publisher is wrong:

    it is set forward                  the message counts as the fastest one: d = 0
    it is set back, or stands still    the minimum begins anew: d = 0
    it drifts                          the minimum rises by DRIFT

Hence d grows no faster than r does. Whatever times a publisher states, the pauses between its
messages add up to at most twice the time in which the messages were received.
"""

import math
from collections.abc import Callable
from typing import Any

from musculoskeletal_ae.awake_clock import AwakeClock

#: treat a topic that should be published continually as silent, and its last message as out of
#: date, without a usable message for this time [s]
SILENCE = 1.0
#: treat the state of a running arm as unknown after a gap between two messages that is longer than
#: this [s]: the controller pauses (`max_age`), and the detectors discard their evidence
INTERRUPTION = 0.2
#: advance detectors, commands and emulated arms by at most this time between two messages or steps
#: [s]; after a longer pause, they do not catch up
LONGEST_STEP = 0.1
#: where about 100 messages a second suffice, skip a message that follows the last used one sooner
#: than this [s]: detectors and learning are tuned at 100 Hz, and more messages would take most of
#: the processor time of the nodes of a fast arm
SPACING = 0.006
#: treat requests as one stream if each follows the one before within this time [s]: `ros2 topic
#: pub` sends one message a second
STREAM_GAP = 1.5
#: if a message was sent earlier than the message before by more than this [ns], assume another
#: clock or a clock that was set back, not reordering
REORDERING = 1_000_000_000
#: let the smallest difference between time of reception and time of sending rise at this rate,
#: because clocks drift by up to 1e-4, and NTP slews them by up to 5e-4
DRIFT = 1e-3
#: limit the reported delay to this [s]: a node that makes no progress for this time ends
#: (`ros/hang_detection.py`)
LONGEST_DELAY = 10.0


def longer_pause(elapsed: float, delay_before: float, delay: float) -> float:
    """Return the time between two receptions or between two sendings, whichever is longer [s].

    Args:
        elapsed: Time between the receptions [s].
        delay_before: Delay of the first message [s].
        delay: Delay of the second message [s].
    """
    return elapsed + max(delay_before - delay, 0.0)


def is_later(sent: int, before: int) -> bool:
    """Return whether a message was sent after another one, by the clock of one publisher.

    The message was sent later if its time of sending is later, or at least REORDERING earlier,
    because the clock was then set back.

    Args:
        sent: Time at which the message was sent [ns].
        before: Time at which the other message was sent [ns].
    """
    return not 0 <= before - sent < REORDERING


def nanoseconds(stamp: Any) -> int:
    """Return a builtin_interfaces/Time as a number [ns]."""
    time: int = stamp.sec * 1_000_000_000 + stamp.nanosec
    return time


class Arrival:
    """The arrival of the messages of one topic. `now` is a time on a steady clock [s].

    Attributes:
        received_at: Time of reception of the newest message [s].
        delay: How late the newest message is [s].
        number: Sequence number of the newest message; 0 if it is unknown.
        turns: How often the sequence number decreased: once when a publisher restarts, continually
            when two publishers alternate.
        was_used: Whether any message was used.
        rate: Messages used per second [Hz], as last measured; NaN before that.
    """

    def __init__(self, clock: AwakeClock | None = None, since: float = -math.inf) -> None:
        """Start before the first message.

        Args:
            clock: Clock that measures the ages of messages; None for the steady clock.
            since: The time from which the age counts until the first message is used [s].
        """
        self._clock = clock or AwakeClock()
        #: times of the last used message and of the last measurement of the rate, without pauses
        #: [s]
        self._used_at = self._measured_at = self._clock.at(since)
        self._sent = 0  # time of sending of the newest message [ns]; 0 if it is unknown
        #: smallest difference of reception and sending [s]; it rises by DRIFT
        self._least = math.inf
        self._count = 0  # number of used messages since the last measurement of the rate
        self.received_at = -math.inf
        self.delay, self.rate = 0.0, math.nan
        self.number = self.turns = 0
        self.was_used = False

    def receive(
        self,
        now: float,
        sent: int = 0,
        number: int = 0,
        is_from_one: Callable[[], bool] = lambda: True,
    ) -> bool:
        """Receive a message: record it if it is new, and return whether it is.

        A message is old if neither its time of sending nor its sequence number is later than that
        of the message before. Both are checked, because only the numbers keep rising when the clock
        of the publisher steps back. The check needs a single publisher: a message does not name its
        sender, and two clocks or counters cannot be compared.

        Args:
            now: Time of reception r [s].
            sent: Time of sending s by the clock of the publisher [ns]; 0 if it is unknown.
            number: Sequence number; 0 if it is unknown.
            is_from_one: Returns whether the topic has a single publisher. It is called only for a
                message that is not new then.
        """
        if sent > 0 and not is_later(sent, self._sent) and number <= self.number and is_from_one():
            return False
        if number < self.number:
            self.turns += 1
        offset = now - 1e-9 * sent
        least = self._least + DRIFT * max(now - self.received_at, 0.0)
        self._least = min(least, offset) if sent > max(self._sent, 0) else offset
        self.delay = min(offset - self._least, LONGEST_DELAY)
        self._sent, self.number, self.received_at = sent, number, now
        return True

    def forget_order(self) -> None:
        """Take the next message for a new one, whoever sent the messages before it."""
        self._sent = self.number = 0

    def use(self, now: float) -> None:
        """Record the use of a message, which may be later than its reception."""
        self._used_at, self.was_used = self._clock.at(now), True
        self._count += 1

    def expect_later(self, now: float, within: float) -> None:
        """Allow a pause of the messages: the age counts only from `within` [s] after `now`."""
        self._used_at = self._clock.at(now) + within

    def age(self, now: float) -> float:
        """Return the awake time since the last used message [s], at least 0."""
        return max(self._clock.at(now) - self._used_at, 0.0)

    def measure_rate(self, now: float) -> None:
        """Measure `rate` since the last call; it stays NaN until a message is used."""
        awake = self._clock.at(now)
        elapsed = awake - self._measured_at
        if elapsed <= 0.0:  # this process has just continued after a pause
            return
        if self.was_used:
            self.rate = self._count / elapsed
        self._count, self._measured_at = 0, awake
