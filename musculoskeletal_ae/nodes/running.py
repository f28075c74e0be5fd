# SPDX-License-Identifier: Apache-2.0
"""Start and end of every node's process."""

from __future__ import annotations

import ast
import faulthandler
import sys
from contextlib import suppress
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

import rclpy
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from musculoskeletal_ae.exceptions import MusculoskeletalError, printable
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


def _refuse(error: object) -> NoReturn:
    print(f'error: {printable(error)}', file=sys.stderr)
    sys.exit(1)


class ShieldedExecutor(SingleThreadedExecutor):
    """Goes on whatever a callback or the taking of a message lets out; the node counts it."""

    def _make_handler(self, entity: Any, node: Any, take_from_wait_list: Any) -> Any:
        def escaped(error: Exception) -> None:
            # The end, asked for by a callback or by a signal while it published, is none.
            if isinstance(error, ExternalShutdownException) or not self.context.ok():
                raise error
            named = getattr(entity, 'topic_name', None) or getattr(entity, 'srv_name', None)
            node.survive(named or type(entity).__name__, error)

        def take(entity: Any) -> Any:
            try:
                work = take_from_wait_list(entity)
            except Exception as error:  # noqa: BLE001 - else the executor never asks it again
                return escaped(error)
            if work is None:
                return None

            async def shielded() -> None:
                try:
                    await work()
                except Exception as error:  # noqa: BLE001
                    escaped(error)

            return shielded

        return super()._make_handler(entity, node, take)


def help_of(node: str) -> str:
    """Return what `--help` of a node says, without importing the node, which takes a second."""
    spec = find_spec(f'musculoskeletal_ae.nodes.{node}')
    assert spec is not None and spec.origin is not None
    told = ast.get_docstring(ast.parse(Path(spec.origin).read_text(encoding='utf-8')))
    return f'{told}\n\n{help_text(node)}'


def run(name: str) -> None:
    """Run one node on a single-threaded executor until it is asked to stop.

    What cannot be used (a robot, a parameter, a checkpoint) ends with one clear line and status 1.
    """
    if {'--help', '-h'} & set(sys.argv[1:]):
        print(help_of(name))
        return
    # What ends the interpreter itself says where, on stderr, which bringup.sh keeps.
    with suppress(AttributeError, ValueError, RuntimeError, OSError):
        faulthandler.enable()
    node: Node | None = None
    try:
        module = import_module(f'musculoskeletal_ae.nodes.{name}')
        rclpy.init()
        node = getattr(module, name.title().replace('_', ''))()
        executor = ShieldedExecutor()
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except MusculoskeletalError as error:
        _refuse(error)
    except PARAMETER_ERRORS as error:
        _refuse(reason(error))
    except rclpy_implementation.RCLError as error:
        if node is None:
            _refuse(reason(error))
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
