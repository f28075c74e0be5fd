# SPDX-License-Identifier: Apache-2.0
"""Runs the whole system on an emulated arm, and attacks it by a hostile node on its ROS graph.

The hostile node publishes on every subscribed topic and calls every service. It also injects faults
into sensors, tendons and motors, and kills nodes. All commands of the controller are recorded.
"""

from __future__ import annotations

import math
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.node import NodeNameNonExistentError
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String, UInt8MultiArray
from std_srvs.srv import SetBool, Trigger

from bench.processes import end_processes, memory
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.conditions import KINDS as CONDITION_KINDS
from musculoskeletal_ae.emulator.faults import KINDS, read_fault
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.nodes.declared_parameters import PARAMETERS
from musculoskeletal_ae.nodes.reported_conditions import Situation
from musculoskeletal_ae.process_signals import STOP
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.ros.message_building import LATCHED, bytes_message
from musculoskeletal_ae.ros_tools.ros_tool import Spinner, message_class
from musculoskeletal_ae.signals.muscle_states import raw_muscle_states

NODES = ('hardware_emulator', 'estimator', 'controller', 'learner', 'sim', 'bringup_status')
RUN = 'import sys; from musculoskeletal_ae.nodes import running; running.run(sys.argv.pop(1))'
SERVICES = {
    'std_srvs/srv/Trigger': Trigger,
    'std_srvs/srv/SetBool': SetBool,
    'rcl_interfaces/srv/SetParameters': SetParameters,
    'rcl_interfaces/srv/SetParametersAtomically': SetParametersAtomically,
    'rcl_interfaces/srv/GetParameters': GetParameters,
    'rcl_interfaces/srv/GetParameterTypes': GetParameterTypes,
    'rcl_interfaces/srv/DescribeParameters': DescribeParameters,
    'rcl_interfaces/srv/ListParameters': ListParameters,
}
OWN = QoSProfile(depth=1000)
JUDGE_PERIOD = 0.25  # check the status line at this interval [s]
PATIENCE = 90.0  # wait at most this long for an expected event [s]
COOLING = 900.0  # wait at most this much longer for overheated windings to cool [s]
WARM = 40.0  # reset the emulated arm before an attack if a winding is warmer than this [°C]
LENGTH, TENSION = 'muscle_length_command', 'muscle_tension_command'

FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-300, 1e9, -1e9, 1e308, -1e308, math.nan, math.inf, -math.inf)
#: values that every parameter must refuse
ILLEGAL = (math.nan, math.inf, -math.inf, 1e308, -1e308, -1e12)
TEXTS = ('', 'torso', '\x1b[2J', '\x9b1m', 'ö' * 300, '/dev/zero', 'a\nb', '*' * 3000)
LENGTHS = (0, 1, 2, 6, 18, 1000)


class Command(NamedTuple):
    """One command that the controller published."""

    time: float  # time of publishing by the publisher's clock [s]
    number: int  # sequence number of the message
    life: int  # number of times that the controller had been started before the command
    topic: str
    value: Array


class Process:
    """One node's process, with its log and its memory over time."""

    def __init__(self, name: str, command: list[str], log: Path) -> None:
        """Start the process of the node `name`; append its output to the file `log`."""
        self.name, self.log = name, log
        with log.open('ab') as stream:
            self.process = subprocess.Popen(command, stdout=stream, stderr=subprocess.STDOUT)
        self.started = time.monotonic()
        #: resident memory of the process over time: age [s] and memory [MB]
        self.memory: list[tuple[float, float]] = []

    def alive(self) -> bool:
        """Return whether the process still runs."""
        return self.process.poll() is None

    def look(self) -> None:
        """Record the resident memory of the process at its present age."""
        with suppress(OSError):  # the process has just ended
            self.memory.append((time.monotonic() - self.started, memory(self.process.pid)))

    def kill(self) -> None:
        """Kill the process by SIGKILL, which gives it no time to save anything."""
        self.process.kill()
        self.process.wait()


