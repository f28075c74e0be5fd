# SPDX-License-Identifier: Apache-2.0
"""A callback that takes long gives way to what has come meanwhile; an interrupt ends it all."""

import signal

import pytest
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import String

from musculoskeletal_ae.nodes import running
from musculoskeletal_ae.nodes.bringup_status import BringupStatus
from musculoskeletal_ae.nodes.running import give_way


def say(publisher, text):
    publisher.publish(String(data=text))


def test_messages_are_answered_between_the_pieces_of_a_callback(graph):
    said = []

    async def slow(message):
        said.append(f'{message.data} begins')
        say(quick, message.data)
        while f'quick {message.data}' not in said:
            await give_way()
        said.append(f'{message.data} ends')

    graph.node.create_subscription(String, 'slow', slow, 10)
    graph.node.create_subscription(String, 'quick', lambda m: said.append(f'quick {m.data}'), 10)
    quick = graph.publisher(String, 'quick')
    say(graph.publisher(String, 'slow'), 'a')
    graph.wait(lambda: 'a ends' in said, 'the end')
    assert said == ['a begins', 'quick a', 'a ends']


def test_callbacks_that_give_way_end_in_the_order_in_which_they_began(graph):
    ended = []

    async def slow(message):
        for _ in range(5 if message.data == 'a' else 1):
            await give_way()
        ended.append(message.data)

    graph.node.create_subscription(String, 'slow', slow, 10)
    publisher = graph.publisher(String, 'slow')
    for text in 'abc':
        say(publisher, text)
    graph.wait(lambda: len(ended) == 3, 'all three')
    assert ended == ['a', 'b', 'c']


def test_what_a_later_piece_lets_out_is_counted_and_the_node_goes_on(graph):
    node = graph.host(BringupStatus, robot='arm26')

    async def fails(message):
        await give_way()
        raise ValueError(message.data)

    node.create_subscription(String, 'slow', fails, 10)
    publisher = graph.publisher(String, 'slow')
    for count in (1, 2):
        say(publisher, 'in a later piece')
        graph.wait(lambda count=count: sum(node.rejected.values()) == count, 'the fault')
    assert node.rejected == {f'{graph.namespace}/slow: ValueError': 2}


def test_an_interrupt_that_leaves_rclpy_as_another_error_is_an_interrupt(graph, monkeypatch):
    monkeypatch.setattr(running, '_interrupts', [])

    def interrupted(_):
        try:
            running.interrupt(signal.SIGINT, None)
        except KeyboardInterrupt as error:
            raise RuntimeError('Unable to convert call argument') from error

    graph.node.create_subscription(String, 'topic', interrupted, 10)
    say(graph.publisher(String, 'topic'), 'a')
    with pytest.raises(ExternalShutdownException):
        graph.wait(lambda: False, 'the end')
