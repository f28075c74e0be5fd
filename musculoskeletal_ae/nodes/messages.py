# SPDX-License-Identifier: Apache-2.0
"""Arrays to ROS messages; `musculoskeletal_ae.validity` reads them."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import (
    Float64MultiArray,
    MultiArrayDimension,
    MultiArrayLayout,
    UInt8MultiArray,
)

from musculoskeletal_ae.arrays import Array


def array_message(values: Array, *labels: str) -> Float64MultiArray:
    """Return a multi-array of values (…) with one label per dimension."""
    sizes = values.shape
    layout = MultiArrayLayout(
        dim=[
            MultiArrayDimension(label=label, size=size, stride=int(np.prod(sizes[i:])))
            for i, (label, size) in enumerate(zip(labels, sizes, strict=True))
        ]
    )
    return Float64MultiArray(layout=layout, data=array('d', values.tobytes()))


def joint_message(joints: Sequence[str], theta: Array, stamp: Time) -> JointState:
    """Return a joint state of θ [rad] (D,)."""
    message = JointState(name=joints, position=theta.tolist())
    message.header.stamp = stamp
    return message


def bytes_message(data: bytes) -> UInt8MultiArray:
    """Return a byte array message."""
    return UInt8MultiArray(data=array('B', data))
