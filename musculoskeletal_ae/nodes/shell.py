# SPDX-License-Identifier: Apache-2.0
"""What all node shells share: parameters, checkpoints, subscriptions, diagnostics."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_msgs.msg import UInt8MultiArray

from musculoskeletal_ae.exceptions import CheckpointError, MusculoskeletalError
from musculoskeletal_ae.mae import checkpoint as checkpoints
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.nodes.parameters import number, text
from musculoskeletal_ae.nodes.qos import LATCHED
from musculoskeletal_ae.nodes.reception import Reception
from musculoskeletal_ae.robot.robot import Robot

#: for ages and watchdogs; never stands still, whatever /clock does
STEADY = Clock(clock_type=ClockType.STEADY_TIME)

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class Shell(Node):
    """A node that knows its robot, counts what it rejects and reports once a second.

    Attributes:
        robot: The robot of the `robot` parameter.
        rejected: How many messages were rejected, by topic and reason.
    """

    def __init__(self, name: str) -> None:
        """Start the node and load its robot."""
        super().__init__(name)
        self.declare_parameter('robot', 'musashi_left_arm', text('shipped name or directory', True))
        self.declare_parameter(
            'rate', 100.0, number('rate of the muscle modules [Hz]', 1.0, 1000.0, True)
        )
        self.robot = Robot.load(self.get_parameter('robot').value)
        self.rate = float(self.get_parameter('rate').value)
        self._reception = Reception(lambda text: self.get_logger().warning(text))
        self.rejected = self._reception.rejected
        self._setters: dict[str, Callable[[Any], None]] = {}
        self.add_on_set_parameters_callback(self._set_parameters)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._report_timer = self.create_timer(1.0, self._report, clock=STEADY)
        self._reported_at = time.monotonic()
        backward = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True
        )
        self._jump = self.get_clock().create_jump_callback(
            backward, post_callback=lambda _: self.clock_jumped_back()
        )

    # -- what a node overrides ------------------------------------------------------------------

    def state(self) -> tuple[bytes, str, dict[str, str]]:
        """Return level, message and values for /diagnostics."""
        return OK, 'running', {}

    def clock_jumped_back(self) -> None:
        """Forget buffers, rates and filters; latches stay."""

    # -- parameters -----------------------------------------------------------------------------

    def settable(
        self,
        name: str,
        default: Any,
        descriptor: ParameterDescriptor,
        setter: Callable[[Any], None],
    ) -> None:
        """Declare a parameter that may be set at run time.

        Args:
            name: Its name.
            default: Its default.
            descriptor: What it means, unit and range.
            setter: Takes a new value and uses it, or raises a `MusculoskeletalError` or `OSError`.
        """
        self.declare_parameter(name, default, descriptor)
        self._setters[name] = setter
        try:
            setter(self.get_parameter(name).value)
        except (MusculoskeletalError, OSError) as error:
            raise MusculoskeletalError(f'parameter {name}: {error}') from error

    def _set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        taken: list[str] = []
        for parameter in parameters:
            if parameter.name in self._setters:
                try:
                    self._setters[parameter.name](parameter.value)
                except (MusculoskeletalError, OSError) as error:
                    for name in reversed(taken):  # all or nothing
                        self._setters[name](self.get_parameter(name).value)
                    return SetParametersResult(successful=False, reason=str(error))
                taken.append(parameter.name)
        return SetParametersResult(successful=True)

    # -- checkpoints ----------------------------------------------------------------------------

    def follow_checkpoints(
        self, use: Callable[[Mae], None], unfit: Callable[[str], None] = lambda _: None
    ) -> None:
        """Take checkpoints from the parameter and the topic; the last valid one wins.

        Args:
            use: Takes a checked network.
            unfit: Is told why one that came by topic cannot be used; the one in use stays.
        """
        self.mae: Mae | None = None

        def take(mae: Mae) -> None:
            try:
                use(mae)
            except (np.linalg.LinAlgError, FloatingPointError) as error:
                raise CheckpointError(f'cannot be computed with ({error})') from error
            self.mae = mae

        def from_file(path: str) -> None:
            if path:
                take(checkpoints.load(path, self.robot))

        def from_topic(message: UInt8MultiArray) -> None:
            try:
                take(checkpoints.from_bytes(bytes(message.data), self.robot))
            except CheckpointError as error:
                unfit(str(error))
                raise

        self.settable('checkpoint', '', text('MAE checkpoint file; empty: wait for one'), from_file)
        self.listen(UInt8MultiArray, 'mae_checkpoint', from_topic, LATCHED)

    # -- messages -------------------------------------------------------------------------------

    def listen(
        self, kind: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile
    ) -> None:
        """Subscribe; a message that breaks a rule, or comes twice or late, is counted and dropped.

        The callback raises a `MusculoskeletalError` to reject the message.
        """
        # rclpy accepts (message, info) callbacks; its annotations do not know them.
        full = self.resolve_topic_name(topic)
        receive = self._reception.of(topic, callback, lambda: self.count_publishers(full))
        self.create_subscription(kind, topic, receive, qos)  # type: ignore[arg-type]

    # -- diagnostics ----------------------------------------------------------------------------

    def _report(self) -> None:
        level, summary, values = self.state()
        now = time.monotonic()
        elapsed, self._reported_at = now - self._reported_at, now
        for topic, count in self._reception.take_received().items():
            values[f'{topic} rate'] = f'{count / elapsed:.1f} Hz'
        values['rejected'] = str(sum(self.rejected.values()))
        values |= {f'rejected {reason}': str(n) for reason, n in self.rejected.items()}
        if self._reception.last_rejected:
            values['last rejected'] = self._reception.last_rejected
        status = DiagnosticStatus(
            level=level,
            name=f'{self.get_fully_qualified_name()}: state',
            message=summary,
            hardware_id=str(self.robot.description.directory.name),
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)