class Attack:
    """The system under attack; a context manager that ends all processes at exit."""

    def __init__(self, folder: Path, initial: Path, seed: int, rate: float = 100.0) -> None:
        """Join the graph of ROS_DOMAIN_ID and start the system.

        Args:
            folder: Folder of the logs and of the learner's state.
            initial: The network to start from.
            seed: Random seed of the attacks; their timing depends on the machine.
            rate: Rate of the muscle modules' messages [Hz].
        """
        self.folder, self.initial, self.rate = folder, initial, rate
        self.robot = Robot.load('arm26')
        self.rng = random.Random(seed)  # noqa: S311 - must be repeatable
        self.namespace = f'/attack_{os.getpid()}_{seed}'
        # `bench.__main__` handles stop signals; rclpy's handlers would end the context first.
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node('stranger', namespace=self.namespace)
        self.executor = Spinner(self.node)
        self.processes: dict[str, Process] = {}
        self.publishers: dict[str, Any] = {}
        self.clients: dict[str, Any] = {}
        #: digests by which hostile messages are told from genuine ones
        self.sent: set[int] = set()
        self.genuine: dict[str, Any] = {}  # last message that the system itself sent, by topic
        self.commands: list[Command] = []
        self.life = 0
        #: measured tensions T over time: time [s] and T [N] (M,)
        self.loads: list[tuple[float, Array]] = []
        self.levels: dict[str, tuple[float, DiagnosticStatus]] = {}
        self.silences: dict[str, float] = {}  # longest time between two reports of a node [s]
        self.tried: Counter[str] = Counter()
        self.findings: dict[str, list[str]] = {}
        self.samples = 0
        self.situation = Situation(self.namespace)
        self.status: list[
            tuple[float, str, str]
        ] = []  # time [s], level and text of the status line
        #: mode of the controller over time: time [s] and mode
        self.modes: list[tuple[float, str]] = []
        self.foreign: list[
            tuple[float, float]
        ] = []  # intervals in which other nodes may send commands [s]
        self.lying: list[tuple[float, float]] = []  # intervals in which sensor data are wrong [s]
        #: intervals in which the hostile node may command the modules or pull at the hand [s]
        self.pulled: list[tuple[float, float]] = []
        self.strangers: list[Process] = []  # duplicate nodes that the attack started
        self.watches_processes = True  # whether a process that ends counts as a violation
        self._learner = ''  # identity of the system's own learner, from /diagnostics
        self._other_learners = set[str]()  # identities of the learners that the attack started
        self._lying_since = 0.0  # time since which sensor data are wrong [s]; 0 if they are right
        self._topics: dict[str, str] = {}
        self._services: dict[str, str] = {}
        self._looked = self._judged = 0.0
        self._listen()

    @property
    def has_detected(self) -> bool:
        """Whether the estimator reports an anomaly."""
        return any(
            (kind := CONDITION_KINDS.get(each.condition.identifier)) is not None
            and kind.reaction is not None
            and each.condition.level == 'error'
            for each in self.situation.conditions()
        )

    def __enter__(self) -> Attack:
        for name in NODES:
            self.start(name)
        return self

    def __exit__(self, *_: object) -> None:
        self.end_strangers()
        for process in self.processes.values():  # a suspended process would not end by SIGTERM
            with suppress(ProcessLookupError):
                process.process.send_signal(signal.SIGCONT)
        end_processes([process.process for process in self.processes.values()], signal.SIGTERM)
        self.node.destroy_node()
        rclpy.try_shutdown()

    def start(self, name: str) -> None:
        """Start a node of the attacked system, with the parameters of the bench."""
        self.processes[name] = self.process(name)
        self.levels.pop(name, None)
        self.life += name == 'controller'

    def start_second(self, name: str, node: str = '') -> None:
        """Start a second process of the node `name`, under the node name `node` if it is given."""
        remapping = ['-r', f'__node:={node}'] if node else []
        self.strangers.append(self.process(name, f'second_{name}', remapping))

    def end_strangers(self) -> None:
        """End all processes and publishers of the hostile node."""
        end_processes([process.process for process in self.strangers], signal.SIGTERM)
        self.strangers.clear()
        for publisher in self.publishers.values():
            self.node.destroy_publisher(publisher)
        self.publishers.clear()

    def process(self, name: str, log: str = '', remapping: Sequence[str] = ()) -> Process:
        """Start the process of the node `name`, with the parameters that the bench sets for it.

        `log` names the log file if the node's name does not. `remapping` are further ROS arguments.
        """
        # A second node needs a state directory of its own, because the first one locks its own.
        saved = f'state_directory:={self.folder / (log or "state")}'
        own = {
            'controller': ['max_age:=1.0', 'explore:=true', saved],
            'estimator': [saved],
            'learner': [saved],
            'hardware_emulator': ['sensors:=["joints", "marker:10"]'],
        }
        parameters = ['robot:=arm26', f'rate:={float(self.rate)}', *own.get(name, [])]
        if 'checkpoint' in PARAMETERS[name]:
            parameters.append(f'checkpoint:={self.initial}')
        words = [part for parameter in parameters for part in ('-p', parameter)]
        python = [sys.executable, '-X', 'faulthandler']  # a crash prints the stacks of all threads
        command = [*python, '-c', RUN, name, '--ros-args', '-r', f'__ns:={self.namespace}']
        file = self.folder / f'{log or name}.log'
        return Process(name, [*command, *remapping, *words], file)

    def found(self, promise: str, what: str) -> None:
        """Record a violation of a promise; `what` describes the violation."""
        self.findings.setdefault(promise, []).append(what)

    # -- watching -------------------------------------------------------------------------------

    def _listen(self) -> None:
        for topic in (LENGTH, TENSION):
            self._subscribe(Float64MultiArray, topic, OWN)
        for topic in ('muscle_states', 'anomaly'):
            self._subscribe(message_class(f'std_msgs/msg/{KINDS_OF[topic]}'), topic, OWN)
        for topic in ('joint_states', 'estimated_joint_states', 'target_joint_states'):
            self._subscribe(JointState, topic, OWN)
        for topic in ('mae_checkpoint', 'accepted_checkpoint'):
            self._subscribe(UInt8MultiArray, topic, LATCHED)
        self.node.create_subscription(String, 'controller_mode', self._changed_mode, LATCHED)  # type: ignore[arg-type]
        take = self._diagnosed
        self.node.create_subscription(DiagnosticArray, '/diagnostics', take, OWN)  # type: ignore[arg-type]

    def _subscribe(self, kind: type, topic: str, qos: QoSProfile) -> None:
        def take(message: Any, info: dict[str, Any]) -> None:
            if digest(message) in self.sent:
                return
            self.genuine[topic] = message
            stamp = info['source_timestamp'] / 1e9
            if topic in (LENGTH, TENSION):
                number, value = info['publication_sequence_number'], np.array(message.data)
                self.commands.append(Command(stamp, number, self.life, topic, value))
            elif topic == 'muscle_states':
                self.loads.append((stamp, raw_muscle_states(message, self.robot).tension))

        self.node.create_subscription(kind, topic, take, qos)  # type: ignore[arg-type]

    def _changed_mode(self, message: String, info: dict[str, Any]) -> None:
        self.modes.append((info['source_timestamp'] / 1e9, message.data))

    def _diagnosed(self, message: DiagnosticArray, info: dict[str, Any]) -> None:
        self.situation.diagnosed(message)
        for status in message.status:
            name = status.name.removeprefix(f'{self.namespace}/').removesuffix(': state')
            if status.hardware_id == self.robot.description.directory.name and name in NODES:
                now = info['source_timestamp'] / 1e9
                if name in self.levels:
                    silence = now - self.levels[name][0]
                    self.silences[name] = max(self.silences.get(name, 0.0), silence)
                self.levels[name] = now, status
                if name == 'learner':
                    self._count_samples(status)

    def _count_samples(self, status: DiagnosticStatus) -> None:
        values = {value.key: value.value for value in status.values}
        identity = values.get('identity', '')
        if self.strangers and identity != self._learner:
            self._other_learners.add(identity)
        if identity in self._other_learners:
            return
        self._learner = identity
        accepted = int(values.get('accepted', '0'))
        if accepted < self.samples:
            self.found('samples survive', f'{self.samples} samples accepted, {accepted} now')
        self.samples = accepted

    def spin(self, seconds: float) -> None:
        """Process messages for a time [s], and check the processes."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(0.05)
            STOP.raise_if_received()
            if time.monotonic() > self._judged + JUDGE_PERIOD:
                self._judged = time.monotonic()
                self.situation.forget_ended()
                now, level = time.time(), self.situation.level()
                self.status.append((now, level, self.situation.trouble()))
            if time.monotonic() > self._looked + 1.0:
                self._looked = time.monotonic()
                for name, process in self.processes.items():
                    process.look()
                    if not process.alive() and self.watches_processes:
                        end_of_log = process.log.read_text('utf-8', 'replace')[-500:]
                        status = process.process.returncode
                        self.found('no node ends', f'{name} ended with {status}: {end_of_log}')
                        self.start(name)

    def wait(self, condition: Callable[[], Any], promise: str, what: str) -> bool:
        """Wait for a condition, and process messages; return False if it does not hold in time.

        A timeout is recorded as a violation of `promise`; `what` states what the bench waited for.
        """
        end = time.monotonic() + PATIENCE
        while not condition():
            if time.monotonic() > end:
                self.found(promise, f'timeout after {PATIENCE:g} s: {what}')
                return False
            self.spin(0.1)
        return True

    def call(self, kind: Any, service: str, request: Any = None) -> Any:
        """Call a service; return its response, or None if no response arrives in time."""
        client = self._client(kind, service)
        futures: list[Any] = []

        def answered() -> bool:
            # A killed node seems ready for some time, and requests to it are lost. The request is
            # therefore repeated every 5 s.
            if client.service_is_ready() and len(futures) < 1 + (time.monotonic() - begun) / 5.0:
                futures.append(client.call_async(request or kind.Request()))
            return any(future.done() for future in futures)

        begun = time.monotonic()
        self.wait(answered, 'every node answers', f'an answer of {service}')
        return next((future.result() for future in futures if future.done()), None)

    def _client(self, kind: Any, service: str) -> Any:
        if service not in self.clients:
            self.clients[service] = self.node.create_client(kind, service)
        return self.clients[service]

    def send(self, kind: Any, service: str, request: Any = None) -> None:
        """Send a request to a service without waiting for the response."""
        client = self._client(kind, service)
        if client.service_is_ready():
            client.remove_pending_request(client.call_async(request or kind.Request()))
            self.tried['requests'] += 1

    def send_parameter(self, node: str, name: str, value: Any) -> None:
        """Send the parameter `name` to a node without waiting for the response."""
        self.send(SetParameters, f'{node}/set_parameters', set_request(name, value))

    def set_faults(self, lines: list[str]) -> None:
        """Set the faults of the emulated arm; `lines` is its parameter `faults`."""
        if self._lying_since:
            self.lying.append((self._lying_since, time.time() + 1.0))
        is_lying = any(line.split(':')[0] not in MECHANICAL for line in lines)
        self._lying_since = time.time() if is_lying else 0.0
        request = set_request('faults', lines or [''])
        self.call(SetParameters, 'hardware_emulator/set_parameters', request)

    def moving(self) -> bool:
        """Remove all faults, reset the nodes and explore; return whether the arm moves.

        If the estimator refuses a reset because it has revoked length offsets, they are calibrated.

        If the arm does not move in time, this is recorded as a violation.
        """
        self.wait(
            lambda: set(self.levels) == set(NODES), 'every node goes on', 'reports of all nodes'
        )
        self.set_faults([])
        for node, name, value in HEALTHY:
            self.call(SetParameters, f'{node}/set_parameters', set_request(name, value))
        self.call(Trigger, 'estimator/restore')
        # Reset the arm only if necessary: a reset puts it into its first posture, and the jump of
        # the lengths would require their calibration.
        if self.levels['hardware_emulator'][1].level != DiagnosticStatus.OK or self.is_warm():
            self.call(Trigger, 'hardware_emulator/reset')
        self.call(SetBool, 'learner/enable', SetBool.Request(data=True))
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            answer = self.call(Trigger, 'estimator/reset')
            if answer is not None and 'estimator/zero' in answer.message:
                self.calibrate_lengths()
            self.spin(0.3)
            answer = self.call(Trigger, 'controller/reset')
            if answer is not None and answer.success:
                explored = self.call(SetBool, 'controller/explore', SetBool.Request(data=True))
                count = len(self.commands)
                self.spin(0.5)
                if explored is not None and explored.success and len(self.commands) > count + 10:
                    return True
            self.spin(0.5)
        why = answer.message if answer is not None else 'no answer'
        self.found('the arm moves again after an attack', f'in {PATIENCE:g} s: {why}')
        return False

    def calibrate_lengths(self) -> None:
        """Calibrate the lengths: request the calibration, and wait until it has ended.

        The calibration takes half a minute of gentle motion. A second request would restart it.
        """
        self.call(Trigger, 'estimator/zero')
        self.call(Trigger, 'controller/reset')
        self.call(SetBool, 'controller/explore', SetBool.Request(data=True))
        end = time.monotonic() + 0.6 * PATIENCE
        is_calibrating = True
        while is_calibrating and time.monotonic() < end:
            self.spin(1.0)
            is_calibrating = Step.CALIBRATE_LENGTHS in self.situation.steps()

    def is_warm(self) -> bool:
        """Return whether a winding was warmer than WARM in the last genuine message."""
        states = self.genuine.get('muscle_states')
        return states is None or not raw_muscle_states(states, self.robot).temperature.max() <= WARM

    # -- attacking ------------------------------------------------------------------------------

    def topics(self) -> dict[str, str]:
        """Return the types of all subscribed topics, by name."""
        for name in NODES:
            with suppress(NodeNameNonExistentError):  # a node just killed: its topics are known
                pairs = self.node.get_subscriber_names_and_types_by_node(name, self.namespace)
                self._topics |= {topic: kinds[0] for topic, kinds in pairs}
        return self._topics

    def services(self) -> dict[str, str]:
        """Return the types of all services that the bench can call, by name."""
        for name in NODES:
            with suppress(NodeNameNonExistentError):
                pairs = self.node.get_service_names_and_types_by_node(name, self.namespace)
                self._services |= {s: kinds[0] for s, kinds in pairs if kinds[0] in SERVICES}
        return self._services

    def publish(self, topic: str, kind: str) -> None:
        """Publish one hostile message of the type `kind` on a topic."""
        if topic not in self.publishers:
            # `episode` destroys latching publishers after a burst, and thereby their last message.
            qos = LATCHED if topic.endswith(LATCHING) else OWN
            self.publishers[topic] = self.node.create_publisher(message_class(kind), topic, qos)
            self.spin(0.1)
        message = self.hostile(topic.removeprefix(f'{self.namespace}/'), message_class(kind))
        self.sent.add(digest(message))
        try:
            self.publishers[topic].publish(message)
        except (TypeError, ValueError, AssertionError, UnicodeError):
            return  # rclpy refuses to send this message, so it does not count as sent
        self.tried['messages'] += 1

    def hostile(self, topic: str, kind: Any) -> Any:
        """Return a hostile message for a topic, of the type `kind`.

        It is the last genuine message with changed values, or one with random content.
        """
        rng, last = self.rng, self.genuine.get(topic)
        if topic.endswith('_checkpoint') and last is not None and rng.random() < 0.7:
            return bytes_message(self._network(bytes(last.data)))
        if last is None or rng.random() < 0.3:
            return filled(kind(), rng)
        message = kind(**{name: getattr(last, name) for name in kind.get_fields_and_field_types()})
        for name in ('data', 'position'):
            values = getattr(message, name, ())
            if getattr(values, 'typecode', '') != 'd' or not len(values):
                continue
            values = np.array(values, dtype=float)
            for _ in range(rng.choice((1, 1, 2, len(values)))):
                i = rng.randrange(len(values))
                noise = rng.choice((0.01, -0.05, 0.1, 1.0, 50.0, -500.0, 1e308))
                old = float(values[i])
                values[i] = rng.choice((old + noise, old * -1.5, rng.choice(FLOATS)))
            setattr(message, name, values.tolist())
        return message

    def _network(self, data: bytes) -> bytes:
        """Return a damaged checkpoint, or a valid one of another body."""
        changed, rng = bytearray(data), self.rng
        way = rng.randrange(4)
        if way == 0:
            return data[: rng.randrange(len(data))]
        if way == 1:
            for _ in range(rng.choice((1, 10, 1000))):
                changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
            return bytes(changed)
        if way == 2:
            return rng.randbytes(rng.choice((0, 8, 10_000)))
        mae = checkpoint.from_bytes(data, self.robot)
        scale = rng.choice((1.5, 1.7, 2.0, -1.0, 0.0))
        layers = tuple((weight * scale, bias) for weight, bias in mae.decoder)
        return checkpoint.to_bytes(replace(mae, decoder=layers))

    def request(self, service: str, kind: str) -> None:
        """Send an illegal request to a service of type `kind` without waiting for the response."""
        rng, name = self.rng, SERVICES[kind]
        request = name.Request()
        node = service.removeprefix(f'{self.namespace}/').split('/')[0]
        if 'SetParameters' in kind:
            names = [*PARAMETERS.get(node, {}), *TEXTS]
            request.parameters = [
                ParameterMessage(name=rng.choice(names), value=illegal_value(rng))
                for _ in range(rng.choice((0, 1, 3)))
            ]
        else:
            filled(request, rng)
        client = self._client(name, service)
        if client.service_is_ready():
            client.remove_pending_request(client.call_async(request))
            self.tried['requests'] += 1

    def fault(self) -> None:
        """Inject a random fault into the arm."""
        name = self.rng.choice(list(KINDS))
        muscle = self.rng.choice(['', *self.robot.muscles]) if KINDS[name].of_muscle else ''
        line = f'{name}:{muscle}' if muscle else name
        read_fault(line, self.robot)
        self.set_faults([line])
        self.tried['faults'] += 1

    def kill(self) -> None:
        """Kill a random node of the system and restart it."""
        name = self.rng.choice(NODES)
        self.processes[name].kill()
        self.tried['kills'] += 1
        self.start(name)

    def episode(self, messages: int, kills: int) -> None:
        """Attack the moving arm with `messages` messages, and kill `kills` nodes.

        The messages come singly and in bursts. Requests to services and faults come in between.
        """
        if not self.moving():
            return
        topics, services = list(self.topics().items()), list(self.services().items())
        # Messages on some topics stop the arm at once. Most episodes therefore use few topics, so
        # that messages on the other topics also meet a moving arm.
        topics = self.rng.sample(topics, self.rng.choice((1, 2, 4, len(topics))))
        until, rng, begin = self.tried['messages'] + messages, self.rng, time.time()
        when = sorted(rng.randrange(messages) for _ in range(kills))
        while (left := until - self.tried['messages']) > 0:
            topic = rng.choice(topics)
            for _ in range(min(left, rng.choice((1, 1, 1, 30, 300)))):
                self.publish(*topic)
                self.executor.spin_once(0.05)
            if topic[0].endswith(LATCHING):
                self.spin(0.1)
                self.node.destroy_publisher(self.publishers.pop(topic[0]))
            if rng.random() < 0.3:
                self.request(*rng.choice(services))
            if rng.random() < 0.02:
                self.fault()
            sent = messages - (until - self.tried['messages'])
            while when and sent >= when[0]:
                when.pop(0)
                self.kill()
            self.spin(rng.choice((0.01, 0.05)))
        self.end_strangers()
        if any(topic.endswith(OBEYED) for topic, _ in topics):
            # The modules keep the last command until a controller, which may have been killed,
            # commands them again.
            self.pulled.append((begin, time.time() + 5.0))


#: topics whose messages the emulated arm obeys, whichever node publishes them
OBEYED = 'muscle_length_command', 'muscle_tension_command', 'external_wrench'
LATCHING = (
    'mae_checkpoint',
    'accepted_checkpoint',
    'body_state',
    'joint_sensor_trust',
    'rejected_checkpoint',
    'publish_again',
)
KINDS_OF = {'muscle_states': 'Float64MultiArray', 'anomaly': 'Float64'}


MECHANICAL = (
    'rupture',
    'stuck_motor',
    'slack',
    'winch_speed',
    'overheat',
)  # faults that leave sensor readings correct
#: parameters of an arm without faults
HEALTHY: tuple[tuple[str, str, Any], ...] = (
    ('controller', 'method', 'proposed'),
    ('estimator', 'on_anomaly', 'stop'),
)


def set_request(name: str, value: Any) -> SetParameters.Request:
    """Return the request that sets the parameter `name` to `value`."""
    return SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])


def digest(message: Any) -> int:
    """Return a digest of a message's values."""
    values = getattr(message, 'data', None)
    if values is None:
        values = getattr(message, 'position', None)
    if values is None or isinstance(values, str | float | bool):
        return hash((type(message).__name__, values))
    return hash((type(message).__name__, len(values), bytes(np.asarray(values))))


