# SPDX-License-Identifier: Apache-2.0
"""How a running arm is, from what all nodes report on /diagnostics.

The situation is as bad as the worst of all nodes, and a node that no longer reports is an error.
Only identifiers are compared, such as the controller's values `mode` and `stop cause`. Sentences
are shown as they are.
"""

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from musculoskeletal_ae.control.stops import EXPLORE, REPAIR, ZERO, StopCause
from musculoskeletal_ae.control.supervisor import Activity, StopState
from musculoskeletal_ae.nodes.sources import SEVERAL
from musculoskeletal_ae.report import Level

OLD = 1.0  # [s] after which something that moves is no longer shown
#: [s] without a report after which a node counts as silent; nodes report once a second
SILENT = 2.0
#: [s] between two ticks, and the most that counts as such: our own pause makes no node silent
TICK, LONGEST_TICK = 1.0, 1.5
FORGOTTEN = 5.0  # [s] without a report after which any other node no longer counts
#: nodes whose silence is an error, once they were heard of
NEEDED = 'controller', 'estimator', 'hardware_emulator', 'learner', 'sim'
FOLLOWERS = 'controller', 'sim'  # nodes that use the network that the estimator has accepted
VERSION = 'checkpoint version'
#: reports, one a second, in which the estimator's earlier networks are no mismatch, and after which
#: another network is one
REPORTS = 3

STOPPED, VERIFYING = StopState.STOPPED.value, StopState.VERIFYING.value
ACTIVITIES = {activity.value for activity in Activity}
EXPLORING = Activity.EXPLORING.value, Activity.CALIBRATING.value


def figures(measured: bool, error: float, anomaly: float, unit: str = 'rad') -> str:
    """Return error and A, or what those that are NaN wait for; `measured`: θ is."""
    joints = 'estimated_joint_states' if measured else 'joint_states'
    told = f'waits for {joints}' if math.isnan(error) else f'{error:.3f} {unit}'
    return f'error {told}  A {"waits for anomaly" if math.isnan(anomaly) else f"{anomaly:.3f}"}'


class Node:
    """What one node has reported last.

    Attributes:
        level: Of the report.
        message: For people.
        values: By name.
        heard_at: When, not counting our own pauses [s].
    """

    def __init__(self, status: DiagnosticStatus, heard_at: float) -> None:
        self.level: bytes = status.level
        self.message: str = status.message
        self.values = {value.key: value.value for value in status.values}
        self.heard_at = heard_at


