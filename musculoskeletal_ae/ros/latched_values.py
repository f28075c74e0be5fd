# SPDX-License-Identifier: Apache-2.0
"""Latched topics whose last value a subscriber can request again.

A subscriber rejects the messages of a topic while several nodes publish it (`second_publishers`).
Afterwards it needs the last value of the remaining publisher. DDS sends a latched value only once
to each subscription. To subscribe anew is not safe: Fast DDS may crash if a subscription is
destroyed while a new publisher of its topic is discovered (eProsima/Fast-DDS 3303). The subscriber
therefore requests the value on a topic of its own, and no subscription is ever destroyed.
"""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Empty

from musculoskeletal_ae.ros.message_building import LATCHED


def request_topic(topic: str) -> str:
    """Return the topic on which the last value of a latched topic is requested."""
    return f'{topic}/publish_again'


class LatchedPublisher:
    """Publishes on a latched topic, and publishes its last value again on request.

    Attributes:
        publisher: The publisher of the topic.
    """

    def __init__(self, node: Node, kind: type, topic: str) -> None:
        """Advertise a topic.

        Args:
            node: Node that publishes.
            kind: Message type.
            topic: Name of the topic.
        """
        self.publisher: Publisher = node.create_publisher(kind, topic, LATCHED)
        self._last: Any = None
        requests = request_topic(self.publisher.topic_name)
        node.create_subscription(Empty, requests, self._on_request, LATCHED)

    def publish(self, message: Any) -> None:
        """Publish a message, which may be serialized."""
        self._last = message
        self.publisher.publish(message)

    def _on_request(self, _: Empty) -> None:
        if self._last is not None:
            self.publisher.publish(self._last)


class LatchedRequests:
    """Requests the last values of latched topics.

    Requests are latched as well, so that none is lost if the publisher is discovered late.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publishers: dict[str, Any] = {}  # by full name of the requested topic

    def send(self, topic: str) -> None:
        """Request the last value of a topic, given by its full name."""
        if topic not in self._publishers:
            name = request_topic(topic)
            self._publishers[topic] = self._node.create_publisher(Empty, name, LATCHED)
        self._publishers[topic].publish(Empty())
