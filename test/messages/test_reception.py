# SPDX-License-Identifier: Apache-2.0
"""Late messages are dropped, and rejections are counted by reason. The tests need no graph."""

import time

import pytest

from musculoskeletal_ae.exceptions import CheckpointError, MessageError
from musculoskeletal_ae.messages.reception import Reception

SECOND = 1_000_000_000


class Inbox:
    """A reception whose topic has a fixed number of publishers, and the messages that it used."""

    def __init__(self, publishers=1):
        self.used = []
        self.reception = Reception(print)
        self.receive = self.reception.of('topic', self.used.append, lambda: publishers)

    def get(self, message, sent, number):
        self.receive(message, {'source_timestamp': sent, 'publication_sequence_number': number})


def test_repeated_and_late_messages_are_dropped_and_counted():
    inbox = Inbox()
    for number, sent in ((1, 10), (2, 20), (2, 20), (1, 15), (3, 30)):
        inbox.get(number, sent * SECOND // 100, number)
    assert inbox.used == [1, 2, 3]
    assert inbox.reception.rejected == {'topic: repeated or reordered': 2}


def test_messages_are_used_after_the_clock_of_the_publisher_stepped_back():
    inbox = Inbox()
    inbox.get('before', 100 * SECOND, 1)
    inbox.get('after', 100 * SECOND - SECOND // 2, 2)
    inbox.get('much later', 5 * SECOND, 3)
    assert inbox.used == ['before', 'after', 'much later']


def test_messages_of_two_publishers_are_all_used():
    inbox = Inbox(publishers=2)
    inbox.get('ahead', 100 * SECOND, 50)
    inbox.get('behind', 100 * SECOND - SECOND // 2, 1)
    assert inbox.used == ['ahead', 'behind']


@pytest.mark.parametrize(
    ('error', 'reason'),
    [
        (MessageError('empty', 'no joints'), 'topic: empty'),
        (CheckpointError('made for other joints'), 'topic: unfit checkpoint'),
    ],
)
def test_rejections_are_counted_by_reason_and_the_last_is_kept_in_full(error, reason):
    warnings = []
    reception = Reception(warnings.append)

    def refuse(_):
        raise error

    receive = reception.of('topic', refuse, lambda: 1)
    for number in range(1, 4):
        receive(None, {'source_timestamp': number, 'publication_sequence_number': number})
    assert reception.rejected == {reason: 3}
    assert str(error) in reception.last_rejected
    assert len(warnings) == 1
    assert str(error) in warnings[0]
    reception.measure_rates()
    assert not reception.rates


def test_a_message_that_is_used_later_counts_once_it_is_used():
    reception = Reception(print)
    receive = reception.of('topic', lambda _: None, lambda: 1, is_used_at_once=False)
    receive('message', {'source_timestamp': 1, 'publication_sequence_number': 1})
    assert not reception.arrivals['topic'].was_used
    reception.arrivals['topic'].use(time.monotonic())
    reception.measure_rates()
    assert reception.rates['topic'] > 0.0
    reception.measure_rates()
    assert reception.rates == {'topic': 0.0}
