# SPDX-License-Identifier: Apache-2.0
"""Delays of messages, computed from times of sending by a clock that is not synchronised."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from musculoskeletal_ae.signals.message_delay import LONGEST_DELAY, MessageDelay

PERIOD = 0.01  # period of the messages [s]


def delays_of(messages, ahead=1.0):
    """Return the delays [s] of messages with these times of reception and of sending [s].

    The clock of the publisher is `ahead` seconds ahead of that of the receiver.
    """
    delays = MessageDelay()
    return [delays.step(received, round(1e9 * (sent + ahead))) for received, sent in messages]


@pytest.mark.parametrize('ahead', [1.7e9, 1e-3])
def test_a_delay_is_the_time_by_which_a_message_is_later_than_the_fastest_one(ahead):
    latencies = [0.002, 0.001, 0.005, 0.051, 0.041, 0.001]
    messages = [(n * PERIOD + late, n * PERIOD) for n, late in enumerate(latencies)]
    expected = [0.0, 0.0, 0.004, 0.050, 0.040, 0.0]
    assert delays_of(messages, ahead) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize('step', [3600.0, 0.3, -0.3, -3600.0])
def test_a_step_of_the_publishers_clock_is_no_delay(step):
    messages = [(n * PERIOD, n * PERIOD + step * (n >= 50)) for n in range(100)]
    assert delays_of(messages, ahead=1e6) == pytest.approx([0.0] * 100, abs=1e-6)


@pytest.mark.parametrize('drift', [5e-4, -5e-4])
def test_a_clock_that_drifts_makes_no_message_late(drift):
    messages = [(n * PERIOD, n * PERIOD * (1.0 + drift)) for n in range(1000)]
    assert delays_of(messages) == pytest.approx([0.0] * 1000, abs=1e-5)


@pytest.mark.parametrize('source_time', [0, -5, 123])
def test_without_times_of_sending_no_message_is_late(source_time):
    delays = MessageDelay()
    assert [delays.step(n * PERIOD, source_time) for n in range(100)] == [0.0] * 100


times = st.one_of(st.integers(0, 10**9), st.integers(-(2**63), 2**63 - 1))


@given(st.lists(st.tuples(st.floats(0.0, 2.0), times), min_size=2, max_size=40))
def test_whatever_times_are_stated_pauses_add_up_to_at_most_twice_the_time_of_reception(steps):
    delays, now, last, total = MessageDelay(), 0.0, 0.0, 0.0
    begin = steps[0][0]
    for pause, source_time in steps:
        now += pause
        delay = delays.step(now, source_time)
        assert 0.0 <= delay <= LONGEST_DELAY
        total += pause + max(last - delay, 0.0)
        last = delay
    assert total - begin <= 2.0 * (now - begin) + 1e-5
