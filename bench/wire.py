# SPDX-License-Identifier: Apache-2.0
"""Measures the running system over ROS: latency of commands, and CPU time of each node.

    python -m bench wire [--robots arm26,musashi_left_arm] [--rates 100,200,500] [--seconds 20]

Emulator, estimator, sim, controller and, in some rows, learner run as `bringup.sh` starts them,
each in a separate process, with the arm exploring. Latency is the time from the publishing of
muscle_states to that of the next muscle_length_command. Other rows are for comparison:

- estimator and controller in one process,
- one plain rclpy node with an estimate in eager torch that converts a tension to a length, without
  safety or control,
- a lower bound: the same number of nodes, which exchange the same messages with the same executor,
  and compute nothing.

    late      messages without a command within two periods
    missed    messages of the emulator that did not arrive
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

import numpy as np

from bench.processes import cpu, end_processes
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.options import Parser, names, number, numbers, whole
from musculoskeletal_ae.process_signals import STOP, Reaction
from musculoskeletal_ae.robot.robot import Robot

NODES = ('hardware_emulator', 'estimator', 'sim', 'controller')
#: names of the nodes that run in each row of the table
KINDS = {
    'nodes': NODES,
    'combined': ('hardware_emulator', 'sim', 'combined'),
    'with learner': (*NODES, 'learner'),
    'combined, with learner': ('hardware_emulator', 'sim', 'combined', 'learner'),
    'plain node, torch': ('hardware_emulator', 'plain'),
    'messages alone': tuple(f'bare_{name}' for name in (*NODES, 'learner')),
}
WARM_UP = 8.0  # begin a measurement this long after the first command [s]
PLAIN = """
import contextlib, sys, numpy as np, rclpy, torch
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.network import from_mae
from musculoskeletal_ae.mae.units import LENGTH_SCALE, TENSION_SCALE
torch.set_num_threads(1)
mae = checkpoint.load(sys.argv[1])
network, M, D = from_mae(mae), len(mae.muscles), len(mae.joints)
class Plain(Node):
    def __init__(self):
        super().__init__('plain')
        self.out = self.create_publisher(Float64MultiArray, 'muscle_length_command', 10)
        self.create_subscription(Float64MultiArray, 'muscle_states', self.take, 10)
    def take(self, message):
        l, T = np.asarray(message.data).reshape(-1, M)[:2]
        row = torch.zeros(1, D + 2 * M)
        row[0, D:D + M] = torch.as_tensor(T * TENSION_SCALE)
        row[0, D + M:] = torch.as_tensor(l * LENGTH_SCALE)
        with torch.no_grad():
            out = network.decoder(network.encode(row, torch.tensor([1])))
        goal = l - np.maximum(T - 30.0, 0.0) / 1e4 + 0.0 * float(out[0, 0])
        self.out.publish(Float64MultiArray(data=goal.tolist()))
rclpy.init()
with contextlib.suppress(KeyboardInterrupt):
    rclpy.spin(Plain())
"""
#: topics of each node: the one whose messages trigger publishing ('' for a timer), the published
#: ones, and the other subscribed ones
BARE = {
    'bare_hardware_emulator': ('', 'muscle_states joint_states', 'muscle_length_command'),
    'bare_estimator': (
        'muscle_states',
        'estimated_joint_states estimated_joint_covariance estimated_muscle_states anomaly wrench',
        'joint_states muscle_length_command',
    ),
    'bare_sim': ('', 'sim/joint_states sim/muscle_states', 'muscle_states muscle_length_command'),
    'bare_controller': ('estimated_joint_states', 'muscle_length_command', 'muscle_states'),
    'bare_learner': ('muscle_states', '', 'joint_states'),
}
ALONE = """
import sys, rclpy
from array import array
from contextlib import suppress
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from musculoskeletal_ae.ros.executor import make_executor
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_states import QUANTITIES
name, robot, rate, at, out, hears = sys.argv[1:]
robot = Robot.load(robot)
def kind(topic):
    return JointState if topic.endswith('joint_states') else Float64MultiArray
def message(topic):
    if kind(topic) is JointState:
        return JointState(name=robot.joints, position=[0.0] * robot.joint_count)
    rows = len(QUANTITIES) if topic.endswith('muscle_states') else 1
    return Float64MultiArray(data=array('d', [0.0] * rows * robot.muscle_count))
rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
node = rclpy.create_node(name)
outs = [(node.create_publisher(kind(topic), topic, 10), topic) for topic in out.split()]
def tell(_=None):
    for publisher, topic in outs:
        publisher.publish(message(topic))
for topic in {at, *hears.split()} - {''}:
    heard = tell if topic == at else lambda _: None
    node.create_subscription(kind(topic), topic, heard, qos_profile_sensor_data)
if not at:
    node.create_timer(1.0 / float(rate), tell)
