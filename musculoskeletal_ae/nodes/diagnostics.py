# SPDX-License-Identifier: Apache-2.0
"""Publishes a node's state on /diagnostics, with message rates and rejected messages."""

import secrets
import time
from collections import Counter
from collections.abc import Iterator, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from musculoskeletal_ae.exceptions import printable
from musculoskeletal_ae.reception import Reception
from musculoskeletal_ae.report import Report

PERIOD = 1.0  # time between reports [s]
SLOW = 0.4  # fraction of the expected rate below which messages come too slowly
SLOW_REPORTS = 3  # number of successive reports with such a rate after which it is reported


class Diagnostics:
    """Publishes the reports of one node, each as a single status."""

    def __init__(self, node: Node, reception: Reception, hardware: str) -> None:
        """Prepare the reports of a node.

        Args:
            node: The node.
            reception: Counts of the messages that the node has used and rejected.
            hardware: Hardware id of the status.
        """
        self._node, self._reception, self._hardware = node, reception, hardware
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._published_at = time.monotonic()
        self._ignored_before = Counter[str]()
        #: expected rate of each topic whose rate this node checks [Hz]
        self.expected_rates = dict[str, float]()
        self._slow_reports = Counter[str]()  # successive reports with a low rate, by topic
        self.status_name = f'{node.get_fully_qualified_name()}: state'
        #: distinguishes this node from another one of the same name
        self.identity = secrets.token_hex(8)

    def tell(self, report: Report) -> dict[str, int]:
        """Publish a report; return the number of messages used since the previous one, by topic."""
        now = time.monotonic()
        elapsed, self._published_at = now - self._published_at, now
        received, rejected = self._reception.take_received(), self._reception.rejected
        values = {**report.values, 'identity': self.identity}
        values |= {f'{topic} rate': f'{n / elapsed:.1f} Hz' for topic, n in received.items()}
        values['rejected'] = str(sum(rejected.values()))
        values |= {f'rejected {reason}': str(n) for reason, n in rejected.items()}
        if self._reception.last_rejected:
            values['last rejected'] = self._reception.last_rejected
        values |= {f'ignored {part}': str(n) for part, n in self._reception.ignored.items()}
        if refusal := self._reception.refusal:
            values['refused'] = refusal
            report = _with_warning(report, f'refused {refusal}')
        for warning in self._slow_topics(received, elapsed):
            report = _with_warning(report, warning)
        if newly_ignored := self._reception.ignored - self._ignored_before:
            self._ignored_before = self._reception.ignored.copy()
            report = _with_warning(report, f'ignored {", ".join(newly_ignored)}')
        status = DiagnosticStatus(
            level=getattr(DiagnosticStatus, report.level.upper()),
            name=self.status_name,
            message=printable(report.message),
            hardware_id=self._hardware,
            values=[KeyValue(key=key, value=printable(value)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
        return received

    def _slow_topics(self, received: Mapping[str, int], elapsed: float) -> Iterator[str]:
        """Yield a warning for each topic whose messages keep coming too slowly.

        A topic without any message is reported elsewhere, and so is a pause of this node, after
        which many messages come at once.
        """
        for topic, expected in self.expected_rates.items():
            rate = received.get(topic, 0) / elapsed
            is_slow = 0.0 < rate < SLOW * expected
            self._slow_reports[topic] = self._slow_reports[topic] + 1 if is_slow else 0
            if self._slow_reports[topic] >= SLOW_REPORTS:
                yield (
                    f'{topic} come at {rate:.0f} Hz instead of {expected:g} Hz: the driver is '
                    'slow, or this computer is overloaded'
                )


def _with_warning(report: Report, warning: str) -> Report:
    """Return a report with one more warning; errors are returned unchanged."""
    if report.level == 'error':
        return report
    return Report('warn', f'{report.message}; {warning}', report.values)
