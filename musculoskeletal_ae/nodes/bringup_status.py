# SPDX-License-Identifier: Apache-2.0
"""The node `bringup_status`: prints one line a second about a running arm, for `bringup.sh`.

joint_states, estimated_joint_states, anomaly, /diagnostics → stdout. This node's own report on
/diagnostics summarizes the whole arm and has the level of the worst node.
"""

import math
import sys
import time
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import Float64

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import printable
from musculoskeletal_ae.nodes.messages import RELIABLE, SENSOR
from musculoskeletal_ae.nodes.shell import STEADY, Shell
from musculoskeletal_ae.nodes.situation import LARGEST_AGE, Situation, figures
from musculoskeletal_ae.report import OVERLOADED, Report, overload_text

#: time after the first estimate during which problems are not shown, because most of them end by
#: themselves while the nodes start [s]
SETTLING = 4.0
#: shortest time between two lines before the first estimate [s]
WAITING_INTERVAL = 5.0
LAST_REPORT_WAIT = 5.0  # longest wait for the learner's report after the end of a recording [s]


class BringupStatus(Shell):
    """Prints the estimation error, the anomaly measure A, and counts of samples and checkpoints."""

    # The node is not watched for progress, because printing blocks while a terminal is paused.
    is_watched = False

    def __init__(self, **options: Any) -> None:
        super().__init__('bringup_status', **options)
        self.duration: float = self.parameter('duration')
        self.patience: float = self.parameter('patience')
        self.begun = time.monotonic()
        #: time of arrival [s] and θ of the newest joint_states; θ is None before the first message
        self.measured: tuple[float, Array | None] = -math.inf, None
        self.errors: list[float] = []
        self.anomalies: list[float] = []
        self.situation = Situation(
            self.get_namespace(), expects_replay=self.parameter('end_with_replay')
        )
        self.last_known = [math.nan, math.nan]  # last estimation error and A in a status line
        self.started: float | None = None
        self.ended: float | None = None  # when the end of the recording was first reported [s]
        #: the last line before the first estimate, and whether it named an overload
        self.waiting = '', False
        self.waiting_since = -math.inf  # when it was printed [s]
        self.printed_hint = ''
        self.follow_posture('joint_states', self._on_measured_posture, some=True)
        self.follow_posture('estimated_joint_states', self._on_estimate)
        self.listen(Float64, 'anomaly', lambda m: self.anomalies.append(m.data), SENSOR)
        self.listen(DiagnosticArray, '/diagnostics', self.situation.diagnosed, RELIABLE)
        self.create_timer(1.0, self._print, clock=STEADY)

    def _on_measured_posture(self, theta: Array) -> None:
        self.measured = time.monotonic(), theta

    @property
    def theta(self) -> Array | None:
        """Measured θ [rad], (D,); None if no message has arrived recently."""
        at, theta = self.measured
        return theta if time.monotonic() - at <= LARGEST_AGE else None

    def _on_estimate(self, theta: Array) -> None:
        if (measured := self.theta) is not None:
            self.errors.append(float(np.linalg.norm(np.nan_to_num(theta - measured))))

    def report(self) -> Report:
        """Return a report on the whole arm, with the level of the worst node."""
        self.situation.tick()
        return Report(self.situation.level(), self.situation.trouble() or 'all nodes are OK', {})

    def _print(self) -> None:
        now = time.monotonic()
        self.situation.tick()
        if self.started is None and not self.anomalies:
            if 0.0 < self.patience < now - self.begun:
                advice = '; '.join(filter(None, [overload_text(), 'see the logs of the nodes']))
                sys.exit(
                    f'the system did not come up: no estimate within {self.patience:g} s; {advice}'
                )
            self._end_with_replay()
            self._print_waiting(now)
            return
        self.started = self.started or now
        # Print nothing yet if there are problems: shortly after the start, the last reports of the
        # nodes still describe the time when they waited for messages.
        if now - self.started >= SETTLING or not self.situation.trouble():
            self._print_line(now - self.started)
        if 0.0 < self.duration <= now - self.started:
            raise ExternalShutdownException
        self._end_with_replay()

    def _end_with_replay(self) -> None:
        """End the node, if it is to end with the recording and `replay` has reported its end."""
        if not (self.parameter('end_with_replay') and self.situation.has_recording_ended):
            return
        if self.started is None:
            reason = self.situation.why_no_estimate()
            sys.exit(f'the recording brought no estimate: {reason}; see the logs of the nodes')
        self.ended = self.ended or time.monotonic()
        if not self.situation.has_last_report and time.monotonic() - self.ended < LAST_REPORT_WAIT:
            return
        if learned := self.situation.learned():
            print(f'-- {printable(learned)}', flush=True)
        raise ExternalShutdownException

    def _print_waiting(self, now: float) -> None:
        """Print that there is no estimate yet, and why; again if the reason has changed."""
        line = 'waiting for the first estimate'
        # Most problems end by themselves while the nodes start.
        is_settled = now - self.begun >= SETTLING
        waiting_replay = self.situation.replay_waits()
        reason = self.situation.why_no_estimate() if is_settled else waiting_replay
        if reason:
            line += f': {reason}'
        overload = overload_text() if is_settled else ''
        if OVERLOADED in line:  # a node has already said so
            overload = ''
        # The load itself changes all the time, which is no reason to print the line again.
        waiting = line, bool(overload)
        is_new = waiting_replay not in self.waiting[0]
        is_due = is_new or now - self.waiting_since >= WAITING_INTERVAL
        if waiting != self.waiting and is_due:
            self.waiting, self.waiting_since = waiting, now
            print(printable('; '.join(filter(None, [line, overload]))), flush=True)

    def _print_line(self, running_time: float) -> None:
        means = [sum(v) / len(v) if v else math.nan for v in (self.errors, self.anomalies)]
        unit = self.robot.kinematics.distance_unit
        situation = self.situation
        self.last_known = [
            old if math.isnan(new) else new for new, old in zip(means, self.last_known)
        ]
        if situation.has_recording_ended:  # no further messages are expected
            means = self.last_known
        known = figures(self.theta is not None, means[0], means[1], unit)
        self.errors, self.anomalies = [], []
        line = f'{running_time:6.0f} s  {known}'
        line += f'  samples {situation.samples or 0}  checkpoints {situation.checkpoints or 0}'
        parts = line, situation.unexplored(), situation.trouble()
        self._print_hint()
        print(printable('  '.join(filter(None, parts))), flush=True)

    def _print_hint(self) -> None:
        """Print the hint of the situation in a line of its own, once."""
        hint = self.situation.hint()
        if hint and hint != self.printed_hint:
            print(f'-- {printable(hint)}')
            self.printed_hint = hint
