# SPDX-License-Identifier: Apache-2.0
"""The executor of nodes and tools, and everything else that needs private names of rclpy.

rclpy's `SingleThreadedExecutor` rebuilds its wait set, in Python, for every message, and runs each
callback as a task. At 200 Hz this takes half of a node's CPU time. `LeanExecutor` keeps the wait
set until entities are created or destroyed, and calls callbacks directly. `LeanExecutor` uses
private names of rclpy. It therefore runs only with versions of rclpy that it was tested with, and
only if all of these names exist. Otherwise `SingleThreadedExecutor` runs, and the log says so.
rclpy's `EventsExecutor` cannot replace `LeanExecutor`: up to rclpy 7.1.7 it runs no callbacks. In
7.1.11 it passes a message and its information as one tuple to callbacks that take both.

The environment variable MUSCULOSKELETAL_AE_EXECUTOR overrides the choice: lean or single.

No other file of this package uses names that rclpy does not publish. The few that other files need
are therefore here as well: `RCLError`, the base class of errors that rcl returns, for example for
an invalid topic name, two kinds of errors for ROS arguments, and `parameter_overrides`.
"""

import os
import re
import time
from collections.abc import Callable
from contextlib import ExitStack
from importlib import metadata
from inspect import iscoroutinefunction
from typing import Any, NamedTuple

