# SPDX-License-Identifier: Apache-2.0
"""The node `estimator`: joint angles from muscle length and tension; is the body healthy.

muscle_states → estimated_joint_states, estimated_muscle_states, anomaly, anomaly_detected;
marker_pose → vision_joint_states, the joint angles that a camera sees.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64, Float64MultiArray
from std_srvs.srv import Trigger

from musculoskeletal_ae.estimation.anomaly import AnomalyDetector, Verdict
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.messages import QUANTITIES, array_message, read_array, read_pose
from musculoskeletal_ae.nodes.qos import LATCHED, RELIABLE, SENSOR
from musculoskeletal_ae.nodes.shell import ERROR, OK, WARN, Shell
from musculoskeletal_ae.robot.inverse_kinematics import inverse_kinematics

# Commands older than this no longer say what the modules do.
COMMAND_AGE = 0.5  # [s]
# A pause in the messages counts as at most this much of a muscle's time without tension.
LONGEST_PERIOD = 0.1  # [s]
# A marker that the arm cannot reach to within these is another one, or its calibration is off.
MARKER_DISTANCE, MARKER_ANGLE = 0.05, 0.3  # [m], [rad]


class Estimator(Shell):
    """Node shell of the MAE's estimate ② and the anomaly detector."""

    def __init__(self, **options: Any) -> None:
        """Declare topics; options are those of Node."""
        super().__init__('estimator', **options)
        self.detector = AnomalyDetector(self.robot)
        self.verdict: Verdict | None = None
        self.cause = self.suspect = ''
        self.taken = self.get_clock().now()
        self.arrival = -math.inf
        self.command_arrival = -math.inf
        self.follow_parameter('anomaly_threshold', self._set_threshold)
        self.joint_publisher = self.create_publisher(JointState, 'estimated_joint_states', RELIABLE)
        self.muscle_publisher = self.create_publisher(
            Float64MultiArray, 'estimated_muscle_states', RELIABLE
        )
        self.anomaly_publisher = self.create_publisher(Float64, 'anomaly', RELIABLE)
        self.detected_publisher = self.create_publisher(Bool, 'anomaly_detected', LATCHED)
        self.detected_publisher.publish(Bool(data=False))
        self.follow_checkpoints(self.detector.use)
        self.listen(Float64MultiArray, 'muscle_states', self._estimate, SENSOR)
        self.listen(Float64MultiArray, 'muscle_length_command', self._length_command, RELIABLE)
        self.listen(Float64MultiArray, 'muscle_tension_command', self._tension_command, RELIABLE)
        self.theta = 0.5 * (self.robot.lower + self.robot.upper)
        self.vision_publisher = self.create_publisher(JointState, 'vision_joint_states', RELIABLE)
        self.listen(PoseStamped, 'marker_pose', self._see, SENSOR)
        self.create_service(Trigger, 'estimator/reset', self._reset)

    def _set_threshold(self, value: float) -> None:
        self.detector.threshold = value

    def _length_command(self, message: Float64MultiArray) -> None:
        self.detector.commanded_length(read_array(message, 1, self.robot.muscle_count))
        self.command_arrival = time.monotonic()

    def _tension_command(self, message: Float64MultiArray) -> None:
        self.detector.commanded_tension(read_array(message, 1, self.robot.muscle_count))
        self.command_arrival = time.monotonic()

    def _estimate(self, message: Float64MultiArray) -> None:
        length, tension, _ = read_array(message, len(QUANTITIES), self.robot.muscle_count)
        if self.mae is None:
            return
        now = self.get_clock().now()
        dt = min(max((now - self.taken).nanoseconds * 1e-9, 0.0), LONGEST_PERIOD)
        self.taken, self.arrival = now, time.monotonic()
        if self.arrival - self.command_arrival > COMMAND_AGE:
            self.detector.commanded_length(None)
        state = self.mae.estimate(tension, length)
        self.theta = state.theta
        self.verdict = self.detector.step(state, tension, length, dt)
        joints = JointState(name=self.robot.joints, position=state.theta.tolist())
        joints.header.stamp = self.get_clock().now().to_msg()
        self.joint_publisher.publish(joints)
        restored = np.stack([state.length, state.tension])
        self.muscle_publisher.publish(array_message(restored, 'quantity', 'muscle'))
        self.anomaly_publisher.publish(Float64(data=self.verdict.anomaly))
        if self.verdict.cause and not self.cause:
            self.suspect = self.robot.muscles[self.verdict.suspect]
            self.cause = f'{self.suspect}: {self.verdict.cause}'
            self.get_logger().warning(f'anomaly detected: {self.cause}')
            self.detected_publisher.publish(Bool(data=True))

    def _see(self, message: PoseStamped) -> None:
        pose = read_pose(message, self.robot.root_link)
        found = inverse_kinematics(self.robot, pose, self.theta)
        if found.distance > MARKER_DISTANCE or found.angle > MARKER_ANGLE:
            raise MessageError(
                'out of reach', f'{found.distance:.3f} m and {found.angle:.2f} rad are left'
            )
        joints = JointState(name=self.robot.joints, position=found.theta.tolist())
        joints.header.stamp = message.header.stamp
        self.vision_publisher.publish(joints)

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        response.message = f'cleared: {self.cause}' if self.cause else 'nothing was detected'
        self.cause = self.suspect = ''
        self.detector.reset()
        self.detected_publisher.publish(Bool(data=False))
        return response

    def clock_jumped_back(self) -> None:
        """Start the detector's counts anew; what was detected stays."""
        self.detector.reset()
        self.taken = self.get_clock().now()

    def state(self) -> tuple[bytes, str, dict[str, str]]:
        """Return what /diagnostics shows."""
        if self.mae is None:
            return WARN, 'waiting for a checkpoint', {}
        values = {
            'checkpoint version': str(self.mae.version),
            'anomaly calibrated': str(self.detector.calibrated),
        }
        if self.verdict is not None:
            values |= {
                'A': f'{self.verdict.anomaly:.4f}',
                'd': f'{self.verdict.distance:.1f}',
                # What was found first: when it is mended, the rest of the latch accuses others.
                'suspect muscle': self.suspect or self.robot.muscles[self.verdict.suspect],
            }
        if self.cause:
            return ERROR, f'anomaly detected: {self.cause}', values
        if time.monotonic() - self.arrival > 1.0:
            return WARN, 'no muscle_states', values
        return OK, 'estimating' if self.detector.calibrated else 'estimating, uncalibrated', values
