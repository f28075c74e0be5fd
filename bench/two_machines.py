# SPDX-License-Identifier: Apache-2.0
"""Learns across a bad network: the learner in one network namespace, the rest in another.

python -m bench two_machines [--minutes 3] [--loss 0.05] [--delay 0.05] [--cut 10] [--seed 0]

Needs Linux, root and the `ip` command (network namespaces, veth). Two runs of the shipped arm, each
with a new learner: one on a perfect link, one where this process passes on every Ethernet frame
late, drops a share of them, and lets nothing through for a while in the middle (what `tc netem`
does, without its kernel module). Exit status 1 if the second run learned worse (error of the last
half minute), lost a sample, or if the arm's side does not end with the learner's network.
"""

from __future__ import annotations

import contextlib
import heapq
import json
import math
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from ament_index_python.packages import get_package_prefix

from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.learning.state import StateStore
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.options import Parser, number, whole
from musculoskeletal_ae.robot.robot import Robot

ROBOT = 'musashi_left_arm'
MARGIN = 1.5  # the bad link's error may be this much of the good one's: chosen, not measured
SIOCETHTOOL, ETHTOOL_STXCSUM = 0x8946, 0x17


def ip(*words: str) -> None:
    """Run `ip`."""
    subprocess.run(['ip', *words], check=True, capture_output=True, text=True)


def leave_checksums_to_the_kernel(interface: str, namespace: str) -> None:
    """Have checksums computed when a frame is sent: we pass frames on as they are."""
    code = (
        'import array, fcntl, socket, struct\n'
        f'value = array.array("B", struct.pack("II", {ETHTOOL_STXCSUM}, 0))\n'
        f'request = struct.pack("16sP", b"{interface}", value.buffer_info()[0])\n'
        f'fcntl.ioctl(socket.socket(socket.AF_INET, socket.SOCK_DGRAM), {SIOCETHTOOL}, request)\n'
    )
    subprocess.run(['ip', 'netns', 'exec', namespace, sys.executable, '-c', code], check=True)


class Outcome(NamedTuple):
    """What was seen at the arm's side, and what was on the learner's disk afterwards."""

    before: float  # error of the first five seconds [rad]
    after: float  # of the last half minute
    samples: list[int]  # of the learner, each second
    kept: int  # samples on disk
    versions: tuple[int, int]  # of the network: last received, on disk
    stopped: int  # [s] the controller was
    frames: tuple[int, int]  # passed, lost


class Link:
    """Passes frames between two interfaces; loses and delays them; can be cut."""

    def __init__(self, ends: tuple[str, str], loss: float, delay: float, seed: int) -> None:
        """Join the ends; loss: share of frames; delay [s]."""
        self.cut = False
        self.passed = self.lost = 0
        self._loss, self._delay = loss, delay
        self._rng = np.random.default_rng(seed)
        self._sockets = []
        for end in ends:
            packets = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3))
            packets.bind((end, 0))
            packets.setblocking(False)
            self._sockets.append(packets)
        self._running = True
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        waiting: list[tuple[float, int, socket.socket, bytes]] = []
        while self._running:
            left = max(0.0, waiting[0][0] - time.monotonic()) if waiting else 0.2
            for source in select.select(self._sockets, [], [], min(left, 0.2))[0]:
                frame, address = source.recvfrom(65536)
                if address[2] == socket.PACKET_OUTGOING:  # our own
                    continue
                if self.cut or self._rng.random() < self._loss:
                    self.lost += 1
                    continue
                self.passed += 1
                target = self._sockets[1 - self._sockets.index(source)]
                due = time.monotonic() + self._delay
                heapq.heappush(waiting, (due, self.passed, target, frame))
            while waiting and waiting[0][0] <= time.monotonic():
                _, _, target, frame = heapq.heappop(waiting)
                with contextlib.suppress(OSError):  # a full buffer loses frames, as a network does
                    target.send(frame)

    def close(self) -> None:
        """Pass nothing on any more."""
        self._running = False
        self._thread.join()
        for packets in self._sockets:
            packets.close()


