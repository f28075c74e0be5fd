# SPDX-License-Identifier: Apache-2.0
"""The tool `record`: the topics to an mcap bag that `ros2 bag` can read."""

import math
import sys
import time
from argparse import ArgumentTypeError, Namespace
from contextlib import suppress
from datetime import datetime
from functools import partial
from pathlib import Path

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos

from musculoskeletal_ae.bags.metadata import offered_qos
from musculoskeletal_ae.bags.topics import TOPICS, Topic
from musculoskeletal_ae.bags.writer import COMPRESSIONS, BagWriter, recover
from musculoskeletal_ae.nodes.ros_tool import ROS_HELP, Spinner, message_class, run_tool, start_ros
from musculoskeletal_ae.options import Parser, names, positive
from musculoskeletal_ae.stop_signals import STOP, Reaction

# What the recorder may lose when it is killed is what is younger than this.
FLUSH_PERIOD = 0.5  # [s]
# A second or two of the fastest topic, while the disk is busy.
LIVE = QoSProfile(depth=1000)
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# After Ctrl-C: what has arrived and waits to be taken still belongs to the recording.
DRAIN_TIME = 0.5  # [s]


class Record(Node):
    """Writes what arrives, serialized as it is."""

    def __init__(self, writer: BagWriter, topics: list[str]) -> None:
        super().__init__('record')
        self.writer = writer
        self.received = 0
        #: what was latched before the first /clock, by topic; how much else came before
        self._early: dict[str, tuple[Topic, bytes, dict[str, int]]] = {}
        self.timeless = 0
        self._sim_time = self.get_parameter('use_sim_time').value
        for name in topics:
            topic = TOPICS[name]
            resolved = self.resolve_topic_name(name)
            qos = LATCHED if topic.latched else LIVE
            receive = partial(self._receive, resolved, topic)
            self.create_subscription(message_class(topic.type), name, receive, qos, raw=True)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(FLUSH_PERIOD, writer.flush, clock=steady)

    def _receive(self, name: str, topic: Topic, data: bytes, info: dict[str, int]) -> None:
        now = self.get_clock().now().nanoseconds if self._sim_time else info['received_timestamp']
        self.received += 1
        if now == 0:  # of a simulated clock that has not begun
            self.timeless += not topic.latched
            if topic.latched:
                self._early[name] = topic, data, info
            return
        early, self._early = self._early, {}
        for each, (kind, held, its) in early.items():
            self._write(each, kind, now, held, its)
        self._write(name, topic, now, data, info)

    def _write(self, name: str, topic: Topic, now: int, data: bytes, info: dict[str, int]) -> None:
        if name not in self.writer.topics:
            self.writer.add_topic(name, topic.type, self._offered(name, topic))
        self.writer.write(name, now, info['source_timestamp'], data)

    def _offered(self, name: str, topic: Topic) -> list[Qos]:
        """Return what the publishers of a topic offer; their depth cannot be seen from here."""
        offered = [
            offered_qos(
                info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
                reliable=info.qos_profile.reliability == ReliabilityPolicy.RELIABLE,
            )
            for info in self.get_publishers_info_by_topic(name)
        ]
        return offered or [offered_qos(topic.latched)]


def _record(options: Namespace, arguments: list[str]) -> None:
    start_ros(arguments)
    out = options.out or Path(f'{datetime.now():%Y_%m_%d-%H_%M_%S}_bag')  # noqa: DTZ005 - local
    with BagWriter(out, options.compression) as writer:
        node = Record(writer, options.topics)
        with Spinner(node) as spinner:
            print(f'recording to {out}; Ctrl-C ends it', file=sys.stderr, flush=True)
            with suppress(KeyboardInterrupt):
                spinner.spin_until(lambda: False, options.duration or math.inf)
            drained, before = time.monotonic() + DRAIN_TIME, -1
            while time.monotonic() < drained and node.received != before:
                before = node.received
                spinner.spin_once(0.05)
        node.destroy_node()
    if node.timeless:
        problem = 'messages came before the first /clock, and are left out'
        print(f'warning: {node.timeless} {problem}', file=sys.stderr)
    print(f'{writer.message_count} messages recorded to {out}', file=sys.stderr)


def parse(arguments: list[str]) -> Namespace:
    """Return the options of `record`."""
    what = 'Records the topics of this package to a bag that `ros2 bag` can read. Ctrl-C ends it. '
    parser = Parser('record', what + ROS_HELP)
    add = parser.add_argument
    add('directory', nargs='?', type=Path, metavar='DIR', help='new directory')
    add('-o', '--out', type=Path, metavar='DIR', help='the same')
    add('--topics', type=_topics, metavar='LIST', help='names separated by commas (default: all)')
    add('--duration', type=positive, metavar='S', help='stop after this time [s]')
    add('--compression', choices=COMPRESSIONS, default='zstd', help='of the messages')
    recover_help = (
        'copy what can be read of a bag, such as one whose recorder was killed, to a finished one '
        'in DIR (default: BAG_recovered)'
    )
    add('--recover', type=Path, metavar='BAG', help=recover_help)
    options = parser.parse_args(arguments)
    if options.directory and options.out:
        parser.error('DIR is given twice')
    if options.recover and (options.topics or options.duration):
        parser.error('--recover copies the whole recording: without --topics and --duration')
    options.out = options.out or options.directory
    options.topics = options.topics or list(TOPICS)
    return options


def _topics(text: str) -> list[str]:
    listed = names(text)
    if unknown := [name for name in listed if name not in TOPICS]:
        raise ArgumentTypeError(f'{unknown[0]!r} is none of {", ".join(TOPICS)}')
    return listed


def _work(options: Namespace, arguments: list[str]) -> int:
    if options.recover:
        bag = options.recover
        target = options.out or bag.with_name(f'{bag.stem}_recovered')
        count, left_out = recover(bag, target, options.compression)
        print(f'{count} messages recovered to {target}')
        if left_out:
            problem = f'left out, since they are not in CDR: {", ".join(left_out)}'
            print(f'warning: {bag}: {problem}', file=sys.stderr)
    else:
        with STOP.reacting(Reaction.REMEMBER):  # what waits in the queues is still written
            _record(options, arguments)
    return 0


main = partial(run_tool, 'record', parse, _work)
