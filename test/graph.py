# SPDX-License-Identifier: Apache-2.0
"""A ROS graph for tests, over DDS: it runs nodes in any process, and every wait has a deadline."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64MultiArray, UInt8MultiArray

from musculoskeletal_ae.conditions import CONDITIONS, Condition, from_json
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.ros.executor import LeanExecutor
from musculoskeletal_ae.ros.message_building import LATCHED, array_message, bytes_message
from musculoskeletal_ae.signals.body_state import ROWS, BodyState

DEADLINE = 180.0  # longest wait on a loaded machine; then the test fails [s]
PATIENCE = 600.0  # longest time until a process writes its next line or ends [s]
LOOK = 0.05  # time between two checks of a condition [s]
SELDOM = 0.5  # time between two checks of a condition that takes long to check [s]
LEVELS = {DiagnosticStatus.OK: 'ok', DiagnosticStatus.WARN: 'warn', DiagnosticStatus.ERROR: 'error'}


def executable(name: str) -> list[str]:
    """Return the command that runs an installed executable, found as `ros2 run` finds it."""
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        file = Path(prefix) / 'lib' / 'musculoskeletal_ae' / name
        if file.exists():
            return [sys.executable, str(file)]
    raise FileNotFoundError(f'{name} is not installed; run ./test.sh, which builds the package')


class Process:
    """The process of a command.

    Its output goes to a file, because a full pipe that nobody reads would block the process.
    """

    def __init__(self, name: str, command: list[str], **options: Any) -> None:
        """Start a command; options are those of Popen."""
        self.name = name
        self._file = tempfile.NamedTemporaryFile(prefix=f'{name}-', suffix='.log')  # noqa: SIM115
        self.process = subprocess.Popen(
            command, stdout=self._file, stderr=subprocess.STDOUT, **options
        )

    @property
    def output(self) -> str:
        """The output so far."""
        return Path(self._file.name).read_text('utf-8', errors='replace')

    def lines(self) -> Iterator[str]:
        """Yield the lines of the output as they are written, until the command ends."""
        count, deadline = 0, time.monotonic() + PATIENCE
        while True:
            # Check this before reading the output, so that no line written in between is missed.
            has_ended = not self.alive()
            lines = self.output.splitlines(keepends=True)
            if lines and not has_ended and not lines[-1].endswith('\n'):
                lines.pop()  # the process has not finished writing this line
            for line in lines[count:]:
                count += 1
                deadline = time.monotonic() + PATIENCE
                yield line
            if has_ended:
                return
            assert time.monotonic() < deadline, f'{self.name} wrote nothing for {PATIENCE:g} s'
            time.sleep(LOOK)

    def wait_for_output(self, text: str) -> str:
        """Wait for a line that contains a text, and return it."""
        for line in self.lines():
            if text in line:
                return line
        raise AssertionError(f'{self.name} ended without {text!r}: {self.output[-2000:]}')

    def alive(self) -> bool:
        """Whether the command still runs."""
        return self.process.poll() is None

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str]:
        """Stop the command; return exit status and output."""
        if self.alive():
            self.process.send_signal(number)
        return self.ended()

    def ends_silently(self, number: int) -> None:
        """Stop the command; check its exit status, and that it writes no error meanwhile."""
        before = self.output
        status, output = self.end(number)
        assert status in (0, 130), output
        # The program may write more lines of its own, but no error.
        written = output[len(before) :]
        assert not any(word in written for word in ('Traceback', 'ERROR', 'Error')), output

    def ended(self) -> tuple[int, str]:
        """Wait for the end of the command; return exit status and output."""
        try:
            self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        return self.process.returncode, self.output


class Heard(NamedTuple):
    """The last report of a node on /diagnostics."""

    level: str
    message: str
    values: dict[str, str]
    conditions: tuple[Condition, ...]

    @property
    def identifiers(self) -> list[str]:
        """The identifiers of its conditions."""
        return [each.identifier for each in self.conditions]


class Graph:
    """A node of the test, its received messages, and the processes that it started."""

    def __init__(self, namespace: str = '') -> None:
        """Join the graph of ROS_DOMAIN_ID."""
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('test', context=self.context, namespace=namespace)
        self.executor = LeanExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.namespace = namespace
        self.received: dict[str, list[Any]] = defaultdict(list)
        self.processes: list[Process] = []
        self.tools: list[Process] = []  # processes that may end by themselves, unlike `processes`
        self.hosted: list[Node] = []
        self.networks: dict[str, Any] = {}  # publishers of networks, by topic

    def start(self, name: str, **parameters: Any) -> Process:
        """Start a node with parameters, in this graph's namespace."""
        arguments = ['--ros-args']
        for key, value in parameters.items():
            arguments += ['-p', f'{key}:={_yaml(value)}']
        if self.namespace:
            arguments += ['-r', f'__ns:={self.namespace}']
        process = Process(name, [*executable(name), *arguments])
        self.processes.append(process)
        return process

    def run(self, name: str, *options: str) -> Process:
        """Start a tool in this graph's namespace; it ends by itself, or when the test ends."""
        remap = ['--ros-args', '-r', f'__ns:={self.namespace}']
        self.tools.append(Process(name, [*executable(name), *options, *remap]))
        return self.tools[-1]

    def host(self, kind: type[Node], **parameters: Any) -> Any:
        """Run a node with parameters in this process."""
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        node = kind(
            context=self.context,
            namespace=self.namespace,
            use_global_arguments=False,
            parameter_overrides=overrides,
        )
        self.hosted.append(node)
        self.executor.add_node(node)
        return node

    def end(self, node: Node) -> None:
        """End a node that runs in this process."""
        self.hosted.remove(node)
        self.executor.remove_node(node)
        node.destroy_node()

    def ended(self, process: Process, number: int | None = None) -> tuple[int, str]:
        """Wait until a process has ended; return its exit status and its output.

        If `number` is given, the process first receives the signal of this number.
        """
        self.processes.remove(process)
        return process.ended() if number is None else process.end(number)

    def listen(self, kind: type, topic: str, qos: QoSProfile | int = 50) -> list[Any]:
        """Subscribe to a topic; return the list to which messages are appended."""
        self.node.create_subscription(kind, topic, self.received[topic].append, qos)
        return self.received[topic]

    def publisher(self, kind: type, topic: str, qos: QoSProfile | int = 10) -> Any:
        """Advertise a topic, wait for a subscriber, and return the publisher."""
        publisher = self.node.create_publisher(kind, topic, qos)
        self.wait(lambda: publisher.get_subscription_count() > 0, f'a subscriber of {topic}')
        return publisher

    def send_network(self, data: bytes, topic: str = 'mae_checkpoint') -> None:
        """Publish the bytes of a checkpoint as soon as there is a subscriber."""
        if topic not in self.networks:
            self.networks[topic] = self.publisher(UInt8MultiArray, topic, LATCHED)
        self.networks[topic].publish(bytes_message(data))

    def spin(self, seconds: float) -> None:
        """Process messages for a time [s]."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self.executor.spin_once(min(LOOK, left))

    @contextmanager
    def spinning(self) -> Iterator[None]:
        """Let another thread process messages while the block of the `with` statement runs."""
        ended = threading.Event()

        def spin() -> None:
            while not ended.is_set():
                self.executor.spin_once(LOOK)

        thread = threading.Thread(target=spin)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def wait(self, condition: Callable[[], Any], what: str, deadline: float = DEADLINE) -> Any:
        """Process messages until a condition holds, and return its value.

        If the condition does not hold before the deadline [s], the test fails and names `what`.
        """
        end = time.monotonic() + deadline
        while not (value := condition()):
            dead = [p for p in self.processes if not p.alive()]
            if dead:
                status, output = dead[0].end()
                raise AssertionError(f'{dead[0].name} ended with {status}: {output[-2000:]}')
            if time.monotonic() > end:
                raise AssertionError(
                    f'timeout after {deadline:g} s: {what}; {self._last_diagnostics()}'
                )
            self.executor.spin_once(LOOK)
        return value

    def next(self, topic: str, count: int = 1) -> Any:
        """Wait for `count` more messages on a topic, and return the last of them."""
        messages = self.received[topic]
        wanted = len(messages) + count
        self.wait(lambda: len(messages) >= wanted, f'{count} messages on {topic}')
        return messages[-1]

    def report(self, node: str) -> Heard:
        """Return the last report on /diagnostics of a node of this namespace."""
        name = f'{self.namespace}/{node}: state'
        for message in reversed(self.received['/diagnostics']):
            for status in message.status:
                if status.name == name:
                    values = {pair.key: pair.value for pair in status.values}
                    present = from_json(values.get(CONDITIONS, '[]'))
                    return Heard(LEVELS[status.level], status.message, values, present)
        return Heard('warn', 'not heard of', {}, ())

    def _last_diagnostics(self) -> str:
        messages = self.received['/diagnostics'][-200:]
        last = {
            s.name: (s.message, {v.key: v.value for v in s.values})
            for m in messages
            for s in m.status
        }
        return '\n'.join(f'{name}: {reported}' for name, reported in last.items())

    def call(self, kind: type, service: str, request: Any = None) -> Any:
        """Call a service and return its response."""
        client = self.node.create_client(kind, service)
        response = self.ask(client, request or kind.Request())
        self.node.destroy_client(client)
        return response

    def ask(self, client: Any, request: Any) -> Any:
        """Send a request by a client and return the response."""
        self.wait(client.service_is_ready, f'service {client.srv_name}')
        future = client.call_async(request)
        self.wait(future.done, f'an answer of {client.srv_name}')
        return future.result()

    def tell_body(self, body: BodyState) -> None:
        """Publish a body state, as the estimator does."""
        publisher = self.publisher(Float64MultiArray, 'body_state', LATCHED)
        publisher.publish(array_message(body.rows, 'quantity', 'muscle'))

    def follow_body(self, topic: str = 'body_state') -> list[BodyState]:
        """Return a list to which each published body state is appended."""
        bodies: list[BodyState] = []

        def take(message: Float64MultiArray) -> None:
            bodies.append(BodyState.of_rows(np.reshape(message.data, (ROWS, -1))))

        self.node.create_subscription(Float64MultiArray, topic, take, LATCHED)
        return bodies

    def set_parameter(self, node: str, name: str, value: Any) -> tuple[bool, str]:
        """Set a parameter of another node; return success and reason."""
        message: ParameterMessage = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        result = self.call(SetParameters, f'{node}/set_parameters', request).results[0]
        return result.successful, result.reason

    def close(self) -> None:
        """Leave the graph, and end all processes that were started."""
        for process in (*self.processes, *self.tools):
            process.end()
        self.executor.shutdown()  # it must not use nodes that are destroyed next
        for node in (*self.hosted, self.node):
            node.destroy_node()
        rclpy.shutdown(context=self.context)


def seldom(condition: Callable[[], Any]) -> Callable[[], Any]:
    """Return a condition that is checked only every SELDOM seconds, and otherwise does not hold.

    `Graph.wait` checks a condition after each message. If each check takes milliseconds, it would
    occupy a core.
    """
    next_check = 0.0

    def check() -> Any:
        nonlocal next_check
        if time.monotonic() < next_check:
            return None
        value = condition()
        next_check = time.monotonic() + SELDOM
        return value

    return check


def no_number_of(graph: Graph, robot: Robot, muscle: str) -> Callable[[], None]:
    """Isolate a muscle; return a function that publishes states with its tension as NaN."""
    body = BodyState.healthy(robot.muscle_count).with_isolated([robot.muscles.index(muscle)])
    graph.tell_body(replace(body, generation=1))
    publisher = graph.publisher(Float64MultiArray, 'muscle_states')
    rows = np.tile([[0.0], [61.0], [25.0]], robot.muscle_count)
    rows[1, robot.muscles.index(muscle)] = np.nan

    def publish() -> None:
        publisher.publish(array_message(rows, 'quantity', 'muscle'))
        graph.spin(0.05)

    return publish


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"'{value}'"
    return str(value)
