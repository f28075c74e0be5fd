# SPDX-License-Identifier: Apache-2.0
"""A fake ros2_control robot: exchanges the messages of two controllers of ros2_controllers.

    python fake_robot.py

The node replaces a controller_manager with the file controllers.yaml of this directory. The
hardware is an emulated arm whose motors are joints named MUSCLE_motor. Half of the spools wind in
the opposite direction, and every encoder reads a different angle at the zero posture. motors.yaml
corrects for both differences. doc/howto/ros2_control.md describes the connection.
"""

import math
import os
import signal
import sys
import time

if __name__ == '__main__':  # while the robot starts, Ctrl-C or SIGTERM ends it at once
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))

import numpy as np
import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.robot import Robot

UPDATE_RATE = 100.0  # update rate of the controller_manager [Hz]
SPOOL_RADIUS = 0.012  # radius of the spools [m]


class Hardware:
    """An emulated hardware component with motors and joint sensors.

    Each motor has an encoder and a torque sensor.
    """

    def __init__(self, robot: str) -> None:
        self.robot = Robot.load(robot)
        self.arm, self.read_at = EmulatedArm(self.robot, seed=1), time.monotonic()
        index = np.arange(self.robot.muscle_count)
        self.motors = [f'{muscle}_motor' for muscle in self.robot.muscles]
        self.direction = np.where(index % 2, 1.0, -1.0)  # −1: the angle rises as the motor winds in
        self.zero = 0.5 * index  # motor angles at θ = 0 without tension [rad]

    def read(self) -> dict[str, dict[str, float]]:
        """Return the state interfaces of every joint: angles [rad] and torques [N·m]."""
        now = time.monotonic()
        self.arm.step(min(round(now - self.read_at, 3), 0.1))
        self.read_at = now
        reading = self.arm.sense()
        angle = self.direction * reading.muscles.length / SPOOL_RADIUS + self.zero
        torque = -self.direction * reading.muscles.tension * SPOOL_RADIUS
        states = {joint: {'position': q} for joint, q in zip(self.robot.joints, reading.theta)}
        for motor, q, tau in zip(self.motors, angle, torque):
            states[motor] = {'position': q, 'effort': tau}
        return states

    def write(self, angles: dict[str, float]) -> None:
        """Send each drive its target angle [rad], which it follows as muscles.yaml states."""
        angle = np.array([angles[motor] for motor in self.motors])
        self.arm.command_length(self.direction * SPOOL_RADIUS * (angle - self.zero))


class FakeRobot(Node):
    """A stand-in for a controller_manager with two controllers of ros2_controllers.

    These are joint_state_broadcaster and forward_command_controller.
    """

    def __init__(self) -> None:
        super().__init__('fake_robot')
        self.hardware = Hardware(self.declare_parameter('robot', 'arm26').value)
        self.joints = sorted(self.hardware.motors)  # parameter `joints` of tendon_controller
        self.commands: list[float] | None = None
        self.states = self.create_publisher(JointState, 'joint_states', 10)
        topic = 'tendon_controller/commands'
        self.create_subscription(Float64MultiArray, topic, self.on_commands, 10)
        self.create_timer(1.0 / UPDATE_RATE, self.update)
        name = self.hardware.robot.description.directory.name
        self.get_logger().info(f'publishing at {UPDATE_RATE:g} Hz for {name}')

    def on_commands(self, message: Float64MultiArray) -> None:
        """Store a command until the next one; drop it with a warning if it is not finite."""
        if all(map(math.isfinite, message.data)):
            self.commands = list(message.data)
        else:
            values = list(message.data)
            self.get_logger().warning(f'ignored a command that is not finite: {values}')

    def update(self) -> None:
        """Read the hardware, publish its state, and write the last command, however old it is."""
        states = self.hardware.read()
        message = JointState(name=sorted(states))  # receivers match by name, so any order is right
        message.header.stamp = self.get_clock().now().to_msg()
        for field in ('position', 'velocity', 'effort'):  # NaN: the joint has no such interface
            values = [states[name].get(field, math.nan) for name in message.name]
            setattr(message, field, values)
        self.states.publish(message)
        if self.commands is None:
            return
        if len(self.commands) != len(self.joints):
            problem = f'a command has {len(self.commands)} values; expected {len(self.joints)}'
            self.get_logger().error(problem, throttle_duration_sec=1.0)
            return
        self.hardware.write(dict(zip(self.joints, self.commands)))


def main() -> None:
    """Run the robot until Ctrl-C or SIGTERM."""
    # The signal handlers of rclpy would shut the publisher down while `update` uses it.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    executor, signals = SingleThreadedExecutor(), []
    executor.add_node(FakeRobot())
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *arguments: signals.append(arguments))
    while not signals:
        executor.spin_once(timeout_sec=0.1)
    rclpy.shutdown()


if __name__ == '__main__':
    try:
        main()
    except (MusculoskeletalError, ParameterException) as error:  # `robot` is unknown, or no string
        sys.exit(f'error: {error}')
