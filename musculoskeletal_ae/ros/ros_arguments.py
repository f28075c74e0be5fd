# SPDX-License-Identifier: Apache-2.0
"""ROS arguments on the command line: which parameters they set, and rclpy's errors about them."""

import os
from itertools import pairwise

from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException

from musculoskeletal_ae.ros.executor import RCLInvalidROSArgsError, UnknownROSArgsError

NO_REASON = 'error not set'  # text of an rcl error whose reason rcl does not state
#: part of the text of an rcl error if the folder of the logs cannot be created
NO_LOG_FOLDER = 'log directory'
#: exceptions of rclpy for an argument that cannot be parsed
ARGUMENT_ERRORS = UnknownROSArgsError, RCLInvalidROSArgsError
#: exceptions of rclpy for a wrong ROS argument, including a parameter value of the wrong type or
#: out of range
PARAMETER_ERRORS = (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    *ARGUMENT_ERRORS,
)


def reason(error: Exception) -> str:
    """Return the message of an rcl error, without the location in its source code.

    For errors with a known remedy, the text also states the remedy.
    """
    text = ' '.join(str(error).split(', at /')[0].split())
    if NO_LOG_FOLDER in text:
        return f'{text}; set ROS_LOG_DIR to a folder that can be written'
    is_secured = os.environ.get('ROS_SECURITY_ENABLE') == 'true'
    if is_secured and not os.environ.get('ROS_SECURITY_KEYSTORE') and NO_REASON in text:
        return (
            f'{text.replace(NO_REASON, "security is switched on without keys")}; set '
            'ROS_SECURITY_KEYSTORE to a keystore, or unset ROS_SECURITY_ENABLE'
        )
    return text


def parameters_given(arguments: list[str]) -> list[str]:
    """Return the names of the parameters set by `-p NAME:=VALUE` or `-p NODE:NAME:=VALUE`."""
    values = [value for flag, value in pairwise(arguments) if flag in ('-p', '--param')]
    return [value.partition(':=')[0].rpartition(':')[2] for value in values]
