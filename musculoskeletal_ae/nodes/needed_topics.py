# SPDX-License-Identifier: Apache-2.0
"""The topics that a node needs to work: which are missing, and which have fallen silent."""

from __future__ import annotations

import time
from collections.abc import Collection
from typing import TYPE_CHECKING

from musculoskeletal_ae.control.remedy import REMEDY_STEPS, Step
from musculoskeletal_ae.nodes.sources import SILENT_TOPIC
from musculoskeletal_ae.reception import Pauses, Reception
from musculoskeletal_ae.report import Report

if TYPE_CHECKING:
    from musculoskeletal_ae.nodes.shell import Shell

#: needed topics that are published continually, whose silence is therefore an error
STREAMS = {'muscle_states': Step.CHECK_DRIVER, 'estimated_joint_states': Step.CHECK_ESTIMATOR}
SILENCE = 1.0  # time without a usable message after which a stream is silent [s]


class NeededTopics:
    """Reports missing and silent topics of one node."""

    def __init__(self, node: Shell, reception: Reception) -> None:
        """Start without needed topics."""
        self._node, self._reception = node, reception
        self._topics: list[str] = []
        self._waiting = ''  # the missing topics, as last logged
        self._pauses = Pauses()

    def __contains__(self, topic: object) -> bool:
        return topic in self._topics

    def add(self, *topics: str) -> None:
        """Report these topics while they are missing or silent."""
        self._topics += topics

    def remove(self, topic: str) -> None:
        """Stop reporting a topic."""
        self._topics = [other for other in self._topics if other != topic]

    def with_silence(self, report: Report) -> Report:
        """Return a report that also names a stream on which no usable message arrives."""
        silent = next(filter(self._is_silent, self._topics), None)
        if self._pauses.excuse(time.monotonic()) or silent is None:
            return report
        step = STREAMS[silent]
        text = f'no usable {silent} for {self._reception.silence(silent):.0f} s: {step.text}'
        steps = ', '.join(filter(None, [report.values.get(REMEDY_STEPS), step.identifier]))
        values = {**report.values, SILENT_TOPIC: text, REMEDY_STEPS: steps}
        return Report('error', f'{report.message}; {text}', values)

    def log_missing(self, received: Collection[str]) -> None:
        """Log the topics that are not among the received ones, with the reason, on any change."""
        reasons = []
        for topic in self._topics:
            if topic in received:
                continue
            name = self._node.full_name(topic)
            has_publisher = self._node.count_publishers(name) > 0
            reasons.append(
                f'{name}, on which no usable message has arrived'
                if has_publisher
                else f'{name}, which has no publisher'
            )
        # Remove duplicates, because one topic may carry both joint angles and motors.
        before, self._waiting = self._waiting, '; '.join(dict.fromkeys(reasons))
        if self._waiting != before:
            text = f'waiting for {self._waiting}' if reasons else 'receiving all needed topics'
            self._node.get_logger().info(text)

    def _is_silent(self, topic: str) -> bool:
        """Return whether no usable messages arrive on a stream that was used or is published."""
        if topic not in STREAMS or self._reception.silence(topic) <= SILENCE:
            return False
        is_published = self._node.count_publishers(self._node.full_name(topic)) > 0
        return self._reception.was_used(topic) or is_published
