# SPDX-License-Identifier: Apache-2.0
"""Reports which of the topics that a node needs are missing, silent or slow."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from rclpy.node import Node

from musculoskeletal_ae.conditions import Condition, ConditionKind, Level
from musculoskeletal_ae.messages.arrival import SILENCE
from musculoskeletal_ae.messages.reception import Reception
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.report import with_load

#: topics whose silence is an error, because they are published continually, each with the remedy;
#: in the order of the data flow
STREAMS = {'muscle_states': Step.CHECK_DRIVER, 'estimated_joint_states': Step.CHECK_ESTIMATOR}
REPLAY = 'replay'  # name of the node that plays a recording
SLOW = 0.4  # warn of a topic whose rate is below this fraction of the expected rate
SLOW_REPORTS = 3  # warn after this number of successive reports with too low a rate


class NeededTopics:
    """Reports missing, silent and slow topics of one node."""

    def __init__(self, node: Node, full_name: Callable[[str], str], reception: Reception) -> None:
        """Start without needed topics; `add` adds them.

        Args:
            node: The node that needs the topics.
            full_name: Returns the full name of a topic in the graph.
            reception: Statistics of the messages that the node has received.
        """
        self._node, self._full_name, self._reception = node, full_name, reception
        self._topics: list[str] = []
        self._expected: tuple[str, float] | None = None  # a topic, and its expected rate [Hz]
        self._slow_reports = 0  # successive reports with a lower rate of this topic
        self._waiting = ''  # the missing topics that were logged last, '' if none is missing

    def __contains__(self, topic: object) -> bool:
        return topic in self._topics

    def add(self, *topics: str) -> None:
        """Add topics, to report them while they are missing or silent."""
        self._topics += topics

    def expect_rate(self, topic: str, rate: float) -> None:
        """Expect a rate [Hz] of one topic, and warn while its rate is below SLOW times `rate`."""
        self._expected = topic, rate

    def remove(self, topic: str) -> None:
        """Remove a topic, which is then no longer reported as missing, silent or slow."""
        self._topics = [other for other in self._topics if other != topic]

    def check_rates(self) -> None:
        """Check the newest rate against the expected one; log which topics are missing.

        Call this once for each periodic report. A topic without any message is silent, not slow.
        """
        if self._expected is not None:
            topic, rate = self._expected
            is_slow = 0.0 < self._reception.arrivals[topic].rate < SLOW * rate
            self._slow_reports = self._slow_reports + 1 if is_slow else 0
        self._log_missing()

    def conditions(self) -> Iterator[Condition]:
        """Yield which topics are silent, missing or slow.

        A silent topic also silences the topics after it in the data flow. Only the first silent
        topic therefore has a remedy.
        """
        has_remedy = False
        for topic in sorted(self._topics, key=[*STREAMS, *self._topics].index):
            is_missing = not self._reception.arrivals[topic].was_used
            is_silent = self._is_silent(topic)
            if not (is_silent or is_missing):
                continue
            steps = () if has_remedy else self._remedy(topic)
            has_remedy = has_remedy or topic in STREAMS
            if is_silent:
                silence = self._reception.arrivals[topic].age(time.monotonic())
                detail = with_load(f'no usable {topic} for {silence:.0f} s')
                if self._reception.last_rejected.startswith(f'{topic}: '):
                    detail += f'; last rejected: {self._reception.last_rejected}'
                yield ConditionKind.SILENT_TOPIC.condition(detail, [topic], steps=steps)
            else:
                level: Level = 'warn' if topic in STREAMS else 'ok'
                detail = self._missing_text(topic)
                kind = ConditionKind.MISSING_TOPIC
                yield kind.condition(detail, [topic], level=level, steps=steps)
        if self._expected is not None and self._slow_reports >= SLOW_REPORTS:
            topic, expected = self._expected
            rate = self._reception.arrivals[topic].rate
            detail = f'{topic} come at {rate:.0f} Hz instead of {expected:g} Hz'
            yield ConditionKind.SLOW_TOPIC.condition(with_load(detail), [topic])

    def _remedy(self, topic: str) -> tuple[Step, ...]:
        """Return the step that ends the silence of a topic; none if another node reports it.

        A running estimator itself reports why it publishes no estimates.
        """
        publishers = self._publishers(topic)
        if set(publishers) == {REPLAY}:
            return (Step.CHECK_REPLAY,)
        if topic not in STREAMS or (topic != 'muscle_states' and publishers):
            return ()
        return (STREAMS[topic],)

    def _publishers(self, topic: str) -> list[str]:
        """Return the names of the nodes that publish a topic."""
        name = self._full_name(topic)
        return [each.node_name for each in self._node.get_publishers_info_by_topic(name)]

    def _missing_text(self, topic: str) -> str:
        name = self._full_name(topic)
        if self._node.count_publishers(name) > 0:
            return f'{name}, on which no usable message has arrived'
        return f'{name}, which has no publisher'

    def _log_missing(self) -> None:
        """Log which topics lack a usable message, and why, whenever this changes."""
        arrivals = self._reception.arrivals
        missing = [topic for topic in self._topics if not arrivals[topic].was_used]
        reasons = [self._missing_text(topic) for topic in missing]
        # Remove duplicates, because one topic may carry both joint angles and motors.
        before, self._waiting = self._waiting, '; '.join(dict.fromkeys(reasons))
        if self._waiting != before:
            text = f'waiting for {self._waiting}' if reasons else 'receiving all needed topics'
            self._node.get_logger().info(text)

    def _is_silent(self, topic: str) -> bool:
        """Return whether no usable message of a stream has arrived for longer than SILENCE.

        A stream without a publisher that has never had a usable message is missing, not silent.
        """
        arrival = self._reception.arrivals[topic]
        if topic not in STREAMS or arrival.age(time.monotonic()) <= SILENCE:
            return False
        is_published = self._node.count_publishers(self._full_name(topic)) > 0
        return arrival.was_used or is_published
