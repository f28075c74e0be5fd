# SPDX-License-Identifier: Apache-2.0
"""Age, order and delay of the messages of one topic."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from musculoskeletal_ae.awake_clock import AwakeClock
from musculoskeletal_ae.messages.arrival import LONGEST_DELAY, SILENCE, Arrival, is_later

PERIOD = 0.01  # period of the messages [s]
SECOND = 1_000_000_000


# -- age ------------------------------------------------------------------------------------------


def test_the_age_counts_from_the_start_and_then_from_the_last_used_message():
    arrival = Arrival(since=10.0)
    arrival.receive(11.0)
    assert arrival.age(12.0) == 2.0 and not arrival.was_used
    arrival.use(12.5)
    assert arrival.age(13.0) == 0.5 and arrival.was_used
    assert Arrival().age(0.0) == math.inf


def test_an_expected_pause_does_not_count():
    arrival = Arrival()
    arrival.use(0.0)
    arrival.expect_later(1.0, within=5.0)
    assert (arrival.age(3.0), arrival.age(6.5)) == (0.0, 0.5)


def test_a_process_that_is_always_late_still_notices_a_silent_topic():
    """If late ticks counted nothing, a topic could be silent for minutes without a report."""
    clock = AwakeClock(0.3)
    arrival = Arrival(clock)
    clock.tick(0.0)
    arrival.use(0.0)
    ages = []
    for now in (2.0, 4.0, 6.0, 8.0, 10.0):
        clock.tick(now)
        ages.append(arrival.age(now))
    assert ages[0] < SILENCE < ages[-1]


def test_the_rate_counts_used_messages_in_the_time_in_which_this_process_ran():
    clock = AwakeClock(0.3)
    arrival = Arrival(clock, since=0.0)
    clock.tick(0.0)
    arrival.measure_rate(0.1)
    assert math.isnan(arrival.rate)
    for n in range(4):
        arrival.use(0.1 + 0.05 * n)
    arrival.measure_rate(60.1)  # after a pause of 59.8 s
    assert arrival.rate == pytest.approx(4 / 0.2)
    arrival.measure_rate(60.1)
    assert arrival.rate == pytest.approx(4 / 0.2)


# -- order ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('sent', 'number', 'is_new'),
    [
        (100 * SECOND, 7, False),  # the same message a second time
        (100 * SECOND - 1, 6, False),  # an earlier message that arrives later
        (100 * SECOND + 1, 8, True),
        (100 * SECOND - 1, 8, True),  # the publisher's clock stepped back
        (99 * SECOND, 6, True),  # a message of another publisher, whose clock differs
        (0, 0, True),  # the middleware states neither time nor number
    ],
)
def test_a_message_that_was_sent_no_later_than_the_last_one_is_not_new(sent, number, is_new):
    arrival = Arrival()
    assert arrival.receive(0.0, 100 * SECOND, 7)
    assert arrival.receive(0.0, sent, number) == is_new


def test_messages_of_several_publishers_and_after_forgotten_order_are_all_new():
    arrival = Arrival()
    assert arrival.receive(0.0, 100 * SECOND, 50)
    assert arrival.receive(0.0, 99 * SECOND + 1, 1, lambda: False)
    assert arrival.turns == 1
    arrival.forget_order()
    assert arrival.receive(0.0, 99 * SECOND + 1, 1)


def test_a_stamp_is_later_also_if_the_clock_was_set_back():
    assert [is_later(sent, 5 * SECOND) for sent in (5 * SECOND + 1, 5 * SECOND, 4 * SECOND)] == [
        True, False, True
    ]  # fmt: skip


# -- delay ----------------------------------------------------------------------------------------


def delay(arrival, received, sent):
    """Return the delay [s] of the next message; `sent` is in nanoseconds."""
    arrival.receive(received, sent, arrival.number + 1)
    return arrival.delay


def delays_of(messages, ahead=1.0):
    """Return the delays [s] of messages with these times of reception and of sending [s].

    The clock of the publisher is `ahead` seconds ahead of that of the receiver.
    """
    arrival = Arrival()
    return [delay(arrival, received, round(1e9 * (sent + ahead))) for received, sent in messages]


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
    arrival = Arrival()
    assert [delay(arrival, n * PERIOD, source_time) for n in range(100)] == [0.0] * 100


times = st.one_of(st.integers(0, 10**9), st.integers(-(2**63), 2**63 - 1))


@given(st.lists(st.tuples(st.floats(0.0, 2.0), times), min_size=2, max_size=40))
def test_whatever_times_are_stated_pauses_add_up_to_at_most_twice_the_time_of_reception(steps):
    arrival, now, last, total = Arrival(), 0.0, 0.0, 0.0
    begin = steps[0][0]
    for pause, source_time in steps:
        now += pause
        late = delay(arrival, now, source_time)
        assert 0.0 <= late <= LONGEST_DELAY
        total += pause + max(last - late, 0.0)
        last = late
    assert total - begin <= 2.0 * (now - begin) + 1e-5