def filled(message: Any, rng: random.Random) -> Any:
    """Fill a message's fields with extreme values of their types; return the message."""
    for name, kind in message.get_fields_and_field_types().items():
        base = kind.split('[')[0].removeprefix('sequence<').split(',')[0].removesuffix('>')
        count = None
        if base != kind:
            fixed = kind.partition('[')[2].removesuffix(']')
            count = int(fixed) if fixed else rng.choice(LENGTHS)
        value = _nasty(base, rng) if count is None else [_nasty(base, rng) for _ in range(count)]
        if value is not None and (count is None or None not in value):
            try:
                setattr(message, name, value)
            except (AssertionError, TypeError, ValueError):
                continue
        elif count is None:
            filled(getattr(message, name), rng)
    return message


def _nasty(kind: str, rng: random.Random) -> Any:
    if kind in ('double', 'float'):
        return rng.choice(FLOATS)
    if kind == 'boolean':
        return rng.random() < 0.5
    if kind in ('string', 'wstring'):
        return rng.choice(TEXTS)
    if kind in ('octet', 'byte'):
        return bytes([rng.randrange(256)])
    for sign, prefix in ((0, 'uint'), (1, 'int')):
        if kind.startswith(prefix):
            bits = int(kind.removeprefix(prefix))
            low, high = -(2 ** (bits - 1)) * sign, 2 ** (bits - sign) - 1
            return rng.choice((0, 1, low, high, rng.randint(low, high)))
    return None  # `kind` is the type of a nested message, which `filled` fills


def illegal_value(rng: random.Random) -> ParameterValue:
    """Return a value that is illegal for every parameter."""
    kind = rng.choice((2, 3, 4, 7, 8, 9, 99, 255))
    number, text = rng.choice(ILLEGAL), rng.choice(TEXTS[2:])
    return ParameterValue(
        type=kind,
        integer_value=rng.choice((-5, -(2**63))),
        double_value=number,
        string_value=text,
        integer_array_value=[-5] * 3,
        double_array_value=[number] * rng.choice((1, 2, 6)),
        string_array_value=[text],
    )
