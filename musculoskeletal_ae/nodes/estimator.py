# SPDX-License-Identifier: Apache-2.0
"""The node `estimator`: joint angles from muscle length and tension; is the body healthy.

muscle_states → estimated_joint_states, estimated_muscle_states, anomaly, anomaly_detected;
marker_pose → vision_joint_states, the joint angles that a camera sees.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64, Float64MultiArray
from std_srvs.srv import Trigger

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.estimator import Estimator as Core
from musculoskeletal_ae.nodes.messages import array_message, joint_message, serve
from musculoskeletal_ae.nodes.qos import LATCHED, RELIABLE, SENSOR
from musculoskeletal_ae.nodes.shell import Shell
from musculoskeletal_ae.plausibility import Plausibility
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.validity import read_pose


class Estimator(Shell):
    """Node shell of the MAE's estimate ② and the anomaly detector."""

    def __init__(self, **options: Any) -> None:
        """Declare topics; options are those of Node."""
        super().__init__('estimator', **options)
        self.core, self.plausibility = Core(self.robot), Plausibility(self.robot)
        self.follow_parameter(
            'anomaly_threshold', partial(setattr, self.core.detector, 'threshold')
        )
        self.joints = self.create_publisher(JointState, 'estimated_joint_states', RELIABLE)
        self.muscles = self.create_publisher(Float64MultiArray, 'estimated_muscle_states', RELIABLE)
        self.anomaly = self.create_publisher(Float64, 'anomaly', RELIABLE)
        self.detected = self.create_publisher(Bool, 'anomaly_detected', LATCHED)
        self.detected.publish(Bool(data=False))
        self.seen = self.create_publisher(JointState, 'vision_joint_states', RELIABLE)
        self.follow_checkpoints(self.core.use)
        self.follow_muscle_states(self._estimate)
        for kind in ('length', 'tension'):
            self.follow_muscles(f'muscle_{kind}_command', partial(self._commanded, kind))
        self.listen(PoseStamped, 'marker_pose', self._see, SENSOR)
        serve(self, Trigger, 'estimator/reset', self._reset)

    def _commanded(self, kind: str, command: Array) -> None:
        self.core.commanded(time.monotonic(), **{kind: command})

    def _estimate(self, states: Array) -> None:
        length, tension, temperature = states
        clock, now = self.get_clock().now(), time.monotonic()
        self.plausibility.check_muscles(tension, length, temperature, now)
        estimate = self.core.step(tension, length, clock.nanoseconds * 1e-9, now)
        if estimate is None:
            return
        self.gate.message(tension, length, now)
        state = estimate.state
        self.joints.publish(joint_message(self.robot.joints, state.theta, clock.to_msg()))
        restored = np.stack([state.length, state.tension])
        self.muscles.publish(array_message(restored, 'quantity', 'muscle'))
        self.anomaly.publish(Float64(data=estimate.anomaly))
        if estimate.detected:
            self.get_logger().warning(f'anomaly detected: {self.core.cause}')
            self.detected.publish(Bool(data=True))
            self.take_anomaly(True)

    def _see(self, message: PoseStamped) -> None:
        theta = self.core.see(read_pose(message, self.robot.root_link))
        self.seen.publish(joint_message(self.robot.joints, theta, message.header.stamp))

    def _reset(self, _: Trigger.Request) -> str:
        cause = self.core.cause
        self.core.reset()
        self.take_anomaly(False)
        self.detected.publish(Bool(data=False))
        return f'cleared: {cause}' if cause else 'nothing was detected'

    def clock_jumped_back(self) -> None:
        """Start the detector's counts anew; what was detected stays."""
        self.core.clock_jumped_back()

    def report(self) -> Report:
        """Return what /diagnostics shows."""
        return self.core.report(time.monotonic())
