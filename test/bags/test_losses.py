# SPDX-License-Identifier: Apache-2.0
"""`record` counts the messages that it has missed."""

from musculoskeletal_ae.ros_tools.record import UNNUMBERED, Losses


def counted(numbers, publishers=1):
    losses = Losses()
    for number in numbers:
        losses.note('t', number)
    losses.settle(lambda _: publishers)
    return losses.lost['t']


def test_gaps_in_the_numbers_of_a_publisher_are_lost_messages():
    assert counted([7, 8, 9]) == 0  # messages 1 to 6 were sent before the recording began
    assert counted([1, 2, 5, 6, 10]) == 5
    assert counted([1, 2, 2, 3]) == 0


def test_a_restarted_publisher_has_lost_nothing():
    assert counted([98, 99, 1, 2, 4]) == 1


def test_nothing_is_counted_where_numbers_say_nothing():
    assert counted([500, 3, 501, 4], publishers=2) == 0
    for number in UNNUMBERED:
        assert counted([number, number, 5, number, 6]) == 0


def test_gaps_are_counted_once():
    losses = Losses()
    for number in (1, 3):
        losses.note('t', number)
        losses.settle(lambda _: 1)
    losses.settle(lambda _: 1)
    assert losses.lost == {'t': 1}
