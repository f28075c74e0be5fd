# SPDX-License-Identifier: Apache-2.0
"""How a running arm is, from what all nodes say of themselves on /diagnostics."""

import contextlib
import math

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

OLD = 1.0  # [s] after which something that moves is no longer shown
TOLD = 'stopped', 'anomaly detected'  # errors that are told with what to do


def figures(measured: bool, error: float, anomaly: float) -> str:
    """Return error [rad] and A, or what those that are NaN wait for; `measured`: θ is."""
    joints = 'estimated_joint_states' if measured else 'joint_states'
    told = f'waits for {joints}' if math.isnan(error) else f'{error:.3f} rad'
    return f'error {told}  A {"waits for anomaly" if math.isnan(anomaly) else f"{anomaly:.3f}"}'


class Situation:
    """What the newest diagnostics of one namespace said, and what to do about it."""

    def __init__(self, namespace: str) -> None:
        self._here = namespace.rstrip('/')
        self.detected = self.explored = self._verifying = False
        self._failing: dict[str, str] = {}  # what nodes report as any other error
        self.samples = self.checkpoints = self.suspect = self.doing = self.stopped = ''
        self.distance = self.limit = math.nan  # d of the detector, and what is an anomaly

    def diagnosed(self, message: DiagnosticArray) -> None:
        """Take a message of /diagnostics."""
        for status in message.status:
            node, _, _ = status.name.partition(':')
            values = {value.key: value.value for value in status.values}
            if node.rpartition('/')[0] == self._here:
                failing = status.level == DiagnosticStatus.ERROR
                failing &= not status.message.startswith(TOLD)
                self._failing[node] = status.message if failing else ''
            if node == f'{self._here}/learner':
                self.samples = values.get('samples', '')
                self.checkpoints = values.get('checkpoints', '')
            elif node == f'{self._here}/estimator':
                self.suspect = values.get('suspect muscle', '')
                self._verifying = values.get('verification') == 'running'
                self.distance = self.limit = math.nan
                with contextlib.suppress(ValueError):
                    self.distance = float(values.get('d', 'nan'))
                    self.limit = float(values.get('d limit', 'nan'))
            elif node == f'{self._here}/controller':
                self.doing = status.message
                self.stopped = self.doing if self.doing.startswith('stopped') else ''
                if not self.stopped:
                    self.explored = 'exploring' in (self.doing, values.get('doing'))

    def trouble(self) -> str:
        """Return what keeps the arm from going on, and every step that is to be taken."""
        told, steps = [], []
        verifying = self.detected and self._verifying
        if verifying:
            told.append(f'ANOMALY: {self.suspect} is being verified')
        elif self.detected:
            told.append(f'ANOMALY: {self.suspect}')
            steps += ['mend it', 'estimator/reset']
        if self.stopped and not (verifying and 'anomaly_detected' in self.stopped):
            told.append(self.stopped.replace('stopped', 'STOPPED', 1))
            steps += ['controller/reset', *['controller/explore'] * self.explored]
        if steps:
            told[-1] += f' (to go on: {", ".join(steps)})'
        told += [f'{node}: {message}' for node, message in self._failing.items() if message]
        return ', '.join(told)

    def hint(self) -> str:
        """Return why the error may rise before anything is learned, '' once something is."""
        why = 'nothing learned yet: the error may rise while the arm leaves its first posture'
        return why if self.samples == '0' else ''  # '' without a learner
