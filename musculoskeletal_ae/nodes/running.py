# SPDX-License-Identifier: Apache-2.0
"""Start and end of every node's process."""

from __future__ import annotations

import ast
import sys
from functools import partial
from importlib import import_module
from pathlib import Path

import rclpy
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.nodes.parameters import help_text

# What rclpy raises for a value of the wrong type or beyond its range, given at the start.
PARAMETER_ERRORS = (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    rclpy_implementation.UnknownROSArgsError,
    rclpy_implementation.RCLInvalidROSArgsError,
)


def reason(error: Exception) -> str:
    """Return what rcl says is wrong, without where in its sources it says so."""
    return ' '.join(str(error).split(', at /')[0].split())


def run(name: str) -> None:
    """Run one node on a single-threaded executor until it is asked to stop.

    What cannot be used (a robot, a parameter, a checkpoint) ends with one clear line and status 1.
    """
    if {'--help', '-h'} & set(sys.argv[1:]):
        # Not by importing the node, which takes a second.
        source = Path(__file__).with_name(f'{name}.py').read_text(encoding='utf-8')
        print(ast.get_docstring(ast.parse(source)), help_text(name), sep='\n\n')
        return
    node: Node | None = None
    try:
        module = import_module(f'musculoskeletal_ae.nodes.{name}')
        rclpy.init()
        node = getattr(module, name.title().replace('_', ''))()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except MusculoskeletalError as error:
        sys.exit(f'error: {error}')
    except PARAMETER_ERRORS as error:
        sys.exit(f'error: {reason(error)}')
    except rclpy_implementation.RCLError as error:
        if node is None:
            sys.exit(f'error: {reason(error)}')
        # A callback that publishes while a signal shuts the context down is no failure.
        if rclpy.ok():
            raise
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


# The entry points of setup.py.
bringup_status = partial(run, 'bringup_status')
controller = partial(run, 'controller')
estimator = partial(run, 'estimator')
hardware_emulator = partial(run, 'hardware_emulator')
learner = partial(run, 'learner')
sim = partial(run, 'sim')