with make_executor() as executor, suppress(KeyboardInterrupt):
    executor.add_node(node)
    executor.spin()
"""


class System:
    """A running system of nodes in separate processes, whose messages are observed."""

    def __init__(
        self,
        robot: str,
        network: Path,
        rate: float,
        names: tuple[str, ...],
        emulator: Sequence[str] = (),
    ) -> None:
        """Start the nodes; a stop signal during the start ends them.

        Args:
            robot: Name or directory of the robot.
            network: Checkpoint of all nodes.
            rate: Rate of muscle_states [Hz].
            names: Executables.
            emulator: Further parameters of the emulator, each as NAME:=VALUE.
        """
        self.nodes: dict[str, subprocess.Popen[bytes]] = {}
        with STOP.reacting(Reaction.REMEMBER):
            self._start(robot, network, rate, names, emulator)
        if STOP.received:
            self.end()
            raise KeyboardInterrupt

    def _start(
        self,
        robot: str,
        network: Path,
        rate: float,
        names: tuple[str, ...],
        emulator: Sequence[str],
    ) -> None:
        folder = Path(os.environ['AMENT_PREFIX_PATH'].split(':')[0]) / 'lib/musculoskeletal_ae'
        assignments = {name: [f'robot:={robot}', f'rate:={rate}'] for name in names}
        for name in assignments:
            if name == 'hardware_emulator':
                assignments[name] += emulator
            else:
                assignments[name].append(f'checkpoint:={network}')
            if name in ('controller', 'combined'):
                # A busy machine may pause for longer than the default `max_age`, which would stop
                # the arm.
                assignments[name] += ['explore:=true', 'max_age:=1.0']
            if name in ('learner', 'estimator', 'controller', 'combined'):
                assignments[name].append(f'state_directory:={network.parent / str(time.time_ns())}')
        quiet: dict[str, Any] = {'stdout': subprocess.DEVNULL}
        for name in names:
            values = [word for value in assignments[name] for word in ('-p', value)]
            command = [str(folder / name), '--ros-args', *values]
            if name == 'plain':
                command = [sys.executable, '-c', PLAIN, str(network)]
            if name in BARE:
                command = [sys.executable, '-c', ALONE, name, robot, str(rate), *BARE[name]]
            self.nodes[name] = subprocess.Popen(command, **quiet)
        self._listener = Listener(('muscle_states', 'muscle_length_command'))
        self.stamps = self._listener.stamps

    def end(self) -> None:
        """End the nodes."""
        with STOP.reacting(Reaction.REMEMBER):
            end_processes(self.nodes.values(), signal.SIGINT)
            self._listener.end()


class Listener:
    """A node that notes when the messages of topics were published.

    Attributes:
        stamps: Times [ns] of the messages so far, by topic.
    """

    def __init__(self, topics: Iterable[str]) -> None:
        """Join the ROS graph, and listen in a thread."""
        import rclpy
        from rclpy.qos import qos_profile_sensor_data
        from rclpy.signals import SignalHandlerOptions
        from std_msgs.msg import Float64MultiArray

        from musculoskeletal_ae.ros.executor import make_executor

        # With its own signal handlers, rclpy would end only its context on SIGTERM. The handlers of
        # `bench.__main__` end the whole bench.
        self._context = rclpy.Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node('wire', context=self._context, enable_rosout=False)
        executor = make_executor(self._context)
        executor.add_node(self._node)
        self.stamps: dict[str, list[int]] = defaultdict(list)
        for topic in topics:
            # rclpy inspects the signature of a callback and cannot handle that of a `partial`, so
            # a default value binds the topic.
            def take(_: Any, info: dict[str, Any], topic: str = topic) -> None:
                self.stamps[topic].append(info['source_timestamp'])

            # The annotation of rclpy leaves out that a callback may also take the message's info.
            callback: Callable[..., None] = take
            # Leave messages serialized to save CPU time, because only the time stamps are needed.
            self._node.create_subscription(
                Float64MultiArray, topic, callback, qos_profile_sensor_data, raw=True
            )

        def listen() -> None:
            with suppress(rclpy.executors.ExternalShutdownException):
                executor.spin()

        self._thread = Thread(target=listen)
        self._thread.start()

    def end(self) -> None:
        """Leave the ROS graph."""
        self._context.try_shutdown()
        self._thread.join()
        self._node.destroy_node()


class Wire(NamedTuple):
    """Latency, losses and CPU time of a running system of nodes."""

    latency: tuple[float, ...]  # median, 99th percentile and maximum [ms]
    late: float  # messages of the emulator without a command within two periods [%]
    missed: float  # messages of the emulator that did not arrive [%]
    cpu: dict[str, float]  # CPU time of each node [% of a core]

    def __str__(self) -> str:
        """Return latency, losses and CPU times as one line of the table."""
        half, most, largest = self.latency
        cost = ', '.join(f'{name} {value:.0f}' for name, value in self.cpu.items())
        return (
            f'{half:6.2f}{most:7.2f}{largest:7.1f}{self.late:7.2f}{self.missed:7.2f}'
            f'   {sum(self.cpu.values()):4.0f}   {cost}'
        )


def measure(system: System, rate: float, seconds: float) -> Wire:
    """Measure latency, losses and CPU times of a started system over some seconds.

    Raises:
        MusculoskeletalError: If the nodes exchange no messages.
    """
    deadline = time.monotonic() + 60.0
    while not system.stamps['muscle_length_command'] and time.monotonic() < deadline:
        time.sleep(0.5)
    time.sleep(WARM_UP)
    system.stamps.clear()
    before = {name: cpu(process.pid) for name, process in system.nodes.items()}
    start = time.monotonic()
    time.sleep(seconds)
    passed = time.monotonic() - start
    used = {
        name: 100.0 * (cpu(process.pid) - before[name]) / passed
        for name, process in system.nodes.items()
    }
    states, commands = (system.stamps[name] for name in ('muscle_states', 'muscle_length_command'))
    return Wire(*delays(states, commands, rate, passed), used)


def delays(
    state_stamps: Sequence[int], command_stamps: Sequence[int], rate: float, seconds: float
) -> tuple[tuple[float, ...], float, float]:
    """Return latency, late and missed messages, as in `Wire`.

    Args:
        state_stamps: Times of the messages of muscle_states [ns].
        command_stamps: Times of the messages of muscle_length_command [ns].
        rate: Rate of the emulator [Hz].
        seconds: Time in which the messages were sent [s].

    Raises:
        MusculoskeletalError: If there are no messages.
    """
    states, commands = np.array(state_stamps), np.array(command_stamps)
    if not (len(states) and len(commands)):
        problem = f'{len(states)} states and {len(commands)} commands arrived in {seconds:.0f} s'
        raise MusculoskeletalError(
            f'{problem}; see the logs of the nodes, or repeat on an idle machine'
        )
    after = np.searchsorted(commands, states)
    known = after < len(commands)
    latency = (commands[after[known]] - states[known]) * 1e-6  # stamps in ns, latency in ms
    late = (latency > 2e3 / rate).sum() + (states[~known] < states[-1] - 2e9 / rate).sum()
    late = 100.0 * float(late) / len(states)
    missed = 100.0 * max(0.0, 1.0 - len(states) / (rate * seconds))
    return tuple(np.percentile(latency, (50, 99, 100)).tolist()), late, missed


def systems(
    robot: str,
    rates: Iterable[float],
    kinds: Iterable[str],
    seconds: float,
    emulator: Sequence[str] = (),
) -> Iterator[tuple[float, str, Wire]]:
    """Measure one robot at all rates [Hz] with all sets of nodes; yield rate, set and results.

    `kinds` are keys of KINDS, the sets of nodes. `emulator` lists further parameters of the
    emulator, each as NAME:=VALUE.
    """
    with tempfile.TemporaryDirectory() as folder:
        network = Path(folder) / 'network.safetensors'
        checkpoint.save(initial_mae(Robot.load(robot)), network)
        for rate in rates:
            for kind in kinds:
                system = System(robot, network, rate, KINDS[kind], emulator)
                try:
                    yield rate, kind, measure(system, rate, seconds)
                finally:
                    system.end()


def main(argv: list[str]) -> None:
    """Measure every combination of robot, rate and set of nodes, and print a table."""
    parser = Parser('wire', (__doc__ or '').partition('\n')[0])
    robots = 'arm26,musashi_left_arm'
    parser.add_argument('--robots', type=names, default=robots, help='names or directories')
    parser.add_argument(
        '--rates', type=numbers, default='100,200,500', help='message rates of the driver [Hz]'
    )
    parser.add_argument(
        '--seconds', type=number(1.0, 3600.0), default=20.0, help='time of each measurement [s]'
    )
    text = 'emulate an individual of the MuJoCo model in the directory of each robot'
    parser.add_argument('--mujoco', action='store_true', help=text)
    parser.add_argument('--repeat', type=whole(1, 100), default=1, help='number of repetitions')
    args = parser.parse_args(argv)
    print(
        'latency [ms]: median, 99th percentile, maximum; late and missed messages [%]; CPU [% of '
        'a core]'
    )
    kinds = [*KINDS] * args.repeat
    for robot in args.robots:
        model = f'reality:={robot}/model.xml', 'deviates:=true'
        emulator = model if args.mujoco else ()
        for rate, kind, wire in systems(robot, args.rates, kinds, args.seconds, emulator):
            print(f'{Path(robot).name:<20}{rate:4.0f} Hz  {kind:<24}{wire}', flush=True)
