# SPDX-License-Identifier: Apache-2.0
"""How a running arm is, from what all nodes report on /diagnostics.

Only identifiers are compared, such as the controller's values `mode` and `stop cause`. Sentences
are shown as they are.
"""

import contextlib
import math
from collections import deque

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from musculoskeletal_ae.control.stops import EXPLORE, REPAIR, StopCause
from musculoskeletal_ae.control.supervisor import Activity, StopState

OLD = 1.0  # [s] after which something that moves is no longer shown
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


class Situation:
    """What the newest diagnostics of one namespace reported, and what to do about it.

    Attributes:
        detected: Whether an anomaly is detected; the topic anomaly_detected says so.
        suspect: Name of the muscle that the estimator suspects most, or ''.
        distance: d of the anomaly detector; NaN where it is unknown.
        limit: The d above which a message is an anomaly; NaN where it is unknown.
        samples: Number of samples learned, or '' without a learner.
        checkpoints: Number of networks published, or '' without a learner.
        doing: What the controller does, for people.
    """

    def __init__(self, namespace: str) -> None:
        self._here = namespace.rstrip('/')
        self.detected = False
        self.samples = self.checkpoints = self.suspect = self.doing = ''
        self.distance = self.limit = math.nan
        self._control: dict[str, str] = {}  # the values that the controller reports
        self._has_explored = False  # before it stopped
        self._errors: dict[str, str] = {}  # all other errors, by node
        self._accepted: deque[str] = deque(maxlen=REPORTS)  # the estimator's last versions
        self._other_networks: dict[str, tuple[str, int]] = {}  # version and for how many reports

    def diagnosed(self, message: DiagnosticArray) -> None:
        """Take a message of /diagnostics."""
        for status in message.status:
            node, _, _ = status.name.partition(':')
            namespace, _, name = node.rpartition('/')
            if namespace != self._here:
                continue
            values = {value.key: value.value for value in status.values}
            if name == 'learner':
                self.samples = values.get('samples', '')
                self.checkpoints = values.get('checkpoints', '')
            elif name == 'estimator':
                self._take_estimator(values)
                self._accepted.append(values.get(VERSION, ''))
            elif name == 'controller':
                self.doing = status.message
                self._take_controller(values)
            if name in FOLLOWERS:
                self._compare_network(name, values.get(VERSION, ''))
            # An anomaly and a stop are shown with what to do about them.
            is_shown = name in ('estimator', 'controller') and 'fault' not in values
            self._errors.pop(node, None)
            if status.level == DiagnosticStatus.ERROR and not is_shown:
                self._errors[node] = status.message

    def _take_estimator(self, values: dict[str, str]) -> None:
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

    def _take_controller(self, values: dict[str, str]) -> None:
        self._control = values
        if values.get('mode') in ACTIVITIES:
            self._has_explored = values['mode'] in EXPLORING

    def trouble(self) -> str:
        """Return what keeps the arm from going on, and every step that is to be taken."""
        mode, cause = self._control.get('mode'), self._control.get('stop cause')
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
            remedy = self._control.get('remedy', '')
            if self._has_explored:
                remedy = f'{remedy}; {EXPLORE}'
            parts.append(_with_remedy(f'STOPPED: {self._control.get("stop", cause)}', remedy))
        for node, (version, reports) in self._other_networks.items():
            if reports >= REPORTS:
                parts.append(
                    f'{node} uses network {version}, the estimator {self._accepted[-1]}: '
                    f'restart {node}'
                )
        parts += [f'{node}: {message}' for node, message in self._errors.items()]
        return ', '.join(parts)

    def hint(self) -> str:
        """Return why the error may rise before anything is learned, '' once something is."""
        why = 'nothing learned yet: the error may rise while the arm leaves its first posture'
        return why if self.samples == '0' else ''  # '' without a learner


def _with_remedy(trouble: str, remedy: str) -> str:
    return f'{trouble} (to go on: {remedy})'