from rclpy.constants import S_TO_NS
from rclpy.context import Context
from rclpy.event_handler import EventHandler
from rclpy.executors import (
    Executor,
    ExternalShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.task import Task
from rclpy.timer import Timer
from rclpy.waitable import NumberOfEntities

from musculoskeletal_ae.exceptions import MusculoskeletalError

RCLError = rclpy_implementation.RCLError
RCLInvalidROSArgsError = rclpy_implementation.RCLInvalidROSArgsError
UnknownROSArgsError = rclpy_implementation.UnknownROSArgsError

#: environment variable that selects the executor: `lean` or `single`
VARIABLE = 'MUSCULOSKELETAL_AE_EXECUTOR'
CHOICES = ('lean', 'single')
#: choose LeanExecutor by default from the first to the second of these versions of rclpy, with
#: which it was tested
TESTED = (7, 1, 1), (7, 1, 11)
#: undocumented attributes of SingleThreadedExecutor that LeanExecutor uses
PRIVATE_NAMES = (
    '_guard', '_is_shutdown',
    '_take_client', '_take_service', '_take_subscription', '_take_timer',
)  # fmt: skip
FULL_ROUND_PERIOD = 1.0  # run a full round (see `LeanExecutor`) after at most this time [s]


class _Group(NamedTuple):
    """Entities of one kind, such as all subscriptions of the executor's nodes."""

    kind: str  # name of the kind in rclpy's wait set
    handles: list[Any]
    by_pointer: dict[int, Any]  # the entities by the pointers of their handles
    add: Callable[[Any], None]  # adds a handle to the wait set
    #: takes the message of an entity, and returns a function that calls the callback with it
    take: Callable[[Any], Any]


def _group(
    kind: str, entities: list[Any], add: Callable[[Any], None], take: Callable[[Any], Any]
) -> _Group:
    handles = [entity.handle for entity in entities]
    by_pointer = {handle.pointer: entity for handle, entity in zip(handles, entities)}
    return _Group(kind, handles, by_pointer, add, take)


class LeanExecutor(SingleThreadedExecutor):
    """Runs the callbacks of timers, subscriptions, services and clients with little overhead.

    All other work is left to the slower code of rclpy, which runs from time to time in a *full
    round*. Changes of entities, unfinished asynchronous callbacks, other tasks and actions trigger
    a full round immediately. QoS events wait for the next full round, which begins at most a second
    later.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        self._is_changed = True  # whether entities or tasks have been added or removed
        super().__init__(context=context)
        self._wait_set: Any = None  # wait set of rcl; None before it is built
        self._groups: tuple[_Group, ...] = ()
        self._actions: list[Any] = []
        self._handles = ExitStack()  # keeps entities of the wait set alive
        self._next_full_round = 0.0  # time of the next full round on the monotonic clock [s]

    # Each of the following methods triggers the guard condition, which wakes the executor. They
    # also set `_is_changed`, because the guard condition does not show why it was triggered: rclpy
    # triggers it after every callback of a full round, too.

    def add_node(self, node: Node) -> bool:
        """Add a node whose callbacks are to run."""
        self._is_changed = True
        return super().add_node(node)

    def remove_node(self, node: Node) -> None:
        """Remove a node, whose callbacks do not run any more."""
        self._is_changed = True
        super().remove_node(node)

    def wake(self) -> None:
        """Wake the executor, because a node has created or destroyed an entity."""
        self._is_changed = True
        super().wake()

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Task:
        """Create and return a task that runs a function or coroutine in the next *full round*."""
        self._is_changed = True
        return super().create_task(callback, *args, **kwargs)

    def spin(self) -> None:
        """Run callbacks until shutdown.

        In some versions of rclpy, the inherited `spin` would not call this class's `spin_once`.
        """
        while self.context.ok() and not self._is_shutdown:
            self.spin_once()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait until a callback is ready, then run all ready callbacks.

        The wait lasts at most `timeout_sec` [s], and at most FULL_ROUND_PERIOD.
        """
        if self._wait_set is None:
            self._build_wait_set()
        wait_set, groups = self._wait_set, self._groups
        wait_set.clear_entities()
        for group in groups:
            for handle in group.handles:
                group.add(handle)
        for action in self._actions:
            action.add_to_wait_set(wait_set)
        wait_set.add_guard_condition(self._guard.handle)
        longest = FULL_ROUND_PERIOD if timeout_sec is None else min(timeout_sec, FULL_ROUND_PERIOD)
        wait_set.wait(int(longest * S_TO_NS))
        if not self.context.ok():
            raise ExternalShutdownException
        has_action = any(action.is_ready(wait_set) for action in self._actions)
        for group in groups:
            for pointer in wait_set.get_ready_entities(group.kind):
                self._run(group.by_pointer[pointer], group.take)
        # Up to rclpy 7.1.8, tasks that await a future must be polled. Finished tasks may still be
        # listed. Later versions call `create_task` or list a task as ready to resume it.
        if hasattr(self, '_tasks'):
            is_resumed = any(not task.done() for task, _, _ in self._tasks)
        else:
            is_resumed = bool(getattr(self, '_ready_tasks', ()))
        is_due = is_resumed or has_action or time.monotonic() >= self._next_full_round
        if (self._is_changed or is_due) and not self._is_shutdown:
            self._run_full_round()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Release the entities of the wait set, then shut the base class down."""
        self._release()
        return super().shutdown(timeout_sec)

    def _run(self, entity: Any, take: Callable[[Any], Any]) -> None:
        # Skip a timer that another callback has cancelled since the wait.
        if isinstance(entity, Timer) and not entity.handle.is_timer_ready():
            return
        execute = take(entity)
        if execute is None:
            return
        if iscoroutinefunction(getattr(entity, 'callback', None)):
            self.create_task(execute)
            return
        try:
            execute().send(None)  # runs to the end, because the callback awaits nothing
        except StopIteration:
            pass

    def _run_full_round(self) -> None:
        self._is_changed = False
        self._release()
        try:
            while True:
                handler, _, _ = self.wait_for_ready_callbacks(0.0)
                handler()
                if handler.done():
                    handler.result()  # raises what the callback raised
        except TimeoutException:
            self._next_full_round = time.monotonic() + FULL_ROUND_PERIOD

    def _build_wait_set(self) -> None:
        nodes = self.get_nodes()
        subscriptions = [each for node in nodes for each in node.subscriptions]
        timers = [each for node in nodes for each in node.timers]
        clients = [each for node in nodes for each in node.clients]
        services = [each for node in nodes for each in node.services]
        waitables = [each for node in nodes for each in node.waitables]
        self._actions = [each for each in waitables if not isinstance(each, EventHandler)]
        entities: list[Any] = [*subscriptions, *timers, *clients, *services, self._guard]
        for entity in entities:
            self._handles.enter_context(entity.handle)
        count = NumberOfEntities(len(subscriptions), 1, len(timers), len(clients), len(services))
        for action in self._actions:
            self._handles.enter_context(action)
            count += action.get_num_entities()
        new = self._wait_set = rclpy_implementation.WaitSet(
            count.num_subscriptions, count.num_guard_conditions, count.num_timers,
            count.num_clients, count.num_services, count.num_events, self.context.handle,
        )  # fmt: skip
        self._groups = (
            _group('timer', timers, new.add_timer, self._take_timer),
            _group('subscription', subscriptions, new.add_subscription, self._take_subscription),
            _group('service', services, new.add_service, self._take_service),
            _group('client', clients, new.add_client, self._take_client),
        )

    def _release(self) -> None:
        self._wait_set, self._groups, self._actions = None, (), []
        self._handles.close()


def make_executor(context: Context | None = None) -> Executor:
    """Return a `LeanExecutor` if it supports this rclpy, otherwise a `SingleThreadedExecutor`.

    An environment variable can select one of the two. Even then, `LeanExecutor` is not returned if
    rclpy lacks a private name that it needs.

    Raises:
        MusculoskeletalError: If the environment selects an unknown executor.
    """
    choice = os.environ.get(VARIABLE, '')
    if choice not in ('', *CHOICES):
        raise MusculoskeletalError(f'{VARIABLE}={choice!r}; legal: {", ".join(CHOICES)}')
    version = _rclpy_version()
    installed = f'rclpy {_dotted(version) or "of unknown version"}'
    if choice == 'lean' or (not choice and TESTED[0] <= version <= TESTED[1]):
        executor = LeanExecutor(context=context)
        missing = [name for name in PRIVATE_NAMES if not hasattr(executor, name)]
        if not missing:
            return executor
        executor.shutdown()
        installed += f', which has no {missing[0]}'
    if choice != 'single':
        get_logger('musculoskeletal_ae').info(
            f'using SingleThreadedExecutor: LeanExecutor was tested with rclpy '
            f'{_dotted(TESTED[0])} to {_dotted(TESTED[1])}, and this is {installed}'
        )
    return SingleThreadedExecutor(context=context)


def parameter_overrides(node: Node) -> list[str]:
    """Return the names of the parameters that the command line or a file sets for a node.

    They include names that the node does not declare. The result is empty if rclpy has no such
    list.
    """
    return list(getattr(node, '_parameter_overrides', {}))


def _rclpy_version() -> tuple[int, ...]:
    try:
        version = metadata.version('rclpy')
    except metadata.PackageNotFoundError:
        return ()
    return tuple(map(int, re.findall(r'\d+', version)[:3]))


def _dotted(version: tuple[int, ...]) -> str:
    return '.'.join(map(str, version))
