# SPDX-License-Identifier: Apache-2.0
"""ROS arguments on the command line: which parameters they set, and what rclpy raises for them."""

from itertools import pairwise

from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.impl.implementation_singleton import rclpy_implementation

#: what rclpy raises for a value of the wrong type or beyond its range, given at the start
PARAMETER_ERRORS = (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    rclpy_implementation.UnknownROSArgsError,
    rclpy_implementation.RCLInvalidROSArgsError,
)


def reason(error: Exception) -> str:
    """Return what rcl says is wrong, without the place in its sources."""
    return ' '.join(str(error).split(', at /')[0].split())


def parameters_given(arguments: list[str]) -> list[str]:
    """Return the names that `-p NAME:=VALUE` or `-p NODE:NAME:=VALUE` give values."""
    values = [value for flag, value in pairwise(arguments) if flag in ('-p', '--param')]
    return [value.partition(':=')[0].rpartition(':')[2] for value in values]
