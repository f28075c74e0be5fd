# SPDX-License-Identifier: Apache-2.0
"""Latches an anomaly until the estimator confirms that it has ended.

A message `true` on `anomaly_detected` latches an anomaly immediately. A message `false` does not
clear the latch, because any node could publish it. Instead, the latch calls the estimator's service
`estimator/check_health`, and is cleared if that succeeds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_srvs.srv import Trigger

SERVICE = 'estimator/check_health'
ASK_PERIOD = 1.0  # time after which a request that the estimator has not answered is repeated [s]


class AnomalyLatch:
    """Latches the anomalies that messages of `anomaly_detected` report to one node."""

    def __init__(self, node: Node, follow: Callable[[bool], object]) -> None:
        """Start without an anomaly.

        Args:
            node: The node; it calls the service of the estimator.
            follow: Called with True when an anomaly is latched, with False when it is cleared.
        """
        self._node, self._follow = node, follow
        self._is_latched = False
        self._client: Any = node.create_client(Trigger, SERVICE)
        self._future: Any = None  # future of the pending request; None if there is none
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer: Any = node.create_timer(ASK_PERIOD, self._ask, clock=steady)
        self._timer.cancel()

    def take(self, detected: bool) -> None:
        """Latch an anomaly, or ask the estimator whether a latched anomaly has ended.

        Args:
            detected: Value of a message of `anomaly_detected`.
        """
        if detected:
            self._give_up()
            if not self._is_latched:
                self._is_latched = True
                self._follow(True)
        elif self._is_latched and self._future is None:
            self._timer.reset()
            self._ask()

    def _ask(self) -> None:
        """Ask the estimator whether the anomaly has ended.

        An earlier request that has not been answered is abandoned, because an estimator that has
        restarted in the meantime would never answer it.
        """
        if self._future is not None:
            self._client.remove_pending_request(self._future)
        self._future = self._client.call_async(Trigger.Request())
        self._future.add_done_callback(self._on_answer)

    def _on_answer(self, future: Any) -> None:
        if future is not self._future:
            return
        self._give_up()
        answer = future.result()
        if answer is not None and answer.success:
            self._is_latched = False
            self._follow(False)
        else:
            report = 'did not answer' if answer is None else f'reports: {answer.message}'
            self._node.get_logger().warning(
                f'anomaly_detected is false, but the estimator {report}. The anomaly counts as '
                'present until the estimator confirms its end'
            )

    def _give_up(self) -> None:
        self._timer.cancel()
        if self._future is not None and not self._future.done():
            self._client.remove_pending_request(self._future)
        self._future = None
