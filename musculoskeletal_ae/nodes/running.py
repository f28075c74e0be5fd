# SPDX-License-Identifier: Apache-2.0
"""Runs a node: checks the arguments, then constructs, spins and destroys the node.

While nodes run, SIGINT and SIGTERM only set a flag (`process_signals`). A timer checks the flag ten
times a second and makes the executor return. Nodes are then destroyed, and after them the ROS
context. The process ends itself after 10 s without progress (`hang_detection`), unless one of its
nodes is not watched (`Shell.is_watched`).
"""

import gc
import os
import sys
from importlib import import_module
from typing import Any

import rclpy
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from musculoskeletal_ae.exceptions import MusculoskeletalError, printable
from musculoskeletal_ae.nodes.declared_parameters import COMBINED, check_names
from musculoskeletal_ae.nodes.shell import STEADY
from musculoskeletal_ae.process_signals import STOP, Reaction
from musculoskeletal_ae.ros.executor import RCLError, make_executor
from musculoskeletal_ae.ros.hang_detection import ProgressWatch
from musculoskeletal_ae.ros.ros_arguments import PARAMETER_ERRORS, parameters_given, reason

STOP_CHECK_PERIOD = 0.1  # check for a stop signal at this interval [s]
NICENESS = 5  # run nodes that are not time-critical with this niceness: commands have priority


def run(name: str) -> int:
    """Run a node, or several in one process and thread, until it is asked to stop.

    Returns:
        The exit status: 0 after a stop; 1, with one line on stderr, if a robot, parameter or
        checkpoint cannot be used; 2 for a wrong option.
    """
    try:
        if unknown := _options_beside_ros():
            remedy = f'set parameters by  {name} --ros-args -p NAME:=VALUE'
            print(f'{name}: error: unknown option {unknown[0]!r}; {remedy}', file=sys.stderr)
            return 2
        check_names(parameters_given(sys.argv[1:]), name)
        kinds = []
        for node in COMBINED.get(name, (name,)):
            module = import_module(f'musculoskeletal_ae.nodes.{node}')
            kinds.append(getattr(module, f'{node.title().replace("_", "")}Node'))
        with STOP.reacting(Reaction.REMEMBER):
            _run(kinds)
    except MusculoskeletalError as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    except (*PARAMETER_ERRORS, RCLError) as error:
        print(f'error: {printable(reason(error))}', file=sys.stderr)
        return 1
    return 0


def _options_beside_ros() -> list[str]:
    """Return the command-line arguments that are not for ROS; a node has no options of its own."""
    arguments = sys.argv[1:]
    end = arguments.index('--ros-args') if '--ros-args' in arguments else len(arguments)
    return arguments[:end] or list(remove_ros_args(sys.argv)[1:])


def _run(kinds: list[Any]) -> None:
    """Construct nodes of the given classes, spin them until a stop, and destroy them."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    nodes: list[Any] = []
    watch = ProgressWatch()
    try:
        with make_executor() as executor:
            with STOP.reacting(Reaction.EXIT_SOON):
                for kind in kinds:
                    _lower_priority(kind)  # child processes inherit the priority
                    nodes.append(kind())
                    _lower_priority(nodes[-1])
                    executor.add_node(nodes[-1])
                    stop_if_asked()
                # Freeze start-up objects, so that later garbage collections do not delay a command
                # by 40 ms.
                gc.collect()
                gc.freeze()

            def check_stop() -> None:
                watch.note()
                stop_if_asked()

            nodes[0].create_timer(STOP_CHECK_PERIOD, check_stop, clock=STEADY)
            if all(node.is_watched for node in nodes):
                watch.start()
            spin(executor, nodes[0])
    except ExternalShutdownException:
        pass
    finally:
        for node in nodes:
            watch.note()
            node.destroy_node()
        rclpy.try_shutdown()
        watch.stop()


def spin(executor: Executor, node: Any) -> None:
    """Spin until the context is shut down, or a callback raises ExternalShutdownException.

    Each node counts the exceptions of its own callbacks. `node` also counts the exceptions that
    rclpy raises outside callbacks, for example for a message that cannot be deserialized.
    """
    while rclpy.ok():
        try:
            executor.spin()
        except ExternalShutdownException:
            return
        except Exception as error:  # noqa: BLE001
            node.on_callback_error('executor', error)


def stop_if_asked() -> None:
    """Raise ExternalShutdownException if a stop signal was received."""
    if STOP.received:
        raise ExternalShutdownException


def _lower_priority(node: Node | type[Node]) -> None:
    """Lower the process priority if the node is not time-critical."""
    if not node.is_time_critical:  # type: ignore[union-attr]
        os.nice(max(0, NICENESS - os.nice(0)))
