# SPDX-License-Identifier: Apache-2.0
"""Reads what the nodes of arms report on /diagnostics.

The nodes decide what is true; this module collects, sorts and prints their conditions. It adds one
fact that no node can report of itself: that the node has ended, or does not report any more.
`Situation` has the reports of one arm, and `Arms` those of all arms in the ROS graph.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Collection
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node as RosNode

from musculoskeletal_ae import conditions
from musculoskeletal_ae.conditions import CONDITIONS, KINDS, LEVELS, Condition, ConditionKind, Level
from musculoskeletal_ae.control.supervisor import Activity
from musculoskeletal_ae.remedy_steps import Step, sentence
from musculoskeletal_ae.report import with_load
from musculoskeletal_ae.ros.diagnostics import IDENTITY, NODE_SILENCE, values_of

#: forget a node that is not in NEEDED after this time without a report [s]; the time exceeds
#: NODE_SILENCE, because nodes of other packages may report less often
FORGET_TIME = 5.0
#: nodes that should not end, once they have reported
NEEDED = 'controller', 'estimator', 'hardware_emulator', 'learner', 'sim'
OTHER = 'other_report'  # identifier of a report that lists no conditions
SUMMARY = 'bringup_status'  # node that repeats the conditions of all others
PAGE = 'page'  # value in the report of `view`: address of its page
#: let a list of arms link only to pages with such an address
ADDRESS = re.compile(r'https?://[^\s/]+')
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
    """The last report of a node on /diagnostics."""

    values: dict[str, str]  # values that the node has reported, by name
    conditions: tuple[Condition, ...]
    message: str
    heard_at: float  # time of arrival, by a clock that stands still in pauses of this process [s]


class Reported(NamedTuple):
    """A condition, with the names of the nodes that report it."""

    nodes: tuple[str, ...]
    condition: Condition

    def __str__(self) -> str:
        level = SHOWN_LEVELS[self.condition.level]
        text = f'{level}: {", ".join(self.nodes)}: {self.condition.text}'
        steps = self.condition.steps
        return f'{text} (to end it: {sentence(steps)})' if steps else text


class ArmSummary(NamedTuple):
    """One line about an arm, for a list of arms."""

    namespace: str  # '/' for the root
    level: Level
    text: str  # its most urgent warning or error; without any, what its controller does
    learned: str  # numbers of samples and networks; '' without a learner
    page: str  # address of its page; '' if there is none


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
        """Forget the reports of ended nodes, except for the nodes that an arm needs."""
        now = self._clock()
        for name, report in list(self._reports.items()):
            if name not in NEEDED and now - report.heard_at > FORGET_TIME:
                del self._reports[name]

    def diagnosed(self, message: DiagnosticArray) -> None:
        """Store the reports of this namespace that a message of /diagnostics contains."""
        for status in message.status:
            namespace, name = _node_of(status)
            if namespace == self._here:
                self.reported(name, status)

    def reported(self, name: str, status: DiagnosticStatus) -> None:
        """Store the report of the node `name` of this namespace."""
        if name == SUMMARY:
            return
        values = values_of(status)
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

        If several nodes report conditions of the same kind with the same subjects, they are merged.
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

    def summary(self) -> ArmSummary:
        """Return one line about the arm."""
        page = self.values('view').get(PAGE, '')
        page = page if ADDRESS.fullmatch(page) else ''
        learned = ''
        if self.has_learner:
            learned = f'samples {self.count("samples")} · networks {self.count("checkpoints")}'
        level, text = self.level(), self.doing or 'no controller'
        if self.has_ended:
            level, text = 'warn', 'all nodes have ended'
        elif level != 'ok':
            first, *others = [each for each in self.conditions() if each.condition.level != 'ok']
            further = f' (and {len(others)} more)' if others else ''
            text = f'{", ".join(first.nodes)}: {first.condition.text}{further}'
        return ArmSummary(self._here or '/', level, text, learned, page)

    # -- single facts ---------------------------------------------------------------------------

    @property
    def suspects(self) -> tuple[str, ...]:
        """Names of the muscles to which the estimator attributes a finding."""
        estimator = self._reports.get('estimator')
        present = () if estimator is None else estimator.conditions
        kinds = [(KINDS.get(each.identifier), each.subjects) for each in present]
        found = (names for kind, names in kinds if kind is not None and kind.reaction is not None)
        return tuple(name for names in found for name in names)

    @property
    def doing(self) -> str:
        """Activity of the controller, or why the arm stands still; '' without a controller."""
        controller = self._reports.get('controller')
        return '' if controller is None else controller.message

    @property
    def has_reported(self) -> bool:
        """Whether a node that an arm needs has reported."""
        return any(name in NEEDED for name in self._reports)

    @property
    def has_ended(self) -> bool:
        """Whether all nodes that have reported, and that an arm needs, have left the ROS graph."""
        needed = [name for name in self._reports if name in NEEDED]
        if not needed or len(self.silent_nodes()) < len(needed):
            return False
        present = self._graph()
        return not any(f'{self._here}/{name}' in present for name in needed)

    @property
    def has_learner(self) -> bool:
        """Whether a learner has reported. If none has, the arm does not learn."""
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
        why = 'nothing has been learned yet, so the error may rise'
        return why if needed == '1' else f'{why}; learning begins once there are {needed} samples'

    def unexplored(self) -> str:
        """Return a text if the arm does not explore although there is a learner, else ''.

        The text states the mode. It is also '' if a condition already advises to explore.
        """
        mode = self.values('controller').get('mode')
        advised = {Step.EXPLORE, Step.EXPLORE_GENTLY}.intersection(self.steps())
        if not self.has_learner or mode not in NOT_EXPLORING or advised:
            return ''
        return f'{mode}, not exploring'


class Arms:
    """The situations of all arms in the ROS graph, by namespace.

    A namespace has an arm if a controller, an estimator, a learner, a sim or a hardware emulator of
    this package has reported there.
    """

    def __init__(
        self,
        graph: Callable[[], Collection[str]] = frozenset,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start without arms; the arguments are those of `Situation`."""
        self._graph, self._clock = graph, clock
        self._situations: dict[str, Situation] = {}

    def diagnosed(self, message: DiagnosticArray) -> None:
        """Store the reports of all arms that a message of /diagnostics contains."""
        for status in message.status:
            namespace, name = _node_of(status)
            is_of_arm = name in NEEDED and IDENTITY in values_of(status)
            if is_of_arm or namespace in self._situations:
                self.situation(namespace).reported(name, status)

    def situation(self, namespace: str) -> Situation:
        """Return the situation of the arm in a namespace, which may not have reported yet."""
        key = namespace.rstrip('/')
        if key not in self._situations:
            self._situations[key] = Situation(key, self._graph, self._clock)
        return self._situations[key]

    def forget_ended(self) -> None:
        """Forget the reports of ended nodes, except for the nodes that an arm needs."""
        for situation in self._situations.values():
            situation.forget_ended()

    def summaries(self) -> list[ArmSummary]:
        """Return one line about each arm that has reported, sorted by namespace."""
        namespaces = sorted(self._situations, key=_with_padded_numbers)
        situations = [self._situations[namespace] for namespace in namespaces]
        return [each.summary() for each in situations if each.has_reported]


def _node_of(status: DiagnosticStatus) -> tuple[str, str]:
    """Return namespace and name of the node that a status describes; '' is the root namespace."""
    full_name, _, _ = status.name.partition(':')
    namespace, _, name = full_name.rpartition('/')
    return namespace, name


def _with_padded_numbers(namespace: str) -> str:
    """Return a key by which the namespace /arm2 comes before /arm10."""
    return re.sub(r'\d+', lambda number: number[0].zfill(9), namespace)
