# SPDX-License-Identifier: Apache-2.0
"""The publisher of /clock, for nodes that use simulated time."""

from __future__ import annotations

import math

from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

# Spacing of recorded time, but not more often than nodes can bear.
PERIOD, SHORTEST_PERIOD = 0.005, 0.001  # [s]


class RecordedClock:
    """Publishes the recorded time on /clock at a steady rate.

    Attributes:
        publisher: Of /clock.
        next_tick: When the steady clock [s] calls for the next message.
    """

    def __init__(self, node: Node, rate: float) -> None:
        """Advertise /clock for a replay at a rate."""
        self.publisher = node.create_publisher(Clock, '/clock', QoSProfile(depth=1))
        self._period = max(PERIOD / max(rate, 1.0), SHORTEST_PERIOD)
        self.next_tick = -math.inf

    def tick(self, recorded: int, now: float) -> None:
        """Publish the recorded time [ns] if it is time to."""
        if now >= self.next_tick:
            self.next_tick = now + self._period
            seconds, nanoseconds = divmod(recorded, 1_000_000_000)
            self.publisher.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
