# SPDX-License-Identifier: Apache-2.0
"""ROS arguments on the command line: which parameters they set, and what rclpy raises for them."""

import os
from itertools import pairwise

from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.impl.implementation_singleton import rclpy_implementation

NO_REASON = 'error not set'  # what rcl says where it has stated none
#: what rclpy raises for a value of the wrong type or beyond its range, given at the start
PARAMETER_ERRORS = (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    rclpy_implementation.UnknownROSArgsError,
    rclpy_implementation.RCLInvalidROSArgsError,
)


def reason(error: Exception) -> str:
    """Return what rcl says is wrong, without the place in its sources."""
    text = ' '.join(str(error).split(', at /')[0].split())
    is_secured = os.environ.get('ROS_SECURITY_ENABLE') == 'true'
    if is_secured and not os.environ.get('ROS_SECURITY_KEYSTORE') and NO_REASON in text:
        return (
            f'{text.replace(NO_REASON, "security is switched on without keys")}; set '
            'ROS_SECURITY_KEYSTORE to a keystore, or unset ROS_SECURITY_ENABLE'
        )
    return text


def parameters_given(arguments: list[str]) -> list[str]:
    """Return the names that `-p NAME:=VALUE` or `-p NODE:NAME:=VALUE` give values."""
    values = [value for flag, value in pairwise(arguments) if flag in ('-p', '--param')]
    return [value.partition(':=')[0].rpartition(':')[2] for value in values]
