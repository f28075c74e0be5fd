# SPDX-License-Identifier: Apache-2.0
"""Shared code of the ROS tools `check_driver`, `record`, `render`, `replay` and `view`."""

import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import rclpy
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from musculoskeletal_ae.exceptions import MusculoskeletalError, printable
from musculoskeletal_ae.nodes.declared_parameters import OF_RCLPY
from musculoskeletal_ae.options import exit_status
from musculoskeletal_ae.process_signals import STOP, Reaction
from musculoskeletal_ae.ros.executor import RCLError, make_executor
from musculoskeletal_ae.ros.ros_arguments import (
    ARGUMENT_ERRORS,
    PARAMETER_ERRORS,
    parameters_given,
    reason,
)

ROS_HELP = (
    'Options of ROS follow --ros-args, such as  --ros-args -r __ns:=/left_arm -r TOPIC:=OTHER.'
)
LONGEST_WAIT = 0.1  # check a condition and the stop signals after at most this time [s]


def message_class(type_name: str) -> Any:
    """Return the class of a message type, such as `std_msgs/msg/Float64`."""
    package, _, name = type_name.split('/')
    try:
        return getattr(import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError) as error:
        raise MusculoskeletalError(
            f'message type {type_name} is not installed; install the ROS package {package}'
        ) from error


class Spinner:
    """Runs the callbacks of a tool's node while the tool waits.

    An exception in a callback ends the tool. A stop signal that arrives inside rclpy is handled
    after rclpy returns (`process_signals.Reaction.REMEMBER`).
    """

    def __init__(self, node: Node) -> None:
        self._executor = make_executor(node.context)
        self._executor.add_node(node)

    def __enter__(self) -> 'Spinner':
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()

    def spin_once(self, longest: float) -> None:
        """Run the callbacks that are ready; wait at most `longest` [s] for the first."""
        with STOP.reacting(Reaction.REMEMBER):
            self._executor.spin_once(longest)

    def spin_until(self, condition: Callable[[], object], longest: float) -> None:
        """Run callbacks until a condition holds, for at most `longest` [s].

        Raises:
            KeyboardInterrupt: After a stop signal.
        """
        end = time.monotonic() + longest
        while not condition() and (left := end - time.monotonic()) > 0.0:
            self.spin_once(min(LONGEST_WAIT, left))
            STOP.raise_if_received()


def start_ros(arguments: list[str]) -> None:
    """Start ROS without its signal handlers, which would shut publishers down too early."""
    with _clear_ros_arguments(arguments):
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)


def run_tool(
    name: str,
    parse: Callable[[list[str]], Namespace],
    work: Callable[[Namespace, list[str]], int],
    argv: list[str] | None = None,
) -> int:
    """Run a command-line tool and return its exit status.

    Args:
        name: Name of the executable.
        parse: Parses the arguments that are not for ROS.
        work: Does the work of the tool. It is called with the options and with all arguments, and
            returns the exit status.
        argv: Arguments, including those for ROS; by default the arguments of the process.

    Returns:
        The status of `work`; 1 if an input cannot be used; 2 if an option is wrong; INTERRUPTED
        after a stop signal.
    """
    arguments = [name, *(sys.argv[1:] if argv is None else argv)]
    with _clear_ros_arguments(arguments):
        options = parse(remove_ros_args(arguments)[1:])
    for parameter in parameters_given(arguments):
        if parameter not in OF_RCLPY:
            problem = f'{parameter!r} is not a parameter; put options of {name} before --ros-args'
            print(printable(f'{name}: error: {problem}'), file=sys.stderr)
            return 2
    refused = (InvalidTopicNameException, RCLError, *PARAMETER_ERRORS)
    try:
        return exit_status(lambda: _interruptible(work, options, arguments), *refused)
    finally:
        rclpy.try_shutdown()


def _interruptible(
    work: Callable[[Namespace, list[str]], int], options: Namespace, arguments: list[str]
) -> int:
    """Run `work`; treat any error after a stop signal as a consequence of the signal."""
    try:
        return work(options, arguments)
    except ExternalShutdownException as error:
        raise KeyboardInterrupt from error
    except Exception as error:
        if STOP.received:
            raise KeyboardInterrupt from error
        raise


@contextmanager
def _clear_ros_arguments(arguments: list[str]) -> Iterator[None]:
    """End the tool with one line if ROS cannot use its arguments, or cannot start."""
    try:
        yield
    except ARGUMENT_ERRORS as error:
        print(f'{arguments[0]}: error: --ros-args: {reason(error)}', file=sys.stderr)
        sys.exit(2)
    except RuntimeError as error:
        print(f'error: {reason(error)}', file=sys.stderr)
        sys.exit(1)
