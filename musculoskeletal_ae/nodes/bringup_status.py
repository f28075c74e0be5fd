# SPDX-License-Identifier: Apache-2.0
"""The node `bringup_status`: one line a second about a running arm, for `bringup.sh`.

joint_states, estimated_joint_states, anomaly, anomaly_detected, mae_checkpoint, /diagnostics →
stdout.
"""

from __future__ import annotations

import math
import sys
import time
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import Bool, Float64, UInt8MultiArray

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import printable
from musculoskeletal_ae.nodes.qos import LATCHED, RELIABLE, SENSOR
from musculoskeletal_ae.nodes.shell import STEADY, Shell
from musculoskeletal_ae.nodes.situation import Situation


class BringupStatus(Shell):
    """Prints estimation error, A, samples learned and number of checkpoints."""

    def __init__(self, **options: Any) -> None:
        """Listen; options are those of Node."""
        super().__init__('bringup_status', **options)
        self.duration: float = self.parameter('duration')
        self.patience: float = self.parameter('patience')
        self.begun = time.monotonic()
        self.theta: Array | None = None
        self.errors: list[float] = []
        self.anomalies: list[float] = []
        self.situation = Situation(self.get_namespace())
        self.checkpoints = 0
        self.started: float | None = None
        self.follow_posture('joint_states', partial(setattr, self, 'theta'))
        self.follow_posture('estimated_joint_states', self._estimated)
        self.listen(Float64, 'anomaly', lambda m: self.anomalies.append(m.data), SENSOR)
        detected = partial(setattr, self.situation, 'detected')
        self.listen(Bool, 'anomaly_detected', lambda m: detected(m.data), LATCHED)
        self.listen(UInt8MultiArray, 'mae_checkpoint', self._count_checkpoint, LATCHED)
        self.listen(DiagnosticArray, '/diagnostics', self.situation.diagnosed, RELIABLE)
        self.create_timer(1.0, self._print, clock=STEADY)

    def _estimated(self, theta: Array) -> None:
        if self.theta is not None:
            self.errors.append(float(np.linalg.norm(theta - self.theta)))

    def _count_checkpoint(self, _: UInt8MultiArray) -> None:
        self.checkpoints += 1

    def _print(self) -> None:
        now = time.monotonic()
        if self.started is None and not self.anomalies:
            if 0.0 < self.patience < now - self.begun:
                sys.exit(f'the system did not come up: no estimate in {self.patience:g} s')
            return
        self.started = self.started or now
        error, anomaly = (
            np.mean(values) if values else math.nan for values in (self.errors, self.anomalies)
        )
        self.errors, self.anomalies = [], []
        line = f'{now - self.started:6.0f} s  error {error:.3f} rad  A {anomaly:.3f}'
        told = self.situation
        line += f'  samples {told.samples or 0}  checkpoints {self.checkpoints}'
        more = told.trouble() or told.hint()
        print(printable(f'{line}  {more}'.rstrip()), flush=True)
        if 0.0 < self.duration <= now - self.started:
            raise ExternalShutdownException
