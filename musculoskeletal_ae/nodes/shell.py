# SPDX-License-Identifier: Apache-2.0
"""What all node shells share: parameters, checkpoints, subscriptions, diagnostics."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter as SetParameter
from rclpy.qos import QoSProfile
from std_msgs.msg import UInt8MultiArray

from musculoskeletal_ae.exceptions import CheckpointError, MusculoskeletalError
from musculoskeletal_ae.mae import checkpoint as checkpoints
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.nodes.parameters import PARAMETERS
from musculoskeletal_ae.nodes.qos import LATCHED
from musculoskeletal_ae.nodes.reception import Reception
from musculoskeletal_ae.parameters import Parameter
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

    def __init__(self, name: str, **options: Any) -> None:
        """Start the node, declare its parameters and load its robot; options are those of Node."""
        super().__init__(name, **options)
        self._parameters_of_node = PARAMETERS[name]
        for key, parameter in PARAMETERS[name].items():
            self.declare_parameter(key, _ros_value(parameter), _descriptor(parameter))
        self.robot = Robot.load(self.parameter('robot'))
        self.rate: float = self.parameter('rate')
        self._reception = Reception(lambda text: self.get_logger().warning(text))
        self.rejected = self._reception.rejected
        self._setters: dict[str, Callable[[Any], object]] = {}
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

    def parameter(self, name: str) -> Any:
        """Return a parameter's value; lists as tuples, without empty names.

        Raises:
            MusculoskeletalError: If the value is not legal.
        """
        return self._apply(name, self.get_parameter(name).value, lambda value: value)

    def follow_parameter(self, name: str, setter: Callable[[Any], object]) -> None:
        """Call `setter` with a parameter's value, now and whenever it is set.

        The setter raises a `MusculoskeletalError` or `OSError` to refuse a value.
        """
        self._apply(name, self.get_parameter(name).value, setter)
        self._setters[name] = setter

    def _apply(self, name: str, value: Any, setter: Callable[[Any], Any]) -> Any:
        try:
            return setter(self._parameters_of_node[name].checked(value))
        except (MusculoskeletalError, OSError) as error:
            raise MusculoskeletalError(f'parameter {name}: {error}') from error

    def _set_parameters(self, parameters: list[SetParameter]) -> SetParametersResult:
        taken: list[str] = []
        for parameter in parameters:
            if parameter.name in self._setters:
                setter = self._setters[parameter.name]
                try:
                    self._apply(parameter.name, parameter.value, setter)
                except MusculoskeletalError as error:
                    for name in reversed(taken):  # all or nothing
                        self._apply(name, self.get_parameter(name).value, self._setters[name])
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

        self.follow_parameter('checkpoint', from_file)
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


def _ros_value(parameter: Parameter) -> Any:
    default = parameter.default
    return list(default) if isinstance(default, tuple) else default


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=parameter.description,
        read_only=not parameter.settable,
        dynamic_typing=parameter.is_number_list,  # `[]` is an array of bytes to rclpy
    )
    if parameter.within is not None:
        low, high = parameter.within
        if isinstance(parameter.default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return descriptor
