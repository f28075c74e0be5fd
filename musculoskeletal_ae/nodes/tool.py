# SPDX-License-Identifier: Apache-2.0
"""What `record` and `replay` share: from command line to exit status, without a traceback."""

from __future__ import annotations

import faulthandler
import signal
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import rclpy
from rclpy.exceptions import InvalidTopicNameException
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.nodes.running import PARAMETER_ERRORS, reason
from musculoskeletal_ae.options import exit_status

ROS_HELP = 'ROS options follow --ros-args: -r __ns:=/left_arm, -r TOPIC:=OTHER.'


def message_class(type_name: str) -> Any:
    """Return the ROS class of a message type of ROS 2 Jazzy."""
    package, _, name = type_name.split('/')
    try:
        return getattr(import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError) as error:
        raise MusculoskeletalError(
            f'message type {type_name} is not installed; install the ROS package {package}'
        ) from error


def start_ros(arguments: list[str]) -> None:
    """Start ROS with the arguments of the process; signals stay with Python.

    ROS's own handlers take publishers and queues away before the tool has ended its work.
    """
    with _clear_ros_arguments(arguments):
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)


def run_tool(
    name: str,
    parse: Callable[[list[str]], Namespace],
    work: Callable[[Namespace, list[str]], int],
    argv: list[str] | None,
) -> int:
    """Parse options, work and return the exit status.

    Args:
        name: Of the tool.
        parse: Reads the options; ends with status 2 if they are wrong.
        work: Takes the options and all arguments, those for ROS included; returns the status.
        argv: Arguments; None for those of the process.
    """
    arguments = [name, *(sys.argv[1:] if argv is None else argv)]
    faulthandler.enable()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with _clear_ros_arguments(arguments):
        options = parse(remove_ros_args(arguments)[1:])
    try:
        return exit_status(
            lambda: work(options, arguments), InvalidTopicNameException, *PARAMETER_ERRORS
        )
    finally:
        rclpy.try_shutdown()


@contextmanager
def _clear_ros_arguments(arguments: list[str]) -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        print(f'{arguments[0]}: error: --ros-args: {reason(error)}', file=sys.stderr)
        sys.exit(2)
