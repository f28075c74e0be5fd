# SPDX-License-Identifier: Apache-2.0
"""Late messages are dropped, and rejections are counted by reason. The tests need no graph."""

import pytest

from musculoskeletal_ae.exceptions import CheckpointError, MessageError
from musculoskeletal_ae.reception import Reception, Streams

SECOND = 1_000_000_000


class Inbox:
    """A reception whose topic has a fixed number of publishers, and the messages that it used."""

    def __init__(self, publishers=1):
        self.used = []
        self.reception = Reception(print)
        self.receive = self.reception.of('topic', self.used.append, lambda: publishers)

    def get(self, message, time, number):
        self.receive(message, {'source_timestamp': time, 'publication_sequence_number': number})


def test_only_the_first_message_of_a_stream_begins_it_and_each_topic_has_its_own():
    streams = Streams()
    assert [streams.begins('target', now) for now in (0.0, 1.0, 1.1, 5.0)] == [
        True, False, False, True
    ]  # fmt: skip
    assert streams.begins('pose', 5.1)


def test_repeated_and_late_messages_are_dropped_and_counted():
    inbox = Inbox()
    for number, time in ((1, 10), (2, 20), (2, 20), (1, 15), (3, 30)):
        inbox.get(number, time * SECOND // 100, number)
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
    ('time', 'number', 'late'),
    [
        (100 * SECOND, 7, True),  # the same message a second time
        (100 * SECOND - 1, 6, True),  # an earlier message that arrives later
        (100 * SECOND + 1, 8, False),
        (100 * SECOND - 1, 8, False),  # the publisher's clock stepped back
        (99 * SECOND, 6, False),  # a message of another publisher, whose clock differs
        (0, 0, False),  # the middleware states neither time nor number
    ],
)
def test_only_what_was_sent_no_later_than_the_last_message_is_late(time, number, late):
    inbox = Inbox()
    inbox.get('first', 100 * SECOND, 7)
    inbox.get('next', time, number)
    assert inbox.used == (['first'] if late else ['first', 'next'])


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
    assert not reception.take_rates()


def test_a_message_that_is_used_later_counts_once_it_is_used():
    reception = Reception(print)
    receive = reception.of('topic', lambda _: None, lambda: 1, is_used_at_once=False)
    receive('message', {'source_timestamp': 1, 'publication_sequence_number': 1})
    assert not reception.take_rates().get('topic')
    reception.note_used('topic')
    assert reception.take_rates()['topic'] > 0.0
    assert reception.take_rates() == {'topic': 0.0}
