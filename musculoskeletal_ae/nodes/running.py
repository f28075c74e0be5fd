# SPDX-License-Identifier: Apache-2.0
"""Start and end of every process: nodes, and the tools `record`, `replay` and `render`."""

import ast
import gc
import os
import signal
import sys
import time
from argparse import Namespace
from collections import deque
from collections.abc import Callable, Coroutine, Generator, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from itertools import chain, pairwise
from pathlib import Path
from types import SimpleNamespace, coroutine
from typing import Any

import rclpy
from rclpy.constants import S_TO_NS
from rclpy.event_handler import EventHandler
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    InvalidTopicNameException,
)
from rclpy.executors import (
    ExternalShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions, uninstall_signal_handlers
from rclpy.timer import Timer
from rclpy.utilities import remove_ros_args
from rclpy.waitable import NumberOfEntities

from musculoskeletal_ae.exceptions import MusculoskeletalError, printable
from musculoskeletal_ae.nodes.parameters import COMBINED, OF_RCLPY, check_names, help_text
from musculoskeletal_ae.options import exit_status
from musculoskeletal_ae.start import load

ROS_HELP = 'ROS options follow --ros-args: -r __ns:=/left_arm, -r TOPIC:=OTHER.'

# What rclpy raises for a value of the wrong type or beyond its range, given at the start.
PARAMETER_ERRORS = (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    rclpy_implementation.UnknownROSArgsError,
    rclpy_implementation.RCLInvalidROSArgsError,
)


EVENTS_EVERY = 1  # [s]
PART = 0.25  # of the time at most goes to callbacks that give way: several nodes do it at once
NICENESS = 5  # of nodes that no command waits for
ASLEEP: Any = SimpleNamespace(trigger=lambda: None)


_interrupts: list[int] = []  # signals that ended something


def interrupt(number: int, _: object) -> None:
    """End by a KeyboardInterrupt, and note it: what rclpy makes of one while it takes is not."""
    _interrupts.append(number)
    raise KeyboardInterrupt


def raise_interrupt(error: Exception) -> None:
    """Raise the KeyboardInterrupt that rclpy made an error of, if it did."""
    if _interrupts:
        raise KeyboardInterrupt from error


def _note_interrupts() -> None:
    _interrupts.clear()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not one that is ignored
        signal.signal(signal.SIGINT, interrupt)


def reason(error: Exception) -> str:
    """Return what rcl says is wrong, without where in its sources it says so."""
    return ' '.join(str(error).split(', at /')[0].split())


def parameters_given(arguments: list[str]) -> list[str]:
    """Return the names that `-p NAME:=VALUE` or `-p NODE:NAME:=VALUE` give values."""
    values = [value for flag, value in pairwise(arguments) if flag in ('-p', '--param')]
    return [value.partition(':=')[0].rpartition(':')[2] for value in values]


@coroutine
def give_way() -> Generator[None, None, None]:
    """Let the executor answer what has come meanwhile; awaited by a callback that takes long."""
    yield


class LeanExecutor(SingleThreadedExecutor):
    """Spins nodes whose callbacks wait for nothing, without what that costs in rclpy.

    rclpy builds its wait set anew, in Python, for every message, with every event of every topic in
    it, and wakes itself twice after each callback: more than half of what a node costs. Here it is
    built when the node's entities change, and holds messages, timers and requests. Actions and
    tasks, at once, and events of quality of service, once a second, go rclpy's way.

    What a callback lets out is told to the node, rclpy's own for /clock and parameters included. A
    callback that takes long is a coroutine that awaits `give_way`: it goes on, one at a time and in
    the order in which they began, a PART of the time, once what has come meanwhile is answered.
    """

    _wait_set: Any = None
    _urgent: tuple[tuple[list[Any], Any, str, Any], ...] = ()
    _actions: tuple[Any, ...] = ()
    _rest_at = _next_piece = 0.0

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._held = ExitStack()
        self._begun: deque[tuple[Any, Coroutine[Any, Any, None]]] = deque()

    def spin(self) -> None:
        """Spin until shutdown."""
        with self._held:
            while self.context.ok() and not self._is_shutdown:
                self.look(EVENTS_EVERY)

    def look(self, longest: float) -> None:
        """Run what there is to run, or wait at most so long [s] for something."""
        if not self._spin_messages(int(longest * S_TO_NS)):
            self._spin_rest()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Let go of the node's entities, and of this executor's own."""
        self._wait_set, self._urgent, self._actions = None, (), ()
        self._begun.clear()
        self._held.close()
        return super().shutdown(timeout_sec)

    def _spin_messages(self, longest: int) -> bool:
        """Wait, and run what messages and timers ask for; False if there may be more to do."""
        if self._wait_set is None:
            self._build()
        waiting = self._wait_set
        waiting.clear_entities()
        for entities, add, _, _ in self._urgent:
            for entity in entities:
                add(entity.handle)
        for action in self._actions:
            action.add_to_wait_set(waiting)
        waiting.wait(self._pause() if self._begun else longest)
        if not self.context.ok():
            raise ExternalShutdownException
        for entities, _, kind, take in self._urgent:
            pointers = waiting.get_ready_entities(kind)
            if pointers and take is None:
                return False
            for entity in entities if pointers else ():
                if entity.handle.pointer in pointers and self._is_due(entity):
                    self._run(entity, take)
        if self._begun and not self._pause():
            start = time.monotonic()
            if not self._goes_on(*self._begun[0]):
                self._begun.popleft()
            self._next_piece = start + (time.monotonic() - start) / PART
        # rclpy asks them again.
        asked = any(action.is_ready(waiting) for action in self._actions)
        return not asked and time.monotonic() < self._rest_at

    @staticmethod
    def _is_due(entity: Any) -> bool:
        return not isinstance(entity, Timer) or entity.handle.is_timer_ready()

    def _run(self, entity: Any, take: Callable[[Any], Any]) -> None:
        try:
            work = take(entity)
        except Exception as error:  # noqa: BLE001
            self._escaped(entity, error)
            return
        if work and self._goes_on(entity, callback := work()):
            self._begun.append((entity, callback))

    def _goes_on(self, entity: Any, callback: Coroutine[Any, Any, None]) -> bool:
        """Run a callback until it ends or gives way; say whether it is to go on."""
        try:
            callback.send(None)
        except StopIteration:
            return False
        except Exception as error:  # noqa: BLE001
            self._escaped(entity, error)
            return False
        return True

    def _pause(self) -> int:
        """Return how long [ns] a callback that gave way is still to wait."""
        return int(max(0.0, self._next_piece - time.monotonic()) * S_TO_NS)

    def _build(self) -> None:
        """Hold on to what nodes have now, so that nothing of it goes while it is waited for."""
        nodes = self.get_nodes()
        kinds: list[list[Any]] = [
            [entity for node in nodes for entity in node.subscriptions],
            [self._guard, self._sigint_gc],
            [entity for node in nodes for entity in node.timers],
            [entity for node in nodes for entity in node.clients],
            [entity for node in nodes for entity in node.services],
        ]
        waitables = chain(*(node.waitables for node in nodes))
        self._actions = tuple(w for w in waitables if not isinstance(w, EventHandler))
        self._held.close()
        for entity in (*(entity.handle for entity in chain(*kinds)), *self._actions):
            self._held.enter_context(entity)
        count = NumberOfEntities(*map(len, kinds))
        for action in self._actions:
            count += action.get_num_entities()
        new = self._wait_set = rclpy_implementation.WaitSet(
            count.num_subscriptions, count.num_guard_conditions, count.num_timers,
            count.num_clients, count.num_services, count.num_events, self.context.handle,
        )  # fmt: skip
        messages, guards, timers, clients, services = kinds
        self._urgent = (
            (timers, new.add_timer, 'timer', self._take_timer),
            (messages, new.add_subscription, 'subscription', self._take_subscription),
            (services, new.add_service, 'service', self._take_service),
            (clients, new.add_client, 'client', self._take_client),
            (guards, new.add_guard_condition, 'guard_condition', None),
        )

    def _spin_rest(self) -> None:
        self._rest_at, self._wait_set = time.monotonic() + EVENTS_EVERY, None
        with suppress(TimeoutException):
            while True:
                handler, _, _ = self.wait_for_ready_callbacks(0.0)
                handler()
                handler.result()

    def _make_handler(self, entity: Any, node: Any, take_from_wait_list: Any) -> Any:
        # The handler would wake this executor, which is awake.
        self._guard, guard = ASLEEP, self._guard
        try:
            return super()._make_handler(
                entity, node, lambda entity: self._run(entity, take_from_wait_list)
            )
        finally:
            self._guard = guard

    def _escaped(self, entity: Any, error: Exception) -> None:
        # The end, asked for by a callback or by a signal while it took or published, is none.
        asked = isinstance(error, ExternalShutdownException) or _interrupts
        if asked or not self.context.ok():
            raise ExternalShutdownException from error
        named = getattr(entity, 'topic_name', None) or getattr(entity, 'srv_name', None)
        nodes: list[Any] = self.get_nodes()
        owners = (n for n in nodes if entity in (*n.subscriptions, *n.timers, *n.services))
        next(owners, nodes[0]).survive(named or type(entity).__name__, error)


def run(name: str) -> None:
    """Run a node, or several in one process, on one thread until it is asked to stop.

    What cannot be used (a robot, a parameter, a checkpoint) ends with one clear line and status 1.
    """
    own, nodes = COMBINED.get(name, (name,)), list[Any]()
    if {'--help', '-h'} & set(sys.argv[1:]):
        # Not by importing the node, which takes a second.
        for each in own:
            source = Path(__file__).with_name(f'{each}.py').read_text(encoding='utf-8')
            print(ast.get_docstring(ast.parse(source)), end='\n\n')
        print(help_text(name))
        return
    try:
        given = sys.argv[1:]
        mine = given[: given.index('--ros-args')] if '--ros-args' in given else given
        if extra := mine or remove_ros_args(sys.argv)[1:]:
            told = f'parameters are given as  {name} --ros-args -p NAME:=VALUE'
            print(f'{name}: error: unknown option {extra[0]!r}; {told}', file=sys.stderr)
            sys.exit(2)
        check_names(parameters_given(given), name)
        modules = [load(f'musculoskeletal_ae.nodes.{each}') for each in own]
        _note_interrupts()  # before rclpy's handler is there, which calls this one
        rclpy.init()
        with LeanExecutor() as executor:
            for module, each in zip(modules, own, strict=True):
                kind = getattr(module, each.title().replace('_', ''))
                _come_second(kind)  # processes that it starts do as well
                nodes.append(kind())
                _come_second(nodes[-1])
                executor.add_node(nodes[-1])
            # What is here by now stays: looking through it again takes 40 ms of a command.
            gc.collect()
            gc.freeze()
            executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except MusculoskeletalError as error:
        sys.exit(f'error: {error}')
    except (*PARAMETER_ERRORS, rclpy_implementation.RCLError) as error:
        if isinstance(error, PARAMETER_ERRORS) or not nodes:
            sys.exit(f'error: {printable(reason(error))}')
        # A callback that publishes while a signal shuts the context down is no failure.
        if rclpy.ok():
            raise
    finally:
        # The thread that shuts the context down at a signal is waited for: beside it, what is
        # destroyed here is destroyed twice.
        uninstall_signal_handlers()
        for again in (signal.SIGINT, signal.SIGTERM):
            signal.signal(again, signal.SIG_IGN)
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()


def _come_second(node: Any) -> None:
    """Let others go first on a busy machine, if no command waits for a node."""
    if not node.hurried:
        os.nice(max(0, NICENESS - os.nice(0)))


# -- tools ----------------------------------------------------------------------------------------


def message_class(type_name: str) -> Any:
    """Return the ROS class of a message type of ROS 2 Jazzy."""
    package, _, name = type_name.split('/')
    try:
        return getattr(import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError) as error:
        raise MusculoskeletalError(
            f'message type {type_name} is not installed; install the ROS package {package}'
        ) from error


class Spinner(LeanExecutor):
    """Spins the node of a tool, as long as the tool wants; what escapes a callback ends it."""

    def __init__(self, node: Node) -> None:
        super().__init__()
        self.add_node(node)

    def spin_until(self, condition: Callable[[], object], longest: float) -> None:
        """Handle what comes until a condition holds, at most so long [s]."""
        end = time.monotonic() + longest
        while not condition() and (left := end - time.monotonic()) > 0.0:
            self.look(min(0.1, left))

    def _escaped(self, _entity: Any, error: Exception) -> None:
        raise_interrupt(error)
        raise error


def start_ros(arguments: list[str]) -> None:
    """Start ROS, signals left to Python: ROS's handlers end publishers before the tool's work."""
    with _clear_ros_arguments(arguments):
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)


def run_tool(
    name: str,
    parse: Callable[[list[str]], Namespace],
    work: Callable[[Namespace, list[str]], int],
    argv: list[str] | None = None,
) -> int:
    """Parse options, work with them and with all arguments, and return the exit status.

    `argv` are the arguments, those for ROS included; None for those of the process. Status 1 says
    that something cannot be used, 2 that an option is wrong.
    """
    arguments = [name, *(sys.argv[1:] if argv is None else argv)]
    _note_interrupts()
    signal.signal(signal.SIGTERM, interrupt)
    with _clear_ros_arguments(arguments):
        options = parse(remove_ros_args(arguments)[1:])
    for given in parameters_given(arguments):
        if given not in OF_RCLPY:
            told = f'{given!r} is no parameter: options of {name} stand before --ros-args'
            print(printable(f'{name}: error: {told}'), file=sys.stderr)
            sys.exit(2)
    try:
        refused = (InvalidTopicNameException, rclpy_implementation.RCLError, *PARAMETER_ERRORS)
        return exit_status(lambda: work(options, arguments), *refused)
    finally:
        rclpy.try_shutdown()


@contextmanager
def _clear_ros_arguments(arguments: list[str]) -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        print(f'{arguments[0]}: error: --ros-args: {reason(error)}', file=sys.stderr)
        sys.exit(2)
