# SPDX-License-Identifier: Apache-2.0
"""Measure the rate at which a driver publishes.

Source time and sequence number of the messages give the rate of publication. Without them, or if
the driver's clock was set, the rate of reception is used, which may be lower: a busy computer may
delay or lose messages, or block this process. The `AwakeClock` of this process shows whether it was
blocked.

A driver must keep at least the expected rate. If it does not, but this computer is overloaded, the
rate is not judged, because the driver may run here. The motion test then remains possible if the
rate is at least LEAST_RATE and no gap is longer than INTERRUPTION.
"""

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.awake_clock import AwakeClock
from musculoskeletal_ae.driver.verdict import Verdict
from musculoskeletal_ae.messages.arrival import INTERRUPTION
from musculoskeletal_ae.report import is_overloaded

RATE_TOLERANCE = 0.2  # accept a rate that deviates from the expected one by this share
#: Begin the motion test only at this rate or above [Hz], unless the expected rate is lower. A
#: muscle that runs away is then noticed within 33 ms, and `motion_test.MEAN` averages 9 readings.
LEAST_RATE = 30.0
#: report a longer gap between messages as a fault of the driver, even if this computer is
#: overloaded [s]
LONGEST_STALL = 1.0
LEAST_LOST = 0.05  # report a loss of more than this fraction of the messages


#: conclude that the driver's clock was set forward if a message seems to come faster than all
#: before it by more than this [s]; the first messages may be slower by less than this
CLOCK_STEP = 0.1


class _Received(NamedTuple):
    came: float  # time of reception [s]
    came_awake: float  # time of reception by a clock that stops while this process is blocked [s]
    sent: float  # time of sending by the driver's clock [s]; NaN if unknown
    number: int  # sequence number; 0 if unknown


class Pace:
    """Collects the times of one driver's messages and checks its rate."""

    def __init__(self, rate: float, clock: AwakeClock) -> None:
        """Prepare to check that messages arrive at a rate [Hz]; `clock` shows pauses."""
        self._rate = rate
        self._messages: list[_Received] = []
        self._awake = clock

    @property
    def count(self) -> int:
        """Number of messages that were received so far."""
        return len(self._messages)

    def message(self, came: float, sent: float, number: int) -> None:
        """Record a message: when it came, when it was sent [s], and its sequence number."""
        self._messages.append(_Received(came, self._awake.at(came), sent, number))

    def judge(self, verdict: Verdict, now: float) -> None:
        """Judge the rate and the gaps until `now` [s], and add the results to `verdict`."""
        came, came_awake, sent, number = map(np.array, zip(*self._messages))
        is_numbered = bool((number > 0).all() and (np.diff(number) > 0).all())
        times = sent if _is_steady(sent, came) else came
        gaps = np.diff(times)
        steps = np.diff(number) if is_numbered else np.ones(len(gaps))
        lost = int(steps.sum() - len(gaps))
        if lost > LEAST_LOST * steps.sum():
            verdict.notes.append(
                f'{lost} of {int(steps.sum()) + 1} messages were lost in transit: '
                'this computer or the network is busy'
            )
        rate = steps.sum() / gaps.sum() if len(gaps) and gaps.sum() > 0.0 else 0.0
        # Gaps with lost messages are left out, because the driver did publish in them.
        gaps = np.append(gaps[steps == 1], now - came[-1])
        gap = float(gaps.max())
        came, came_awake = np.append(came, now), np.append(came_awake, self._awake.at(now))
        if gap > INTERRUPTION and _explained(came, came_awake):
            verdict.notes.append(
                f'this computer is busy: no message was received for {gap:.2f} s, and check_driver '
                'was blocked as well. The rate was not checked; end other programs and try again'
            )
        elif gap > INTERRUPTION:
            if is_overloaded() and gap <= LONGEST_STALL:
                verdict.excuse('rate', f'no message was received for {gap:.2f} s')
                verdict.forbid_motion(
                    f'no message was received for {gap:.2f} s (longest legal gap: {INTERRUPTION} s)'
                )
            else:
                verdict.failed('gap', gap=gap)
        elif rate < (1.0 - RATE_TOLERANCE) * self._rate:
            self._judge_low(verdict, rate)
        else:
            verdict.passed('rate')
            if rate > (1.0 + RATE_TOLERANCE) * self._rate:
                verdict.notes.append(
                    f'readings came at {rate:.0f} Hz, which is more than the expected '
                    f'{self._rate:g} Hz: set the parameter `rate` of the nodes to the rate of the '
                    'driver'
                )

    def _judge_low(self, verdict: Verdict, rate: float) -> None:
        """Judge a rate [Hz] that is too low: report it, unless an overload may explain it."""
        if not is_overloaded():
            verdict.failed('rate', rate=rate, wanted=self._rate)
            return
        verdict.excuse('rate', f'readings of the muscles came at {rate:.0f} Hz')
        if rate < LEAST_RATE:
            verdict.forbid_motion(
                f'readings came at {rate:.0f} Hz, but the motion test needs {LEAST_RATE:g} Hz'
            )


def _is_steady(sent: Array, came: Array) -> bool:
    """Return whether the driver's clock is known, and was not set while it sent these messages.

    Args:
        sent: Times of sending by the driver's clock [s]; NaN if unknown.
        came: Times of reception [s].
    """
    if not np.isfinite(sent).all() or (np.diff(sent) < 0.0).any():
        return False
    # A delay makes a message slower than others. Only a step of the clock makes all later messages
    # seem faster than every message before.
    offset = came - sent
    fastest = np.minimum.accumulate(offset)
    return bool((fastest[:-1] - offset[1:] < CLOCK_STEP).all())


def _explained(came: Array, came_awake: Array) -> bool:
    """Return whether this process was blocked for most of the longest gap between messages.

    The arguments are times of reception by the steady clock and by the `AwakeClock` [s].
    """
    gaps = np.diff(came)
    longest = int(gaps.argmax())
    return bool(np.diff(came_awake)[longest] < 0.5 * gaps[longest])
