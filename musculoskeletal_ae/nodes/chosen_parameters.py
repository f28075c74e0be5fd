# SPDX-License-Identifier: Apache-2.0
"""Prints the value that nodes get for a parameter, for bringup.sh.

Usage: python -m musculoskeletal_ae.executables nodes.chosen_parameters NAME NODE… --ros-args …

ROS itself reads parameter files and `-p`: this module starts nodes with the same names, and prints
the largest of their values. The nodes discover no others and end at once.
"""

import json
import os
import sys
from collections.abc import Iterator, Sequence

import rclpy
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from musculoskeletal_ae.exceptions import printable
from musculoskeletal_ae.nodes.declared_parameters import PARAMETERS
from musculoskeletal_ae.ros.ros_arguments import PARAMETER_ERRORS, reason
from musculoskeletal_ae.ros_tools.ros_tool import start_ros


def arguments_of(node: str, arguments: Sequence[str]) -> Iterator[str]:
    """Yield the ROS arguments of a node: NODE:NAME:=VALUE of `-p` as NAME:=VALUE, or not at all."""
    for flag, value in zip(['', *arguments], arguments):
        name = value.partition(':=')[0]
        if value == '-p':
            continue
        if flag != '-p':
            yield value
        elif ':' not in name:
            yield from ('-p', value)
        elif name.startswith(f'{node}:'):
            yield from ('-p', value.removeprefix(f'{node}:'))


def chosen_value(name: str, nodes: Sequence[str], arguments: Sequence[str]) -> object:
    """Return the largest value that these nodes get for the parameter `name` by ROS arguments."""
    values = []
    for each in nodes:
        node = Node(
            each,
            cli_args=[*arguments_of(each, arguments)],
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        values.append(node.declare_parameter(name, PARAMETERS[each][name].default).value)
        node.destroy_node()
    return max(values)


def main(arguments: Sequence[str]) -> int:
    """Print the value of a parameter; return the exit status, 2 for a wrong ROS argument.

    Args:
        arguments: Name of the parameter, names of the nodes, ROS arguments.
    """
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
    try:
        name, *nodes = remove_ros_args(list(arguments))
        start_ros([])
        print(json.dumps(chosen_value(name, nodes, arguments[1 + len(nodes) :])))
    except PARAMETER_ERRORS as error:
        print(printable(f'bringup.sh: {reason(error)}'), file=sys.stderr)
        return 2
    finally:
        rclpy.try_shutdown()
    return 0