@contextlib.contextmanager
def network(loss: float, delay: float, seed: int) -> Iterator[tuple[str, str, Link]]:
    """Make two namespaces with a link between them; yield both names and the link."""
    names = [f'mae{os.getpid()}{letter}' for letter in 'ab']
    ends = [f'v{os.getpid()}{letter}' for letter in 'ab']
    try:
        for number, (name, end) in enumerate(zip(names, ends)):
            ip('netns', 'add', name)
            ip('link', 'add', end, 'type', 'veth', 'peer', 'name', 'eth0', 'netns', name)
            ip('link', 'set', end, 'up')
            inside = ('-n', name)
            ip(*inside, 'addr', 'add', f'10.77.0.{number + 1}/24', 'dev', 'eth0')
            for device in ('lo', 'eth0'):
                ip(*inside, 'link', 'set', device, 'up')
            ip(*inside, 'route', 'add', '224.0.0.0/4', 'dev', 'eth0')
            leave_checksums_to_the_kernel('eth0', name)
        link = Link((ends[0], ends[1]), loss, delay, seed)
        try:
            yield names[0], names[1], link
        finally:
            link.close()
    finally:
        for name in names:
            subprocess.run(['ip', 'netns', 'del', name], check=False, capture_output=True)


# -- inside the arm's namespace -------------------------------------------------------------------


