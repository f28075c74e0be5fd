# SPDX-License-Identifier: Apache-2.0
"""Start and end of every node's process."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import NoReturn

import rclpy
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from musculoskeletal_ae.exceptions import MusculoskeletalError

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


def reason(error: Exception) -> str:
    """Return what rcl says is wrong, without where in its sources it says so."""
    return ' '.join(str(error).split(', at /')[0].split())


def _refuse(error: object) -> NoReturn:
    print(f'error: {error}', file=sys.stderr)
    sys.exit(1)


def run(make: Callable[[], Node]) -> None:
    """Run one node on a single-threaded executor until it is asked to stop.

    What cannot be used (a robot, a parameter, a checkpoint) ends with one clear line and status 1.
    """
    if {'--help', '-h'} & set(sys.argv[1:]):
        print(f'{sys.modules[make.__module__].__doc__}\n{USAGE}')
        return
    try:
        rclpy.init()
    except (rclpy_implementation.RCLError, *PARAMETER_ERRORS) as error:
        _refuse(reason(error))
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
        _refuse(error)
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
