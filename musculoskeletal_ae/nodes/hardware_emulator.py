# SPDX-License-Identifier: Apache-2.0
"""The node `hardware_emulator`: emulates an arm with muscle modules, and faults on request.

muscle_length_command, muscle_tension_command, hardware_emulator/external_wrench → joint_states,
muscle_states, robot_description, hardware_emulator/markers; on request marker_pose, imu and /clock.
"""

import time
from collections.abc import Iterable
from typing import Any

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import PoseStamped, Vector3
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.emulator.sensors import read_sensors
from musculoskeletal_ae.nodes.arm_node import ArmNode, Markers
from musculoskeletal_ae.parameters import naming_parameter
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.drawing import Line, draw_arm
from musculoskeletal_ae.ros.message_building import RELIABLE, serve

PACE_TIME = 5.0  # average the real-time factor over this time [s]


class HardwareEmulatorNode(ArmNode):
    """Passes commands and faults to the emulated arm; publishes its measurements."""

    def __init__(self, **options: Any) -> None:
        super().__init__('hardware_emulator', **options)
        Markers(self, 'hardware_emulator', self._lines)
        self.arm = make_arm(
            self.robot,
            self.parameter('seed'),
            self.parameter('reality'),
            deviates=self.parameter('deviates'),
        )
        # Simulate one step to load the compiled code, which would otherwise delay the first
        # messages.
        self.arm.step(0.01)
        self.pose_due = self.remainder = 0.0
        self.reading = self.arm.sense()
        self.parameters.follow('payload', self.arm.set_payload)
        self.parameters.follow('faults', self.arm.set_faults)
        with naming_parameter('sensors'):
            self.sensors = read_sensors(self.parameter('sensors'), self.robot)
        self.advertise('', self.sensors.joints, description=True)
        self.pose = self.create_publisher(PoseStamped, 'marker_pose', RELIABLE)
        self.imu = None
        if self.sensors.imu_link:
            self.imu = self.create_publisher(Imu, 'imu', RELIABLE)
        self.follow_length_commands(self.arm.command_length)
        if self.robot.actuation.follows_tensions:
            self.follow_muscles('muscle_tension_command', self.arm.command_tension)
        self.follow_wrench('hardware_emulator', self.arm.set_wrench)
        serve(self, Trigger, 'hardware_emulator/reset', self._reset)
        self.ticked = time.monotonic()
        self.pace = 1.0  # simulated seconds per second of wall time
        self.time = self.clock_publisher = None
        if self.parameter('clock'):
            self.clock_publisher = self.create_publisher(ClockMessage, '/clock', RELIABLE)
            self.time = time.time_ns()
        # The timer uses a steady clock, because this node itself may publish the ROS time (/clock).
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0 / self.rate, self._tick, clock=steady)

    def _reset(self, _: Trigger.Request) -> str:
        self.arm.reset()
        return 'the arm is at rest without a wrench; the modules are cool and in their safe state'

    def _tick(self) -> None:
        now = time.monotonic()
        since = now - self.ticked
        # With the parameter `clock`, every tick simulates one period, even if the tick is late.
        elapsed = min(since, self.longest_step if self.time is None else 1.0 / self.rate)
        self.pace += min(1.0, since / PACE_TIME) * (elapsed / max(since, 1e-6) - self.pace)
        elapsed += self.remainder
        self.ticked = now
        whole = int(elapsed * 1000.0) / 1000.0
        self.remainder = elapsed - whole
        self.arm.step(whole)
        if self.time is not None and self.clock_publisher is not None:
            self.time += round(whole * 1e9)
            message = ClockMessage()
            message.clock.sec, message.clock.nanosec = divmod(self.time, 10**9)
            self.clock_publisher.publish(message)
        if self.arm.divergence:
            return
        self.reading = self.arm.sense()
        for reading in self.arm.faults.deliver(self.reading, now):
            self.publish_state(*reading)
        if self.imu is not None:
            self._publish_imu(self.imu)
        if self.sensors.marker_rate > 0.0 and now >= self.pose_due:
            self.pose_due = max(self.pose_due + 1.0 / self.sensors.marker_rate, now)
            self._publish_pose()

    def _publish_imu(self, publisher: Publisher) -> None:
        link, message = self.sensors.imu_link, Imu()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self.parameter('frame_prefix') + link
        message.orientation_covariance[0] = -1.0  # no orientation is measured
        acceleration = self.arm.accelerometer(link).tolist()
        message.linear_acceleration = Vector3(**dict(zip('xyz', acceleration)))
        publisher.publish(message)

    def _publish_pose(self) -> None:
        message = PoseStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self.root_frame
        p, q = message.pose.position, message.pose.orientation
        p.x, p.y, p.z, q.x, q.y, q.z, q.w = pin.SE3ToXYZQUAT(self.arm.marker_pose()).tolist()
        self.pose.publish(message)

    def _lines(self) -> list[Line]:
        arm = self.arm
        if arm.divergence:
            return []
        return draw_arm(self.robot, arm.theta, arm.tension, arm.route_points())

    def conditions(self) -> Iterable[Condition]:
        """Yield what is wrong with the emulation, and which faults it imitates."""
        yield from super().conditions()
        kind = ConditionKind
        if divergence := self.arm.divergence:
            yield kind.EMULATION_DIVERGED.condition(divergence)
        elif self.arm.safe:
            yield kind.MODULES_IN_SAFE_STATE.condition()
        if faults := self.parameter('faults'):
            yield kind.EMULATED_FAULT.condition(', '.join(faults))

    def status(self) -> Report:
        """Return what the emulated arm does, with its values."""
        # The result is NaN only if all temperatures are NaN.
        hottest = np.fmax.reduce(self.reading.muscles.temperature)
        values = {'hottest module': f'{hottest:.1f} °C', 'real-time factor': f'{self.pace:.2f}'}
        is_obeying = not (self.arm.divergence or self.arm.safe)
        return Report('following commands' if is_obeying else '', values)
