# SPDX-License-Identifier: Apache-2.0
"""The node `bringup_status`: prints one line a second about a running arm, for `bringup.sh`.

joint_states, estimated_joint_states, anomaly, /diagnostics → stdout. This node's own report on
/diagnostics summarizes the whole arm and has the level of the worst node.
"""

import math
import sys
import time
from collections.abc import Iterable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import Float64

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.exceptions import printable
from musculoskeletal_ae.messages.arrival import SILENCE
from musculoskeletal_ae.nodes.reported_conditions import Situation, figures, nodes_in_graph
from musculoskeletal_ae.nodes.shell import STEADY, Shell
from musculoskeletal_ae.options import CLOSED
from musculoskeletal_ae.output import is_reader_gone
from musculoskeletal_ae.report import (
    END_OF_RECORDING,
    NOT_WAITED_FOR,
    WAITING,
    Report,
    overload_note,
    with_load,
)
from musculoskeletal_ae.ros.diagnostics import LAST_REJECTED
from musculoskeletal_ae.ros.message_building import RELIABLE, SENSOR

#: hide problems for this time after the start and after the first estimate, because most of them
#: end by themselves while the nodes start [s]
SETTLING = 4.0
WAITING_INTERVAL = 5.0  # wait at least this long between two lines before the first estimate [s]
#: wait at most this long for the learner's report after the end of a recording [s]
LAST_REPORT_WAIT = 5.0