class Situation:
    """What the newest diagnostics of one namespace reported, and what to do about it.

    Attributes:
        detected: Whether the estimator has detected an anomaly.
        suspect: Name of the muscle that the estimator suspects most, or ''.
        distance: d of the anomaly detector; NaN where it is unknown.
        limit: The d above which a message is an anomaly; NaN where it is unknown.
        samples: Number of samples learned, or '' without a learner.
        checkpoints: Number of networks published, or '' without a learner.
        doing: What the controller does, for people.
    """

    def __init__(self, namespace: str, clock: Callable[[], float] = time.monotonic) -> None:
        """Nothing has been reported yet; `clock` is a steady one [s]."""
        self._clock = clock
        self._here = namespace.rstrip('/')
        self.detected = False
        self.samples = self.checkpoints = self.suspect = self.doing = ''
        self.distance = self.limit = math.nan
        self._nodes: dict[str, Node] = {}  # by full name
        self._has_explored = False  # before it stopped
        self._accepted: deque[str] = deque(maxlen=REPORTS)  # the estimator's last versions
        self._other_networks: dict[str, tuple[str, int]] = {}  # version and for how many reports
        self._ticked_at, self._slept = math.nan, 0.0  # [s]

    def tick(self) -> None:
        """Let time pass: call it about once a second, before `trouble` and `level`."""
        now = self._clock()
        elapsed = now - self._ticked_at
        if elapsed > LONGEST_TICK:  # what was sent meanwhile is still to be read
            self._slept += elapsed - TICK
        self._ticked_at = now
        awake = now - self._slept
        for name, node in list(self._nodes.items()):  # what another node said last is over then
            if not _is_needed(name) and awake - node.heard_at > FORGOTTEN:
                del self._nodes[name]

    def diagnosed(self, message: DiagnosticArray) -> None:
        """Take a message of /diagnostics."""
        for status in message.status:
            full_name, _, _ = status.name.partition(':')
            namespace, _, name = full_name.rpartition('/')
            if namespace != self._here:
                continue
            node = self._nodes[full_name] = Node(status, self._clock() - self._slept)
            if name == 'learner':
                self.samples = node.values.get('samples', '')
                self.checkpoints = node.values.get('checkpoints', '')
            elif name == 'estimator':
                self._take_estimator(node.values)
                self._accepted.append(node.values.get(VERSION, ''))
            elif name == 'controller':
                self.doing = node.message
                if node.values.get('mode') in ACTIVITIES:
                    self._has_explored = node.values['mode'] in EXPLORING
            if name in FOLLOWERS:
                self._compare_network(name, node.values.get(VERSION, ''))

    def _take_estimator(self, values: dict[str, str]) -> None:
        self.detected = values.get('finding', 'none') != 'none'
        self.suspect = values.get('suspect muscle', '')
        self.distance = self.limit = math.nan
        with contextlib.suppress(ValueError):
            self.distance = float(values.get('d', 'nan'))
            self.limit = float(values.get('d limit', 'nan'))

    def _compare_network(self, node: str, version: str) -> None:
        """Note how long a node has used a network that the estimator does not use."""
        if not version or not self._accepted or version in self._accepted:
            self._other_networks.pop(node, None)
            return
        _, reports = self._other_networks.get(node, ('', 0))
        self._other_networks[node] = version, reports + 1

    def level(self) -> Level:
        """Return how bad it is: as bad as the worst of all nodes."""
        if self.detected or self._silent() or self._mismatches():
            return 'error'
        levels = [node.level for name, node in self._nodes.items() if not _is_own(name)]
        if any(level not in (DiagnosticStatus.OK, DiagnosticStatus.WARN) for level in levels):
            return 'error'
        return 'warn' if DiagnosticStatus.WARN in levels else 'ok'

    def trouble(self) -> str:
        """Return what keeps the arm from going on, every step that is to be taken, and warnings."""
        parts = [*self._stops(), *self._mismatches(), *self._silent()]
        errors, warnings = [], []
        for name, node in self._nodes.items():
            if _is_own(name) or node.level == DiagnosticStatus.OK:
                continue
            if self._is_shown(name, node):
                if refused := node.values.get('refused'):
                    warnings.append(f'warning: {name}: refused {refused}')
                continue
            if node.level == DiagnosticStatus.WARN:
                warnings.append(f'warning: {name}: {node.message}')
            else:
                errors.append(f'{name}: {node.message}')
        return ', '.join([*parts, *errors, *self._body(), *warnings])

    def _values(self, name: str) -> dict[str, str]:
        node = self._nodes.get(f'{self._here}/{name}')
        return {} if node is None else node.values

    def _is_shown(self, name: str, node: Node) -> bool:
        """Whether a report is shown otherwise: an anomaly, a stop, or isolated muscles."""
        if node.level == DiagnosticStatus.OK or 'fault' in node.values:
            return False
        if SEVERAL in node.values:  # the stop names them
            control = self._values('controller')
            is_stopped = control.get('stop cause') == StopCause.SECOND_PUBLISHER.identifier
            return is_stopped and node.values[SEVERAL] in control.get('stop', '')
        if name == f'{self._here}/controller':
            return node.values.get('mode') in (STOPPED, VERIFYING)
        if name == f'{self._here}/estimator':
            is_isolating = node.values.get('state') == 'isolated'
            return is_isolating if node.level == DiagnosticStatus.WARN else self.detected
        return False

    def _stops(self) -> list[str]:
        """Return the anomaly and the stop, each with what to do about it."""
        control = self._values('controller')
        mode, cause = control.get('mode'), control.get('stop cause')
        is_verifying = mode == VERIFYING
        is_stopped_by_anomaly = (
            mode in (STOPPED, VERIFYING) and cause == StopCause.ANOMALY.identifier
        )
        parts = []
        if self.detected and is_verifying:
            parts.append(f'ANOMALY: {self.suspect} is being verified')
        elif self.detected and is_stopped_by_anomaly:
            parts.append(f'ANOMALY: {self.suspect}')
        elif self.detected:
            parts.append(_with_remedy(f'ANOMALY: {self.suspect}', REPAIR))
        if mode == STOPPED or (is_verifying and not is_stopped_by_anomaly):
            remedy = control.get('remedy', '')
            if self._has_explored:
                remedy = f'{remedy}; {EXPLORE}'
            parts.append(_with_remedy(f'STOPPED: {control.get("stop", cause)}', remedy))
        return parts

    def _mismatches(self) -> list[str]:
        return [
            f'{node} uses network {version}, the estimator {self._accepted[-1]}: restart {node}'
            for node, (version, reports) in self._other_networks.items()
            if reports >= REPORTS
        ]

    def _silent(self) -> list[str]:
        """Return which nodes have stopped reporting, and for how long."""
        now = self._ticked_at - self._slept
        return [
            f'{name}: no report for {now - node.heard_at:.0f} s: see its log; start it again'
            for name, node in self._nodes.items()
            if now - node.heard_at > SILENT and _is_needed(name)
        ]

    def _body(self) -> list[str]:
        """Return what is not known of the body, or left out.

        The controller may not know zeros that the estimator takes for known: one that was started
        again takes those that were right at its first start.
        """
        values, parts = self._values('estimator'), []
        if isolated := values.get('isolated muscles'):
            parts.append(f'isolated: {isolated}')
        zeros = 'unknown length zeros'
        if unknown := values.get(zeros) or self._values('controller').get(zeros):
            parts.append(_with_remedy(f'length zeros unknown: {unknown}', ZERO))
        return parts

    @property
    def is_stopped(self) -> bool:
        """Whether the controller reports a stop that holds until it is reset."""
        return self._values('controller').get('mode') == STOPPED

    def hint(self) -> str:
        """Return why the error may rise before anything is learned, '' once something is."""
        values = self._values('learner')
        if self.samples == '' or values.get('network learned') == 'True':
            return ''
        needed = values.get('samples to begin with', '1')
        if not self.samples.isdecimal() or int(self.samples) >= int(needed):
            return ''
        why = 'nothing learned yet: the error may rise while the arm leaves its first posture'
        return why if needed == '1' else f'{why}; learning begins with {needed} samples'


def _is_needed(name: str) -> bool:
    """Whether a node's silence is an error."""
    return name.rpartition('/')[2] in NEEDED


def _is_own(name: str) -> bool:
    """Whether a node only repeats what others report."""
    return name.rpartition('/')[2] == 'bringup_status'


def _with_remedy(trouble: str, remedy: str) -> str:
    return f'{trouble} (to go on: {remedy})'
