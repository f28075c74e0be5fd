# SPDX-License-Identifier: Apache-2.0
"""Names that only the implementation of rclpy defines, because no public module offers them.

No other module of this package imports that implementation.

`RCLError` is the base class of errors that rcl returns, for example for an invalid topic name.
"""

from rclpy.impl.implementation_singleton import rclpy_implementation

RCLError = rclpy_implementation.RCLError
RCLInvalidROSArgsError = rclpy_implementation.RCLInvalidROSArgsError
UnknownROSArgsError = rclpy_implementation.UnknownROSArgsError
WaitSet = rclpy_implementation.WaitSet
