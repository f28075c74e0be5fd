# SPDX-License-Identifier: Apache-2.0
"""Reports which of the topics that a node needs are missing, silent or slow."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping

from rclpy.node import Node

from musculoskeletal_ae.control.stops import StopCause
from musculoskeletal_ae.nodes.progress import LONGEST_STALL
from musculoskeletal_ae.reception import Reception
from musculoskeletal_ae.remedy import REMEDY_STEPS, Step
from musculoskeletal_ae.report import (
    MUSCLE_STATES,
    OVERLOADED,
    WAITS_FOR,
    Report,
    load_text,
    overload_advice,
)

#: topics that are published continually, so that silence is an error, and the remedy for silence
STREAMS = {'muscle_states': Step.CHECK_DRIVER, 'estimated_joint_states': Step.CHECK_ESTIMATOR}
EMULATOR = 'hardware_emulator'  # name of the node that emulates the driver and the arm
REPLAY = 'replay'  # name of the node that plays a recording
#: values of `waits for` of a report whose message already says that a stream is missing
WAITS = {
    'muscle_states': (MUSCLE_STATES, StopCause.STALE_MUSCLE_STATES.identifier),
    'estimated_joint_states': (StopCause.STALE_ESTIMATE.identifier,),
}
SILENT_TOPIC = 'silent topic'  # key of a value in reports
SILENCE = 1.0  # time without a usable message after which a stream is silent [s]
SLOW = 0.4  # fraction of the expected rate below which messages come too slowly
SLOW_REPORTS = 3  # number of successive reports with too low a rate before the node warns of it


def slow_cause(publishers: Iterable[str]) -> str:
    """Return why messages come too slowly, as a text for users.

    Args:
        publishers: Names of the nodes that publish the topic.
    """
    present = set(publishers)
    if present == {EMULATOR}:
        return f'{OVERLOADED} (load {load_text()}); stop other programs'
    if advice := overload_advice():
        return advice
    if present == {REPLAY}:
        return 'the recording is played slowly, or its messages are rare'
    return 'the driver is slow, or this computer is overloaded'


def silence_remedy(topic: str, silence: float, publishers: Iterable[str]) -> tuple[Step, str]:
    """Return the step against silence of a stream, and what to do as a text for users.

    Args:
        topic: The stream, one of STREAMS.
        silence: How long the stream has been silent [s].
        publishers: Names of the nodes that publish the topic.
    """
    step = STREAMS[topic]
    if set(publishers) == {REPLAY}:
        return Step.CHECK_REPLAY, Step.CHECK_REPLAY.text
    # A publisher that hangs ends by itself by this time, if it is a node of this package.
    if silence <= LONGEST_STALL and (advice := overload_advice()):
        return step, advice
    return step, step.text


class NeededTopics:
    """Reports missing, silent and slow topics of one node."""

    def __init__(self, node: Node, full_name: Callable[[str], str], reception: Reception) -> None:
        """Start without needed topics.

        Args:
            node: The node.
            full_name: Returns the full name of a topic in the graph.
            reception: The messages that the node has received.
        """
        self._node, self._full_name, self._reception = node, full_name, reception
        self._topics: list[str] = []
        self._expected_rates = dict[str, float]()  # [Hz], by topic
        self._slow_reports = Counter[str]()  # successive reports with a low rate, by topic
        self._waiting = ''  # the missing topics, as last logged

    def __contains__(self, topic: object) -> bool:
        return topic in self._topics

    def add(self, *topics: str) -> None:
        """Report these topics while they are missing or silent."""
        self._topics += topics

    def expect_rate(self, topic: str, rate: float) -> None:
        """Warn of a topic while its rate is lower than SLOW times `rate` [Hz]."""
        self._expected_rates[topic] = rate

    def remove(self, topic: str) -> None:
        """Stop reporting a topic."""
        self._topics = [other for other in self._topics if other != topic]

    def checked(self, report: Report, rates: Mapping[str, float]) -> Report:
        """Return a report that also names a silent stream and slow topics; log missing topics.

        Args:
            report: The report of the node.
            rates: Rate of used messages since the last report [Hz], by topic.
        """
        self._log_missing()
        return self._with_slowness(self._with_silence(report), rates)

    def _with_silence(self, report: Report) -> Report:
        """Return a report that also names a stream on which no usable message arrives."""
        silent = next(filter(self._is_silent, self._topics), None)
        if silent is None:
            return report
        silence = self._reception.silence(silent)
        step, advice = silence_remedy(silent, silence, self._publishers(silent))
        text = f'no usable {silent} for {silence:.0f} s: {advice}'
        steps = ', '.join(filter(None, [report.values.get(REMEDY_STEPS), step.identifier]))
        values = {**report.values, SILENT_TOPIC: text, REMEDY_STEPS: steps}
        is_known = report.values.get(WAITS_FOR) in WAITS[silent]
        return Report('error', text if is_known else f'{report.message}; {text}', values)

    def _publishers(self, topic: str) -> list[str]:
        """Return the names of the nodes that publish a topic."""
        name = self._full_name(topic)
        return [each.node_name for each in self._node.get_publishers_info_by_topic(name)]

    def _with_slowness(self, report: Report, rates: Mapping[str, float]) -> Report:
        """Return a report with a warning for each topic whose messages keep coming too slowly.

        A topic without any message is silent, not slow.
        """
        for topic, expected in self._expected_rates.items():
            rate = rates.get(topic, 0.0)
            is_slow = 0.0 < rate < SLOW * expected
            self._slow_reports[topic] = self._slow_reports[topic] + 1 if is_slow else 0
            if self._slow_reports[topic] >= SLOW_REPORTS:
                cause = slow_cause(self._publishers(topic))
                report = report.with_warning(
                    f'{topic} come at {rate:.0f} Hz instead of {expected:g} Hz: {cause}'
                )
        return report

    def _log_missing(self) -> None:
        """Log which topics lack a usable message, and why, whenever this changes."""
        reasons = []
        for topic in self._topics:
            if self._reception.was_used(topic):
                continue
            name = self._full_name(topic)
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
        """Return whether no usable message of a stream has arrived for longer than SILENCE.

        A stream without a publisher that has never had a usable message is missing, not silent.
        """
        if topic not in STREAMS or self._reception.silence(topic) <= SILENCE:
            return False
        is_published = self._node.count_publishers(self._full_name(topic)) > 0
        return self._reception.was_used(topic) or is_published
