# SPDX-License-Identifier: Apache-2.0
"""Publishes and reads the states of nodes on /diagnostics, with message rates and rejections."""

import secrets

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import QoSProfile

from musculoskeletal_ae.conditions import CONDITIONS, ordered, to_json
from musculoskeletal_ae.exceptions import printable
from musculoskeletal_ae.messages.reception import Reception
from musculoskeletal_ae.remedy_steps import sentence
from musculoskeletal_ae.report import Report

MANY_REPORTS = QoSProfile(depth=50)  # QoS of /diagnostics, on which all nodes of the graph report
IDENTITY = 'identity'  # name of a value that only the reports of this package's nodes contain
LAST_REJECTED = 'last rejected'  # name of the value with topic and fault of that message
REJECTED = 'rejected '  # value `rejected TOPIC: REASON`: the number of messages rejected so far
PERIOD = 1.0  # publish a report of each node at this interval [s]
NODE_SILENCE = 2.0  # treat a node as ended or hanging if it has not reported for this time [s]


def values_of(status: DiagnosticStatus) -> dict[str, str]:
    """Return the values of a report by name."""
    return {value.key: value.value for value in status.values}


def rejected_counts(values: dict[str, str]) -> dict[str, int]:
    """Return how many messages a node has rejected, by TOPIC: REASON, from a report's values."""
    return {
        key.removeprefix(REJECTED): int(value)
        for key, value in values.items()
        if key.startswith(REJECTED) and value.isdecimal()
    }


class Diagnostics:
    """Publishes the reports of one node, each as one DiagnosticStatus."""

    def __init__(self, node: Node, reception: Reception, hardware: str) -> None:
        """Prepare the reports of a node, and choose its random identity.

        Args:
            node: The node whose reports are published.
            reception: Rates of the messages that the node has used, and counts of rejected ones.
            hardware: Value of `hardware_id` in each status.
        """
        self._node, self._reception, self._hardware = node, reception, hardware
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self.status_name = f'{node.get_fully_qualified_name()}: state'
        #: random text that distinguishes this node from another node of the same name
        self.identity = secrets.token_hex(8)

    def tell(self, report: Report) -> None:
        """Tell the state of the node: publish a report, and the rate of each topic that it uses."""
        rejected, rates = self._reception.rejected, self._reception.rates
        values = {'doing': report.doing} if report.doing else {}
        values |= {**report.values, IDENTITY: self.identity}
        values |= {f'{topic} rate': f'{rate:.1f} Hz' for topic, rate in rates.items()}
        values['rejected'] = str(sum(rejected.values()))
        values |= {f'{REJECTED}{reason}': str(n) for reason, n in rejected.items()}
        if self._reception.last_rejected:
            values[LAST_REJECTED] = self._reception.last_rejected
        values |= {f'ignored {part}': str(n) for part, n in self._reception.ignored.items()}
        present = ordered(report.conditions)
        if steps := report.steps:
            values['remedy'] = sentence(steps)
        listed = [KeyValue(key=CONDITIONS, value=to_json(present))] if present else []
        status = DiagnosticStatus(
            level=getattr(DiagnosticStatus, report.level.upper()),
            name=self.status_name,
            message=printable(report.message),
            hardware_id=self._hardware,
            values=[KeyValue(key=key, value=printable(value)) for key, value in values.items()]
            + listed,
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
