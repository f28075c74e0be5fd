# SPDX-License-Identifier: Apache-2.0
"""What `record` and `replay` share: from command line to exit status, without a traceback."""

from __future__ import annotations

import signal
import sys
from argparse import Namespace
from collections.abc import Callable
from importlib import import_module
from typing import Any, NoReturn

import rclpy
from rclpy.exceptions import InvalidTopicNameException
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.nodes.running import PARAMETER_ERRORS, reason


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
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        _refuse(arguments, error)


def _own_arguments(arguments: list[str]) -> list[str]:
    try:
        return remove_ros_args(arguments)[1:]
    except RuntimeError as error:
        _refuse(arguments, error)


def _refuse(arguments: list[str], error: RuntimeError) -> NoReturn:
    print(f'{arguments[0]}: error: --ros-args: {reason(error)}', file=sys.stderr)
    sys.exit(2)


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
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return work(parse(_own_arguments(arguments)), arguments)
    except (MusculoskeletalError, InvalidTopicNameException, *PARAMETER_ERRORS) as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    finally:
        rclpy.try_shutdown()
