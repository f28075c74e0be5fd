# SPDX-License-Identifier: Apache-2.0
"""QoS profiles, functions that build ROS messages from arrays, and responses of services.

The opposite direction, from messages to checked arrays, is in `message_reading`.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

from builtin_interfaces.msg import Time
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, MultiArrayLayout, UInt8MultiArray

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError

if TYPE_CHECKING:  # a slow import, which --help of the tools does not need
    from musculoskeletal_ae.robot.joint_units import JointUnits
    from musculoskeletal_ae.signals.motor_interface import MotorInterface

# The three QoS profiles of the interface (doc/reference/topics_and_services.md).
RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
SENSOR = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(
    depth=1, reliability=RELIABLE.reliability, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


def array_message(values: Array, *labels: str) -> Float64MultiArray:
    """Return a message that contains the array; `labels` has one name for each dimension."""
    layout = _layout(values.shape, labels)
    return Float64MultiArray(layout=layout, data=array('d', values.tobytes()))


@cache
def _layout(sizes: tuple[int, ...], labels: tuple[str, ...]) -> MultiArrayLayout:
    dimensions = [
        MultiArrayDimension(label=label, size=size, stride=math.prod(sizes[i:]))
        for i, (label, size) in enumerate(zip(labels, sizes, strict=True))
    ]
    return MultiArrayLayout(dim=dimensions)


def posture_message(units: JointUnits, theta: Array, stamp: Time) -> JointState:
    """Return a JointState with the names and positions of all joints, at θ [rad], (D,)."""
    return joint_message(units.names, units.to_position(theta), stamp)


def joint_message(names: Sequence[str], position: Array, stamp: Time) -> JointState:
    """Return a JointState with names and positions, each in its own unit."""
    message = JointState(name=names, position=array('d', position.tobytes()))
    message.header.stamp = stamp
    return message


def motor_command(motors: MotorInterface, length: Array) -> Float64MultiArray:
    """Return the message that commands lengths [m], (M,), to the motors of a ros2_control robot.

    Like other commands to ros2_control, the message has no layout.
    """
    return Float64MultiArray(data=array('d', motors.command(length).tobytes()))


def motor_message(motors: MotorInterface, length: Array, tension: Array, stamp: Time) -> JointState:
    """Return the JointState of the muscles' motors for lengths [m] and tensions [N], (M,) each."""
    names, position, effort = motors.joint_values(length, tension)
    message = joint_message(names, position, stamp)
    message.velocity = array('d', [math.nan] * len(names))
    message.effort = array('d', effort.tobytes())
    return message


def add_joints(message: JointState, units: JointUnits, theta: Array) -> None:
    """Append all joints at θ [rad], (D,), to a JointState; their other values are NaN."""
    message.name = [*message.name, *units.names]
    message.position.extend(units.to_position(theta).tolist())
    for unknown in (message.velocity, message.effort):
        unknown.extend([math.nan] * len(units))


def is_heard(publisher: Publisher) -> bool:
    """Return whether a publisher has a subscriber; without one, building a message is useless."""
    return publisher.get_subscription_count() > 0


def bytes_message(data: bytes) -> UInt8MultiArray:
    """Return a message that contains the bytes."""
    return UInt8MultiArray(data=array('B', data))


def serve(node: Node, kind: Any, name: str, work: Callable[[Any], str]) -> None:
    """Offer a service of type `kind`, Trigger or SetBool, under a name.

    `work` returns the response message, or raises a MusculoskeletalError to report failure.
    """

    def answer(request: Any, response: Any) -> Any:
        try:
            response.success, response.message = True, work(request)
        except MusculoskeletalError as error:
            response.success, response.message = False, str(error)
        return response

    node.create_service(kind, name, answer)


def refuse(request: Any, response: Any, reason: str) -> None:
    """Refuse a request: state the reason in the response, if its type has a field for that."""
    refused = SetParametersResult(successful=False, reason=reason)
    if hasattr(response, 'results'):  # one result for each parameter; some may exist already
        response.results += [refused] * (len(request.parameters) - len(response.results))
    elif isinstance(getattr(response, 'result', None), SetParametersResult):
        response.result = refused
    elif hasattr(response, 'success'):
        response.success, response.message = False, reason