def observe() -> int:
    """Print what is seen at the arm's side, a line of JSON a second, until SIGTERM."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.executors import ExternalShutdownException
    from sensor_msgs.msg import JointState
    from std_msgs.msg import UInt8MultiArray

    from musculoskeletal_ae.nodes.messages import LATCHED

    rclpy.init()
    node = rclpy.create_node('observer')
    theta: dict[str, np.ndarray] = {}
    seen: dict[str, object] = {'samples': 0, 'version': 0, 'controller': ''}
    errors: list[float] = []

    def estimated(message: JointState) -> None:
        if 'true' in theta:
            errors.append(float(np.linalg.norm(np.array(message.position) - theta['true'])))

    def diagnosed(message: DiagnosticArray) -> None:
        for status in message.status:
            name = status.name.strip('/').partition(':')[0]
            if name == 'learner':
                seen['samples'] = int({v.key: v.value for v in status.values}['samples'])
            elif name == 'controller':
                seen['controller'] = status.message

    def received(message: UInt8MultiArray) -> None:
        seen['version'] = checkpoint.from_bytes(bytes(message.data)).version

    def report() -> None:
        mean = float(np.mean(errors)) if errors else None
        print(json.dumps({'error': mean, **seen}), flush=True)
        errors.clear()

    node.create_subscription(
        JointState, 'joint_states', lambda m: theta.update(true=np.array(m.position)), 10
    )
    node.create_subscription(JointState, 'estimated_joint_states', estimated, 10)
    node.create_subscription(DiagnosticArray, '/diagnostics', diagnosed, 50)
    node.create_subscription(UInt8MultiArray, 'mae_checkpoint', received, LATCHED)
    node.create_timer(1.0, report)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    return 0


# -- outside --------------------------------------------------------------------------------------


def learn(initial: Path, minutes: float, seed: int, bad: tuple[float, float, float]) -> Outcome:
    """Let a new learner learn across a link; bad: share lost, delay [s], cut in the middle [s]."""
    folder = Path(get_package_prefix('musculoskeletal_ae')) / 'lib' / 'musculoskeletal_ae'
    environment = os.environ | {
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET',
        # TCP: a datagram of 64 kB hardly survives; a full socket may not hold a publisher up
        'FASTDDS_BUILTIN_TRANSPORTS': 'LARGE_DATA?non_blocking=true',
        'ROS_DOMAIN_ID': '0',
    }
    loss, delay, cut = bad
    processes: list[subprocess.Popen[str]] = []
    lines: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as state, network(loss, delay, seed) as (arm, far, link):

        def start(where: str, *words: str, output: int) -> subprocess.Popen[str]:
            command = ['ip', 'netns', 'exec', where, sys.executable, *words]
            process = subprocess.Popen(
                command, env=environment, text=True, start_new_session=True, stdout=output
            )
            processes.append(process)
            return process

        def node(where: str, name: str, **parameters: object) -> None:
            words = [
                word for key, value in parameters.items() for word in ('-p', f'{key}:={value}')
            ]
            start(where, str(folder / name), '--ros-args', *words, output=subprocess.DEVNULL)

        try:
            node(arm, 'hardware_emulator', robot=ROBOT, seed=seed)
            node(arm, 'estimator', robot=ROBOT, checkpoint=initial)
            node(arm, 'controller', robot=ROBOT, checkpoint=initial, explore='true')
            node(far, 'learner', robot=ROBOT, checkpoint=initial, state_directory=state)
            watch = '-m', 'bench', 'two_machines', '--observe'
            observer = start(arm, *watch, output=subprocess.PIPE)
            end = math.inf
            for line in observer.stdout or ():
                now, seen = time.monotonic(), json.loads(line)
                if end == math.inf and seen['error'] is not None and seen['version']:
                    end = now + 60.0 * minutes
                if end < math.inf:
                    lines.append(seen)
                    link.cut = 0.0 <= now - (end - 30.0 * minutes) < cut
                if now > end:
                    break
        finally:
            for process in processes:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGTERM)
            for process in processes:
                process.wait()
        store = SampleStore()
        mae = StateStore(state, Robot.load(ROBOT)).load(store)
    errors = [line['error'] for line in lines if line['error'] is not None]
    return Outcome(
        before=float(np.mean(errors[:5])),
        after=float(np.mean(errors[-30:])),
        samples=[line['samples'] for line in lines],
        kept=len(store.samples),
        versions=(lines[-1]['version'], 0 if mae is None else mae.version),
        stopped=sum(line['controller'].startswith('stopped') for line in lines),
        frames=(link.passed, link.lost),
    )


def main(argv: list[str]) -> int:
    """Compare learning across both links."""
    if argv == ['--observe']:
        return observe()
    parser = Parser('two_machines', (__doc__ or '').partition('\n')[0])
    parser.add_argument('--minutes', type=number(1.0, 60.0), default=3.0, help='of learning, each')
    parser.add_argument('--loss', type=number(0.0, 0.5), default=0.05, help='share of frames lost')
    parser.add_argument('--delay', type=number(0.0, 1.0), default=0.05, help='each way [s]')
    parser.add_argument('--cut', type=number(0.0, 60.0), default=10.0, help='nothing passes [s]')
    parser.add_argument('--seed', type=whole(0, 2**31), default=0, help='of arm and losses')
    args = parser.parse_args(argv)
    if os.geteuid() != 0 or not shutil.which('ip'):
        print('two_machines needs root and the `ip` command: network namespaces', file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        initial = Path(folder) / 'initial.safetensors'
        checkpoint.save(initial_mae(Robot.load(ROBOT), 'default', seed=0).mae, initial)
        outcomes = {
            name: learn(initial, args.minutes, args.seed, bad)
            for name, bad in (
                ('perfect link', (0.0, 0.0, 0.0)),
                ('bad link', (args.loss, args.delay, args.cut)),
            )
        }
    for name, o in outcomes.items():
        print(
            f'{name}: error {o.before:.3f} -> {o.after:.3f} rad, samples {o.samples[-1]} seen and '
            f'{o.kept} on disk, network {o.versions[0]} at the arm and {o.versions[1]} on disk, '
            f'{o.stopped} s stopped, frames {o.frames[0]} passed and {o.frames[1]} lost'
        )
    good, bad = outcomes.values()
    faults = {
        'learned worse': bad.after > MARGIN * good.after,
        'lost samples': min(np.diff(bad.samples)) < 0 or bad.kept < bad.samples[-1],
        'the arm lacks the network': bad.versions[0] < bad.versions[1] - 1,  # one on its way
        'the arm stopped': bad.stopped > good.stopped,
    }
    for fault, there in faults.items():
        print(f'{fault}: {"YES" if there else "no"}')
    return int(any(faults.values()))
