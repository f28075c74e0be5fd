# SPDX-License-Identifier: Apache-2.0
"""Warns of nodes that reject the messages of a replay, such as nodes of another robot.

A publisher does not learn from ROS whether its messages are used. However, nodes report on
/diagnostics how many messages they have rejected.
"""

from collections.abc import Callable, Iterable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from musculoskeletal_ae.ros.diagnostics import LAST_REJECTED, rejected_counts, values_of


class Rejections:
    """Warns once for each node, topic and reason when a node rejects messages during the replay."""

    def __init__(self, topics: Iterable[str], bag: str, warn: Callable[[str], object]) -> None:
        """Prepare to watch which nodes reject messages of some topics.

        Args:
            topics: Full names of the topics that are published.
            bag: The recording, as the user names it.
            warn: Called with a text for users.
        """
        self._topics = frozenset(topics)
        self._bag, self._warn = bag, warn
        #: number of rejected messages in the last report of each node, by topic and reason
        self._counts: dict[str, dict[str, int]] = {}
        self._warned = set[tuple[str, str]]()

    def take(self, message: DiagnosticArray) -> None:
        """Compare the reports in a message of /diagnostics with earlier reports."""
        for status in message.status:
            node, _, _ = status.name.partition(':')
            values = values_of(status)
            namespace = node.rpartition('/')[0]
            counts = rejected_counts(values)
            before = self._counts.get(node)
            self._counts[node] = counts
            for rejected, count in counts.items():
                topic = rejected.partition(': ')[0]
                is_ours = (topic if topic[:1] == '/' else f'{namespace}/{topic}') in self._topics
                # The first report may count messages from before this replay.
                if is_ours and before is not None and count > before.get(rejected, 0):
                    self._warn_once(node, topic, rejected, status, values)

    def _warn_once(
        self, node: str, topic: str, rejected: str, status: DiagnosticStatus, values: dict[str, str]
    ) -> None:
        if (node, rejected) in self._warned:
            return
        self._warned.add((node, rejected))
        last = values.get(LAST_REJECTED, '')
        detail = last if last.startswith(f'{topic}: ') else rejected
        robot = status.hardware_id
        self._warn(
            f'{node} (robot {robot}) rejects messages of this recording: {detail}; start the nodes '
            f'for the robot that was recorded; `replay {self._bag} --check --robot {robot}` tells '
            f'whether that robot is {robot}'
        )
