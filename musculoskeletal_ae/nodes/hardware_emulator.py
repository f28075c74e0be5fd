# SPDX-License-Identifier: Apache-2.0
"""The node `hardware_emulator`: an arm with muscle modules, and faults on request.

muscle_length_command, muscle_tension_command → joint_states, muscle_states, marker_pose, markers.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pinocchio as pin
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.messages import array_message, read_array, read_wrench
from musculoskeletal_ae.nodes.markers import arm_markers
from musculoskeletal_ae.nodes.qos import LATCHED, RELIABLE
from musculoskeletal_ae.nodes.shell import OK, WARN, Shell
from musculoskeletal_ae.robot.drawing import draw_arm

MARKER_RATE = 10.0  # [Hz] of the markers for RViz
# After a pause (a debugger, a suspended machine) the arm goes on instead of catching up.
LONGEST_STEP = 0.1  # [s]


class HardwareEmulator(Shell):
    """Node shell of the emulated arm."""

    def __init__(self, **options: Any) -> None:
        """Declare topics and start the arm; options are those of Node."""
        super().__init__('hardware_emulator', **options)
        self.arm = EmulatedArm(self.robot, self.parameter('seed'))
        # Compiled code is loaded before the first message promises a living arm.
        self.arm.step(0.01)
        self.read = self.arm.sense()
        self.follow_parameter('command_timeout', self._set_timeout)
        self.follow_parameter('ruptured_muscles', self.arm.set_ruptured)
        self.follow_parameter('payload', self.arm.set_payload)
        self.follow_parameter('length_offset', self._set_offset)
        self.follow_parameter('marker_rate', self._see_marker)
        self.joint_publisher = None
        if self.parameter('joint_sensors'):
            self.joint_publisher = self.create_publisher(JointState, 'joint_states', RELIABLE)
        self.muscle_publisher = self.create_publisher(Float64MultiArray, 'muscle_states', RELIABLE)
        self.pose_publisher = self.create_publisher(PoseStamped, 'marker_pose', RELIABLE)
        self.marker_publisher = self.create_publisher(
            MarkerArray, 'hardware_emulator/markers', RELIABLE
        )
        description = self.create_publisher(String, 'robot_description', LATCHED)
        description.publish(String(data=self.robot.description.urdf))
        self.listen(Float64MultiArray, 'muscle_length_command', self._follow_length, RELIABLE)
        self.listen(Float64MultiArray, 'muscle_tension_command', self._follow_tension, RELIABLE)
        self.listen(WrenchStamped, 'hardware_emulator/external_wrench', self._push, RELIABLE)
        self.create_service(Trigger, 'hardware_emulator/reset', self._reset)
        self.pose_due = 0.0
        self.ticked = time.monotonic()
        self.remainder = 0.0
        self.create_timer(1.0 / self.rate, self._tick)
        self.create_timer(1.0 / MARKER_RATE, self._publish_markers)

    # -- parameters -----------------------------------------------------------------------------

    def _set_timeout(self, value: float) -> None:
        self.arm.command_timeout = value

    def _see_marker(self, value: float) -> None:
        self.marker_rate = value

    def _set_offset(self, values: tuple[float, ...]) -> None:
        count = self.robot.muscle_count
        if len(values) not in (1, count):
            raise MusculoskeletalError(f'{list(values)}; legal: 1 or {count} numbers [m]')
        self.arm.set_length_offset(np.broadcast_to(values, count))

    # -- messages -------------------------------------------------------------------------------

    def _follow_length(self, message: Float64MultiArray) -> None:
        self.arm.command_length(read_array(message, 1, self.robot.muscle_count))

    def _follow_tension(self, message: Float64MultiArray) -> None:
        self.arm.command_tension(read_array(message, 1, self.robot.muscle_count))

    def _push(self, message: WrenchStamped) -> None:
        self.arm.set_wrench(read_wrench(message, self.robot.root_link))

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.arm.reset()
        self.arm.set_ruptured(self.parameter('ruptured_muscles'))
        response.success = True
        response.message = 'arm at rest, modules safe; parameters (ruptures, payload) stay as set'
        return response

    # -- time -----------------------------------------------------------------------------------

    def _tick(self) -> None:
        now = time.monotonic()
        elapsed = min(now - self.ticked, LONGEST_STEP) + self.remainder
        self.ticked = now
        whole = int(elapsed * 1000.0) / 1000.0
        self.remainder = elapsed - whole
        self.arm.step(whole)
        read = self.read = self.arm.sense()
        stamp = self.get_clock().now().to_msg()
        if self.joint_publisher is not None:
            joints = JointState(name=self.robot.joints, position=read.theta.tolist())
            joints.header.stamp = stamp
            self.joint_publisher.publish(joints)
        rows = np.stack([read.length, read.tension, read.temperature])
        self.muscle_publisher.publish(array_message(rows, 'quantity', 'muscle'))
        if self.marker_rate > 0.0 and now >= self.pose_due:
            self.pose_due = max(self.pose_due + 1.0 / self.marker_rate, now)
            self._publish_pose(stamp)

    def _publish_pose(self, stamp: Time) -> None:
        pose = self.arm.marker_pose()
        message = PoseStamped()
        message.header.stamp = stamp
        message.header.frame_id = self.robot.root_link
        position, turn = message.pose.position, message.pose.orientation
        position.x, position.y, position.z = pose.translation.tolist()
        turn.x, turn.y, turn.z, turn.w = pin.Quaternion(pose.rotation).coeffs().tolist()
        self.pose_publisher.publish(message)

    def _publish_markers(self) -> None:
        if self.marker_publisher.get_subscription_count() == 0:
            return
        points = self.arm.route_points()
        drawing = draw_arm(self.robot, self.arm.theta, self.arm.tension, points)
        stamp = self.get_clock().now().to_msg()
        self.marker_publisher.publish(arm_markers(drawing, self.robot.root_link, stamp))

    def state(self) -> tuple[bytes, str, dict[str, str]]:
        """Return what /diagnostics shows."""
        values = {'hottest module': f'{self.read.temperature.max():.1f} °C'}
        if self.arm.safe:
            return WARN, 'modules safe: no commands', values
        return OK, 'following commands', values
