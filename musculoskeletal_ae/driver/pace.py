# SPDX-License-Identifier: Apache-2.0
"""How often a driver publishes, told apart from how often its messages are heard.

A message says when it was sent and how many were sent before. Without that, what counts is when it
came. A computer that is busy may let messages wait, lose them, or keep the driver itself from
running: `Pace` is told when it did not run either.
"""

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.driver.verdict import Verdict

RATE_TOLERANCE = 0.2
LONGEST_GAP = 0.2  # [s], the controller's `max_age`
OWN_PAUSE = 0.05  # [s] without running, from which on that explains a gap
LEAST_LOST = 0.05  # share of the messages


class _Message(NamedTuple):
    came: float  # [s] of our steady clock
    sent: float  # [s] of the driver's clock, NaN if that is not known
    number: int  # that counts up with every message, 0 if that is not known


class Pace:
    """Collects the times of one driver's messages and judges its rate."""

    def __init__(self, rate: float) -> None:
        """Expect messages at a rate [Hz]."""
        self._rate = rate
        self._messages: list[_Message] = []
        self._pauses: list[tuple[float, float]] = []  # begin and end [s] of our clock

    @property
    def count(self) -> int:
        """How many messages came."""
        return len(self._messages)

    def message(self, came: float, sent: float, number: int) -> None:
        """Take the times of a message [s], and its number."""
        self._messages.append(_Message(came, sent, number))

    def pause(self, begin: float, end: float) -> None:
        """Note that this process did not run meanwhile [s], though it wanted to."""
        if end - begin > OWN_PAUSE:
            self._pauses.append((begin, end))

    def judge(self, verdict: Verdict, now: float) -> None:
        """Judge rate and gaps until now [s]."""
        came, sent, number = map(np.array, zip(*self._messages))
        is_dated = bool(np.isfinite(sent).all() and (np.diff(sent) >= 0.0).all())
        is_numbered = is_dated and bool((number > 0).all() and (np.diff(number) > 0).all())
        times = sent if is_dated else came
        gaps = np.diff(times)
        steps = np.diff(number) if is_numbered else np.ones(len(gaps))
        lost = int(steps.sum() - len(gaps))
        if lost > LEAST_LOST * steps.sum():
            verdict.notes.append(
                f'{lost} of {int(steps.sum()) + 1} messages were lost on the way: '
                'this computer or the network is busy'
            )
        rate = steps.sum() / gaps.sum() if len(gaps) and gaps.sum() > 0.0 else 0.0
        # Where some were lost, the driver has published meanwhile.
        gaps = np.append(gaps[steps == 1], now - came[-1])
        gap = float(gaps.max())
        if self._explain(gap, came, now):
            verdict.notes.append(
                f'this computer is busy: nothing came for {gap:.2f} s, in which check_driver did '
                'not run either. The rate is not judged; end what else runs here, and try again'
            )
        elif gap > LONGEST_GAP:
            verdict.failed('gap', gap=gap)
        elif abs(rate / self._rate - 1.0) > RATE_TOLERANCE:
            verdict.failed('rate', rate=rate, wanted=self._rate)
        else:
            verdict.passed('rate')

    def _explain(self, gap: float, came: Array, now: float) -> bool:
        """Whether our own pauses within the longest gap make up most of it."""
        if gap <= LONGEST_GAP:
            return False
        ends = np.append(came, now)
        longest = int(np.diff(ends).argmax())
        begin, end = ends[longest], ends[longest + 1]
        own = sum(max(0.0, min(end, b) - max(begin, a)) for a, b in self._pauses)
        return bool(own > 0.5 * (end - begin))
