# SPDX-License-Identifier: Apache-2.0
"""What all node shells share: parameters, checkpoints, validity, diagnostics, start and end."""

from __future__ import annotations

import sys
import time
from array import array
from collections import Counter
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt8MultiArray

from musculoskeletal_ae.exceptions import MessageError, MusculoskeletalError
from musculoskeletal_ae.mae import checkpoint as checkpoints
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
SENSOR = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)

# A source time that lies further back than this is another publisher's clock, not a reordering.
REORDERING = int(1e9)  # [ns]

#: for ages and watchdogs; never stands still, whatever /clock does
STEADY = Clock(clock_type=ClockType.STEADY_TIME)

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


def text(description: str, read_only: bool = False) -> ParameterDescriptor:
    """Describe a parameter that has no range."""
    return ParameterDescriptor(description=description, read_only=read_only)


def number(
    description: str, low: float, high: float, read_only: bool = False
) -> ParameterDescriptor:
    """Describe a number within [low, high]; rclpy refuses what lies outside, NaN included."""
    span = FloatingPointRange(from_value=low, to_value=high)
    return ParameterDescriptor(
        description=description, floating_point_range=[span], read_only=read_only
    )


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
        self.rejected: Counter[str] = Counter()
        self._setters: dict[str, Callable[[Any], str | None]] = {}
        self.add_on_set_parameters_callback(self._set_parameters)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._report_timer = self.create_timer(1.0, self._report, clock=STEADY)
        self._received: Counter[str] = Counter()
        self._reported_at = time.monotonic()
        self._last_source: dict[str, int] = {}
        backward = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False
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
        setter: Callable[[Any], str | None],
    ) -> None:
        """Declare a parameter that may be set at run time.

        Args:
            name: Its name.
            default: Its default.
            descriptor: What it means, unit and range.
            setter: Takes a new value and uses it, or returns the reason why it will not.
        """
        self.declare_parameter(name, default, descriptor)
        self._setters[name] = setter
        reason = setter(self.get_parameter(name).value)
        if reason:
            raise MusculoskeletalError(f'parameter {name}: {reason}')

    def _set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            if parameter.name in self._setters:
                reason = self._setters[parameter.name](parameter.value)
                if reason:
                    return SetParametersResult(successful=False, reason=reason)
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
            self.mae = mae
            use(mae)

        def from_file(path: str) -> str | None:
            if path:
                try:
                    take(checkpoints.load(path, self.robot))
                except MusculoskeletalError as error:
                    return str(error)
            return None

        def from_topic(message: UInt8MultiArray) -> None:
            try:
                mae = checkpoints.from_bytes(bytes(message.data), self.robot)
            except MusculoskeletalError as error:
                unfit(str(error))
                raise
            take(mae)

        self.settable('checkpoint', '', text('MAE checkpoint file; empty: wait for one'), from_file)
        self.listen(UInt8MultiArray, 'mae_checkpoint', from_topic, LATCHED)

    # -- messages -------------------------------------------------------------------------------

    def listen(
        self, kind: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile
    ) -> None:
        """Subscribe; a message that breaks a rule, or comes twice or late, is counted and dropped.

        The callback raises a `MusculoskeletalError` to reject the message.
        """

        def receive(message: Any, info: dict[str, Any]) -> None:
            source = info['source_timestamp']
            behind = self._last_source.get(topic, 0) - source
            if 0 <= behind < REORDERING and source > 0:
                self.rejected[f'{topic}: repeated or reordered'] += 1
                return
            self._last_source[topic] = source
            try:
                callback(message)
            except MessageError as error:
                self.rejected[f'{topic}: {error.reason}'] += 1
            except MusculoskeletalError as error:
                self.rejected[f'{topic}: {error}'] += 1
            else:
                self._received[topic] += 1

        # rclpy accepts (message, info) callbacks; its annotations do not know them.
        self.create_subscription(kind, topic, receive, qos)  # type: ignore[arg-type]

    # -- diagnostics ----------------------------------------------------------------------------

    def _report(self) -> None:
        level, summary, values = self.state()
        now = time.monotonic()
        elapsed, self._reported_at = now - self._reported_at, now
        for topic, count in self._received.items():
            values[f'{topic} rate'] = f'{count / elapsed:.1f} Hz'
            self._received[topic] = 0
        values['rejected'] = str(sum(self.rejected.values()))
        values |= {f'rejected {reason}': str(n) for reason, n in self.rejected.items()}
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


def bytes_message(data: bytes) -> UInt8MultiArray:
    """Return a byte array message."""
    return UInt8MultiArray(data=array('B', data))


def run(make: Callable[[], Node]) -> None:
    """Run one node on a single-threaded executor until it is asked to stop.

    What cannot be used (a robot, a parameter, a checkpoint) ends with one clear line and status 1.
    """
    if {'--help', '-h'} & set(sys.argv[1:]):
        print(f'{sys.modules[make.__module__].__doc__}\n{USAGE}')
        return
    rclpy.init()
    node = None
    try:
        node = make()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except rclpy_implementation.RCLError:
        # A callback that publishes while a signal shuts the context down is no failure.
        if rclpy.ok():
            raise
    except (MusculoskeletalError, *PARAMETER_ERRORS) as error:
        print(f'error: {error}', file=sys.stderr)
        sys.exit(1)
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


# What rclpy raises for a value of the wrong type or beyond its range, given at the start.
PARAMETER_ERRORS = (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    rclpy_implementation.UnknownROSArgsError,
    rclpy_implementation.RCLInvalidROSArgsError,
)

USAGE = """
This is a ROS 2 node. Parameters:  --ros-args -p NAME:=VALUE  or  --params-file FILE;
names:  -r __ns:=/left_arm  -r TOPIC:=OTHER.  `ros2 param describe` tells each parameter's meaning.
"""
