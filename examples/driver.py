# SPDX-License-Identifier: Apache-2.0
"""A driver to start from: copy it, connect your motors and sensors in `Bus`, and keep the rest.

    python my_driver.py --ros-args -p robot:=path/to/my_arm

With `-p moved:=true`, the emulated arm moves slowly through its range, as if a hand moved it.
doc/howto/your_driver.md states the contract of a driver; `check_driver` checks it.
"""

import os
import signal
import sys
import time
from functools import partial

if __name__ == '__main__':  # while the driver starts, Ctrl-C or SIGTERM ends it at once
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

from musculoskeletal_ae.emulator.kin.arm import EmulatedArm  # for the fake bus only
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.ros.message_building import array_message, joint_message

RATE = 100.0  # rate at which sensors are read and motors commanded [Hz]
TURN = 10.0  # time in which a hand moves the first joint to and fro, if `moved` [s]
SPOOL = 0.01  # radius of the spools [m]
SILENCE = 0.5  # after this time without a command, tensions decrease to T_bias, or motors stop [s]
RELEASE = 100.0  # rate of this decrease [N/s]


class Bus:
    """Your motors and sensors. This class is a fake.

    All arrays have the order of muscles.yaml, as the names in `robot.muscles`. If your bus has
    another order, let `order = robot.muscle_indices(names)`, with the names in the order of the
    bus. Then `tension[order]` is in the order of the bus, and `reading[np.argsort(order)]` in that
    of muscles.yaml.
    """

    def __init__(self, robot: Robot, moved: bool = False) -> None:
        self.arm, self.read_at = EmulatedArm(robot, seed=1), time.monotonic()
        self.robot, self.moved = robot, moved

    def read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return spool angles [rad], T [N], temperatures [°C] and θ [rad].

        Positive spool angles wind in. They are 0 at θ = 0 without tension. If `tension_source` of
        muscles.yaml is current, return the motor currents [A] in place of T; if it is none, NaN.
        """
        now = time.monotonic()
        if self.moved:  # all motors hold T_bias while a hand moves the arm
            low, high = self.robot.lower, self.robot.upper
            periods = TURN * (1.0 + 0.3 * np.arange(len(low)))
            share = 0.5 - 0.5 * np.cos(2.0 * np.pi * now / periods)
            self.arm.reset(low + share * (high - low))
        self.arm.step(min(round(now - self.read_at, 3), 0.1))
        self.read_at = now
        reading = self.arm.sense()
        # If your modules have no temperature sensors, return NaN for each muscle instead.
        muscles = reading.muscles
        tension = self.robot.tension_source.to_message(muscles.tension)
        return -muscles.length / SPOOL, tension, muscles.temperature, reading.theta

    def regulate(self, tension: np.ndarray) -> None:
        """Make every motor regulate its tendon to a tension [N] (M,)."""
        self.arm.command_tension(tension)

    def go_to(self, length: np.ndarray) -> None:
        """Make every motor go to a length [m] (M,), and stay there; for `actuation: position`.

        Without tension sensors, limit the current in the motor drives so that no tension exceeds
        `max` of muscles.yaml: nothing else does.
        """
        self.arm.command_length(length)


class Driver(Node):
    """Publishes the states, and moves the motors by the last command."""

    def __init__(self) -> None:
        super().__init__('driver')
        self.robot = Robot.load(self.declare_parameter('robot', 'arm26').value)
        self.bus = Bus(self.robot, self.declare_parameter('moved', False).value)
        # The last command: l_target [m], or T [N] if `by_tension`, and its time of arrival [s].
        self.target, self.by_tension, self.commanded_at = None, False, -SILENCE
        self.stopped_at = None  # lengths at which motors with position control have stopped [m]
        self.setpoint = np.full(self.robot.muscle_count, self.robot.tension.bias)
        self.states = self.create_publisher(Float64MultiArray, 'muscle_states', 10)
        self.joints = self.create_publisher(JointState, 'joint_states', 10)
        self.by_position = self.robot.description.actuation == 'position'
        for kind in ('length',) if self.by_position else ('length', 'tension'):
            follow = partial(self.command, by_tension=kind == 'tension')
            self.create_subscription(Float64MultiArray, f'muscle_{kind}_command', follow, 10)
        self.create_timer(1.0 / RATE, self.tick)
        name = self.robot.description.directory.name
        self.get_logger().info(f'publishing at {RATE:g} Hz for {name}')

    def command(self, message: Float64MultiArray, by_tension: bool) -> None:
        """Store the target lengths or, if `by_tension`, tensions; ignore a malformed message."""
        target = np.array(message.data)
        if len(target) == self.robot.muscle_count and np.isfinite(target).all():
            self.target, self.by_tension, self.commanded_at = target, by_tension, time.monotonic()

    def tick(self) -> None:
        """Read the sensors, move the motors, and publish the states."""
        angle, tension, temperature, theta = self.bus.read()
        length = -SPOOL * angle
        is_commanded = self.target is not None and time.monotonic() - self.commanded_at < SILENCE
        if not self.by_position:
            self.regulate(length, is_commanded)
        elif is_commanded:
            self.stopped_at = None
            self.bus.go_to(self.bounded(self.target, length, tension))
        elif self.target is not None:  # the motors stay where they are
            self.stopped_at = length if self.stopped_at is None else self.stopped_at
            self.bus.go_to(self.bounded(self.stopped_at, length, tension))
        rows = np.stack([length, tension, temperature])
        self.states.publish(array_message(rows, 'quantity', 'muscle'))
        now = self.get_clock().now().to_msg()
        self.joints.publish(joint_message(self.robot.joints, theta, now))

    def bounded(self, target: np.ndarray, length: np.ndarray, tension: np.ndarray) -> np.ndarray:
        """Return target lengths [m] that wind in no further where the tension is above T_max."""
        is_high = self.robot.tension_source.to_newtons(tension) > self.robot.tension.max
        return np.where(is_high, np.maximum(target, length), target)

    def regulate(self, length: np.ndarray, is_commanded: bool) -> None:
        """Regulate the tensions that follow from lengths and command by muscle stiffness control.

        Without a command, they decrease to T_bias.
        """
        bias, most = self.robot.tension.bias, self.robot.tension.max
        if is_commanded:
            stretched = self.robot.stiffness * (length - self.target)
            wanted = self.target if self.by_tension else bias + np.maximum(0.0, stretched)
        else:
            wanted = np.maximum(bias, self.setpoint - RELEASE / RATE)
        self.setpoint = np.clip(wanted, 0.0, most)
        self.bus.regulate(self.setpoint)


def main() -> None:
    """Run the driver until Ctrl-C or SIGTERM."""
    # The signal handlers of rclpy would shut the publishers down while `tick` uses them.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    executor, signals = SingleThreadedExecutor(), []
    executor.add_node(Driver())
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
