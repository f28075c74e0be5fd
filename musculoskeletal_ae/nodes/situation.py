# SPDX-License-Identifier: Apache-2.0
"""Reads what the nodes of one arm report on /diagnostics.

The nodes decide what is true; this module collects, sorts and prints their conditions. It adds one
fact that a node cannot report itself: that a node has ended, or does not report any more.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node as RosNode

from musculoskeletal_ae import conditions
from musculoskeletal_ae.conditions import CONDITIONS, KINDS, LEVELS, Condition, ConditionKind, Level
from musculoskeletal_ae.control.supervisor import Activity, StopState
from musculoskeletal_ae.remedy import Step, sentence
from musculoskeletal_ae.report import with_load
from musculoskeletal_ae.ros.diagnostics import NODE_SILENCE

#: forget other nodes than NEEDED without a report for this time [s]; it exceeds NODE_SILENCE,
#: because nodes of other packages may report less often
FORGET_TIME = 5.0
#: nodes that should not end, once they have reported
NEEDED = 'controller', 'estimator', 'hardware_emulator', 'learner', 'sim'
OTHER = 'other_report'  # identifier of a report that lists no conditions
SUMMARY = 'bringup_status'  # node that repeats the conditions of all others
#: modes in which a running arm does not explore
NOT_EXPLORING = {
    each.value for each in Activity if each not in (Activity.EXPLORING, Activity.CALIBRATING)
}
SHOWN_LEVELS: dict[Level, str] = {'error': 'ERROR', 'warn': 'warning', 'ok': 'note'}


def figures(measured: bool, error: str, anomaly: float) -> str:
    """Return the estimation error and the anomaly measure A as text.

    For an unknown value, the text names the topic on which messages are missing.

    Args:
        measured: Whether joint sensors measure θ.
        error: Estimation error as text; '' if it is unknown.
        anomaly: A; NaN if it is unknown.
    """
    joints = 'estimated_joint_states' if measured else 'joint_states'
    error_text = error or f'waits for {joints}'
    anomaly_text = 'waits for anomaly' if math.isnan(anomaly) else f'{anomaly:.3f}'
    return f'error {error_text}  A {anomaly_text}'


def nodes_in_graph(node: RosNode) -> set[str]:
    """Return the full names of all nodes in the ROS graph, as `node` sees it."""
    names = node.get_node_names_and_namespaces()
    return {f'{namespace.rstrip("/")}/{name}' for name, namespace in names}


class NodeReport(NamedTuple):
    """What a node has last reported on /diagnostics."""

    values: dict[str, str]  # values that the node has reported, by name
    conditions: tuple[Condition, ...]
    message: str
    heard_at: float  # time of arrival, excluding pauses of this process [s]


class Reported(NamedTuple):
    """A condition, with the names of the nodes that report it."""

    nodes: tuple[str, ...]
    condition: Condition

    def __str__(self) -> str:
        level = SHOWN_LEVELS[self.condition.level]
        text = f'{level}: {", ".join(self.nodes)}: {self.condition.text}'
        steps = self.condition.steps
        return f'{text} (to end it: {sentence(steps)})' if steps else text


class Situation:
    """The newest report of each node in one namespace."""

    def __init__(
        self,
        namespace: str,
        graph: Callable[[], Collection[str]] = frozenset,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start without reports.

        Args:
            namespace: The namespace of the arm.
            graph: Returns the full names of the nodes in the ROS graph. It is called only while a
                node is silent.
            clock: Returns the time, excluding pauses of this process [s] (`AwakeClock`).
        """
        self._clock, self._graph = clock, graph
        self._here = namespace.rstrip('/')
        self._reports: dict[str, NodeReport] = {}  # by the name of the node, without namespace

    def forget_ended(self) -> None:
        """Forget the reports of nodes that may end at any time, and have ended."""
        now = self._clock()
        for name, report in list(self._reports.items()):
            if name not in NEEDED and now - report.heard_at > FORGET_TIME:
                del self._reports[name]

    def diagnosed(self, message: DiagnosticArray) -> None:
        """Store the reports that a message of /diagnostics contains."""
        for status in message.status:
            full_name, _, _ = status.name.partition(':')
            namespace, _, name = full_name.rpartition('/')
            if namespace == self._here and name != SUMMARY:
                values = {value.key: value.value for value in status.values}
                present = conditions.from_json(values.get(CONDITIONS, '[]'))
                level = LEVELS[min(ord(status.level), len(LEVELS) - 1)]
                if level != 'ok' and not present:  # a node of another package, such as a driver
                    present = (Condition(OTHER, level, status.message, (), (name,)),)
                self._reports[name] = NodeReport(values, present, status.message, self._clock())

    def values(self, name: str) -> dict[str, str]:
        """Return the values that a node has reported; {} if it has not reported."""
        report = self._reports.get(name)
        return {} if report is None else report.values

    def heard_at(self, name: str) -> float:
        """Return when the last report of a node arrived [s]; -inf if it has not reported."""
        report = self._reports.get(name)
        return -math.inf if report is None else report.heard_at

    def conditions(self) -> list[Reported]:
        """Return all conditions in the order in which users read them.

        Conditions of the same kind and with the same subjects, from several nodes, are one.
        """
        merged = dict[tuple[str, tuple[str, ...]], Reported]()
        for name, condition in self._all():
            key = condition.identifier, condition.subjects
            if key not in merged:
                merged[key] = Reported((name,), condition)
                continue
            names, other = merged[key]
            names = names if name in names else (*names, name)
            first, second = conditions.ordered([other, condition])
            steps = conditions.remedy_of([first, second])
            merged[key] = Reported(names, first._replace(steps=steps))
        order = conditions.ordered(each.condition for each in merged.values())
        return [merged[each.identifier, each.subjects] for each in order]

    def _all(self) -> list[tuple[str, Condition]]:
        """Return each condition with the node that reports it."""
        return [
            *self._lost_nodes(),
            *((name, each) for name, report in self._reports.items() for each in report.conditions),
        ]

    def _lost_nodes(self) -> list[tuple[str, Condition]]:
        silent = self.silent_nodes()
        present = self._graph() if silent else ()
        lost = []
        for name, silence in silent.items():
            is_present = f'{self._here}/{name}' in present
            kind = ConditionKind.NODE_SILENT if is_present else ConditionKind.NODE_ENDED
            detail = with_load(f'no report for {silence:.0f} s')
            lost.append((name, kind.condition(detail, [name])))
        return lost

    def silent_nodes(self) -> dict[str, float]:
        """Return the time [s] since the last report of each needed node that is silent, by name."""
        now = self._clock()
        needed = {name: each for name, each in self._reports.items() if name in NEEDED}
        silence = {name: now - each.heard_at for name, each in needed.items()}
        return {name: age for name, age in silence.items() if age > NODE_SILENCE}

    def level(self) -> Level:
        """Return the level of the whole arm: that of the worst condition."""
        return conditions.worst(condition for _, condition in self._all())

    def trouble(self) -> str:
        """Return all warnings and errors with their remedies as one text; '' if there are none.

        While there are some, the text also contains the notes that state what to do.
        """
        present = self.conditions()
        if not any(each.condition.level != 'ok' for each in present):
            return ''
        shown = (each for each in present if each.condition.level != 'ok' or each.condition.steps)
        return ' | '.join(map(str, shown))

    def steps(self) -> list[Step]:
        """Return the steps that end all conditions, in order."""
        return list(conditions.remedy_of(each.condition for each in self.conditions()))

    # -- single facts ---------------------------------------------------------------------------

    @property
    def suspects(self) -> tuple[str, ...]:
        """Names of the muscles and joints in which the estimator has found a fault."""
        estimator = self._reports.get('estimator')
        present = () if estimator is None else estimator.conditions
        kinds = [(KINDS.get(each.identifier), each.subjects) for each in present]
        found = (names for kind, names in kinds if kind is not None and kind.reaction is not None)
        return tuple(name for names in found for name in names)

    @property
    def detected(self) -> bool:
        """Whether the estimator has detected an anomaly."""
        return any(
            (kind := KINDS.get(each.condition.identifier)) is not None
            and kind.reaction is not None
            and each.condition.level == 'error'
            for each in self.conditions()
        )

    @property
    def doing(self) -> str:
        """What the controller does, or why the arm stands still; '' without a controller."""
        controller = self._reports.get('controller')
        return '' if controller is None else controller.message

    @property
    def is_stopped(self) -> bool:
        """Whether the controller reports that it is stopped."""
        return self.values('controller').get('mode') == StopState.STOPPED.value

    @property
    def has_learner(self) -> bool:
        """Whether a learner has reported, so that the arm may learn."""
        return 'learner' in self._reports

    def number(self, node: str, key: str) -> float:
        """Return the number that a node has reported as `key`; NaN if it is unknown."""
        try:
            return float(self.values(node).get(key, 'nan'))
        except ValueError:
            return math.nan

    def count(self, key: str) -> str:
        """Return the count that the learner has reported as `key`; '0' without a learner."""
        return self.values('learner').get(key, '0')

    def hint(self) -> str:
        """Return why the error may rise before learning begins; '' once learning has begun."""
        values = self.values('learner')
        if not self.has_learner or values.get('network learned') == 'True':
            return ''
        needed, samples = values.get('samples to begin with', '1'), self.count('samples')
        if not samples.isdecimal() or int(samples) >= int(needed):
            return ''
        why = 'nothing learned yet: the error may rise'
        return why if needed == '1' else f'{why}; learning begins with {needed} samples'

    def unexplored(self) -> str:
        """Return that the arm does not explore although there is a learner, with its mode; or ''.

        The text is '' if a condition says the same.
        """
        mode = self.values('controller').get('mode')
        advised = {Step.EXPLORE, Step.EXPLORE_GENTLY}.intersection(self.steps())
        if not self.has_learner or mode not in NOT_EXPLORING or advised:
            return ''
        return f'{mode}, not exploring'