class BringupStatusNode(Shell):
    """Prints the estimation error, the anomaly measure A, and counts of samples and checkpoints."""

    # The node is not watched for progress, because printing blocks while a terminal is paused.
    is_watched = False

    def __init__(self, **options: Any) -> None:
        super().__init__('bringup_status', **options)
        self.duration: float = self.parameter('duration')
        self.patience: float = self.parameter('patience')
        self.begun = time.monotonic()
        #: θ of the newest joint_states [rad], (D,); None before the first message
        self.measured: Array | None = None
        self.errors: list[Array] = []  # θ_est − θ of new estimates [rad], (D,) each
        self.anomalies: list[float] = []
        self.situation = Situation(
            self.get_namespace(),
            lambda: nodes_in_graph(self),
            lambda: self.awake.at(time.monotonic()),
        )
        #: last known error, as text, and last known A of the status lines
        self.last_known = ('', math.nan)
        self.started: float | None = None
        self.ended: float | None = None  # when the end of the recording was first reported [s]
        #: arrival of the report with this end, as `Situation.heard_at` states it [s]
        self.ended_report = math.inf
        #: the last line that was printed before the first estimate, and whether it stated the load
        self.waiting = '', False
        self.waiting_at = -math.inf  # time at which the line 'waiting for …' was printed last [s]
        self.printed_hint = ''
        self.follow_posture('joint_states', self._on_measured_posture, some=True)
        self.follow_posture('estimated_joint_states', self._on_estimate)
        self.listen(Float64, 'anomaly', lambda m: self.anomalies.append(m.data), SENSOR)
        self.listen(DiagnosticArray, '/diagnostics', self.situation.diagnosed, RELIABLE)
        self.create_timer(1.0, self._print, clock=STEADY)

    def _on_measured_posture(self, theta: Array) -> None:
        self.measured = theta

    @property
    def theta(self) -> Array | None:
        """Measured θ [rad], (D,); None if no message has arrived recently."""
        is_recent = self._reception.arrivals['joint_states'].age(time.monotonic()) <= SILENCE
        return self.measured if is_recent else None

    def _on_estimate(self, theta: Array) -> None:
        if (measured := self.theta) is not None:
            self.errors.append(theta - measured)

    def conditions(self) -> Iterable[Condition]:
        """Yield the conditions of all nodes; this node reports the level of the worst of them."""
        yield from super().conditions()
        yield from (each.condition for each in self.situation.conditions())

    def status(self) -> Report:
        """Return the report 'all nodes are OK', or one without a text while there is trouble."""
        self.situation.forget_ended()
        return Report('' if self.situation.trouble() else 'all nodes are OK', {})

    def _print(self) -> None:
        if is_reader_gone():  # ends the whole run, which nobody would see any more
            sys.exit(CLOSED)
        now = time.monotonic()
        self.situation.forget_ended()
        if self.started is None and not self.anomalies:
            if 0.0 < self.patience < now - self.begun:
                what = with_load(f'no estimate within {self.patience:g} s')
                sys.exit(f'the system did not come up: {what}; see the logs of the nodes')
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
        if not (self.parameter('end_with_replay') and self._has_recording_ended):
            return
        if self.started is None:
            reason = self._why_no_estimate()
            sys.exit(f'the recording led to no estimate: {reason}; see the logs of the nodes')
        if self.ended is None:
            self.ended = time.monotonic()
            self.ended_report = self.situation.heard_at('replay')
        # The learner reports what it has learned from the last messages.
        has_last_report = self.situation.heard_at('learner') > self.ended_report
        is_waiting = self.situation.has_learner and not has_last_report
        if is_waiting and time.monotonic() - self.ended < LAST_REPORT_WAIT:
            return
        if learned := self._learned():
            print(f'-- {printable(learned)}', flush=True)
        raise ExternalShutdownException

    @property
    def _has_recording_ended(self) -> bool:
        return self.situation.values('replay').get('state') == END_OF_RECORDING

    def _why_replay_waits(self) -> str:
        """Return what the replay waits for before it begins to play, or ''."""
        if self.situation.values('replay').get('state') != WAITING:
            return ''
        return ', '.join(
            each.condition.text
            for each in self.situation.conditions()
            if each.condition.identifier == ConditionKind.REPLAY_STANDS.identifier
        )

    def _why_no_estimate(self) -> str:
        """Return the message that the estimator rejected last; if there is none, all problems."""
        rejected = self.situation.values('estimator').get(LAST_REJECTED, '')
        return f'rejected {rejected}' if rejected else self.situation.trouble()

    def _learned(self) -> str:
        """Return how many samples of a recording were learned, as a text; '' without a learner.

        If nodes may have missed messages, the text says so, with the remedy.
        """
        if not self.situation.has_learner:
            return ''
        samples = self.situation.count('samples')
        postures = 'resting posture' if samples == '1' else 'resting postures'
        text = f'learned from {samples} {postures} of the recording'
        if lost := self.situation.values('replay').get(NOT_WAITED_FOR):
            text += with_load(
                f'; {lost} may have missed messages, because the replay got no answer: see their '
                'logs, and play the recording again, or use train --from-bag, which loses none'
            )
        return text

    def _print_waiting(self, now: float) -> None:
        """Print that there is no estimate yet, and why; again if the reason has changed."""
        # State problems only after SETTLING, because most end by themselves while the nodes start.
        is_settled = now - self.begun >= SETTLING
        reason = self._why_no_estimate() if is_settled else self._why_replay_waits()
        line = ': '.join(filter(None, ['waiting for the first estimate', reason]))
        # The load itself changes all the time, which is no reason to print the line again.
        is_new = bool(waits := self._why_replay_waits()) and waits not in self.waiting[0]
        is_due = is_new or now - self.waiting_at >= WAITING_INTERVAL
        note = overload_note() if is_settled else ''
        if (line, bool(note)) != self.waiting and is_due:
            self.waiting, self.waiting_at = (line, bool(note)), now
            print(printable('; '.join(filter(None, [line, note]))), flush=True)

    def _print_line(self, running_time: float) -> None:
        units, situation = self.robot.units, self.situation
        error = units.error_text(np.array(self.errors), '.3f') if self.errors else ''
        anomaly = sum(self.anomalies) / len(self.anomalies) if self.anomalies else math.nan
        before = self.last_known
        self.last_known = error or before[0], before[1] if math.isnan(anomaly) else anomaly
        if self._has_recording_ended:  # no further messages are expected
            error, anomaly = self.last_known
        known = figures(self.theta is not None, error, anomaly)
        self.errors, self.anomalies = [], []
        line = f'{running_time:6.0f} s  {known}'
        samples, checkpoints = situation.count('samples'), situation.count('checkpoints')
        line += f'  samples {samples}  checkpoints {checkpoints}'
        parts = line, situation.unexplored(), situation.trouble()
        self._print_hint()
        print(printable('  '.join(filter(None, parts))), flush=True)

    def _print_hint(self) -> None:
        """Print once, in a line of its own, why the error may rise before learning begins."""
        hint = self.situation.hint()
        if hint and hint != self.printed_hint:
            print(f'-- {printable(hint)}', flush=True)
            self.printed_hint = hint
