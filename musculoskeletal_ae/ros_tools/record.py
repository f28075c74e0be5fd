# SPDX-License-Identifier: Apache-2.0
"""The tool `record`: records the topics of this package to a bag that `ros2 bag` can read."""

import math
import sys
import time
from argparse import Namespace
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.event_handler import QoSRequestedIncompatibleQoSInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rosbags.interfaces import Qos

from musculoskeletal_ae.bags.metadata import offered_qos
from musculoskeletal_ae.bags.topics import Topic, topics_with
from musculoskeletal_ae.bags.writer import COMPRESSIONS, BagWriter, recover
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.options import Parser, names, positive
from musculoskeletal_ae.process_signals import STOP, Reaction
from musculoskeletal_ae.report import load_text
from musculoskeletal_ae.robot.motors import NO_MOTORS, motor_topics
from musculoskeletal_ae.ros_tools.ros_tool import (
    ROS_HELP,
    Spinner,
    message_class,
    run_tool,
    start_ros,
)

#: write to disk at this interval [s]; a killed recorder loses the messages since the last write
FLUSH_PERIOD = 0.5
#: QoS whose queue holds at least a second of the fastest topic, in case the disk is busy
LIVE = QoSProfile(depth=1000)
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
DRAIN_TIME = 0.5  # after Ctrl-C, spend at most this time on messages that have already arrived [s]
#: wait this long for publishers to be discovered before a recording is announced [s]
DISCOVERY_TIME = 0.5
CONNECTION_TIME = 2.0  # wait at most this long for connections to the discovered publishers [s]
#: ignore these sequence numbers, which come from middleware that does not number messages
UNNUMBERED = 0, (1 << 64) - 1


class Losses:
    """Counts the messages of each topic that were published, but not received.

    Every publisher numbers its own messages, so a lost message leaves a gap in the sequence
    numbers. A message does not name its publisher. Gaps are therefore only counted while a topic
    has a single publisher.
    """

    def __init__(self) -> None:
        self.lost: Counter[str] = Counter()  # messages by topic, without topics that lost none
        self._last: dict[str, int] = {}  # newest sequence number by topic
        self._gaps: Counter[str] = Counter()  # missing numbers by topic since the last `settle`

    def note(self, topic: str, number: int) -> None:
        """Note the sequence number of a received message."""
        if number in UNNUMBERED:
            return
        # A restarted publisher begins with a small number again, which gives no positive gap.
        gap = number - self._last.get(topic, number) - 1
        if gap > 0:
            self._gaps[topic] += gap
        self._last[topic] = number

    def settle(self, publishers: Callable[[str], int]) -> None:
        """Add the messages that were missed since the last call to `lost`.

        Gaps in the sequence numbers of a topic with several publishers are discarded, because each
        publisher numbers its own messages.

        Args:
            publishers: Function that returns the number of publishers of a topic.
        """
        for topic, gap in self._gaps.items():
            if publishers(topic) <= 1:
                self.lost[topic] += gap
        self._gaps.clear()


class Record(Node):
    """Writes the messages of all recorded topics to a bag, in their serialized form."""

    def __init__(self, writer: BagWriter, topics: dict[str, Topic]) -> None:
        super().__init__('record')
        self.writer = writer
        self.received = 0
        self.losses = Losses()
        #: latched messages that arrived before the first /clock, by topic
        self._early: dict[str, tuple[Topic, bytes, dict[str, int]]] = {}
        self.timeless = 0  # number of messages lost because they arrived before the first /clock
        self._sim_time = self.get_parameter('use_sim_time').value
        #: subscriptions, by the topic's name in the interface
        self._subscriptions_of: dict[str, Subscription] = {}
        #: policy that a publisher does not offer as requested, by topic
        self._incompatible: dict[str, QoSPolicyKind] = {}
        self._topics = topics
        recorded = set[str]()
        for name, topic in topics.items():
            full = self.resolve_topic_name(name)
            if full not in recorded:  # `joint_states` and `/joint_states` may be the same
                recorded.add(full)
                self._subscribe(name, LATCHED if topic.latched else LIVE)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(FLUSH_PERIOD, self._look_after, clock=steady)

    def _subscribe(self, name: str, qos: QoSProfile) -> None:
        full, topic = self.resolve_topic_name(name), self._topics[name]

        def take(data: bytes, info: dict[str, int]) -> None:
            if self._subscriptions_of[name] is subscription:
                self._receive(full, topic, data, info)

        def note_incompatible(event: QoSRequestedIncompatibleQoSInfo) -> None:
            if self._subscriptions_of[name] is subscription:
                self._incompatible[name] = event.last_policy_kind

        receive: Any = take
        subscription: Subscription = self.create_subscription(
            message_class(topic.type), name, receive, qos, raw=True,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=note_incompatible),
        )  # fmt: skip
        self._subscriptions_of[name] = subscription

    def _look_after(self) -> None:
        """Write received messages to disk, count lost messages, and repair subscriptions.

        If a publisher offers a weaker QoS than a subscription requests, the subscription receives
        none of its messages. Such a subscription is replaced by one with the weaker QoS. The old
        one remains until the end, and its messages are ignored: Fast DDS may crash if a
        subscription is destroyed while publishers of its topic come and go
        (`ros/latched_values.py`). A topic has at most three subscriptions, because only two
        policies can be weakened.
        """
        self.writer.flush()
        self.count_losses()
        incompatible, self._incompatible = self._incompatible, {}
        for name, policy in incompatible.items():
            before = self._subscriptions_of[name]
            qos = copy(before.qos_profile)
            if policy == QoSPolicyKind.RELIABILITY:
                qos.reliability = ReliabilityPolicy.BEST_EFFORT
            elif policy == QoSPolicyKind.DURABILITY:
                qos.durability = DurabilityPolicy.VOLATILE
            else:  # no other policy of the subscription can be weakened
                continue
            self._subscribe(name, qos)

    def count_losses(self) -> None:
        """Count the messages lost since the last call; warn when the first messages are lost."""
        had_lost = self.losses.lost.total()
        self.losses.settle(self.count_publishers)
        if self.losses.lost and not had_lost:
            text = 'messages are being lost before they are recorded; end other programs'
            print(f'warning: {text}', file=sys.stderr, flush=True)

    @property
    def is_connected(self) -> bool:
        """Whether all publishers that have been discovered are connected."""
        return all(
            each.get_publisher_count() >= self.count_publishers(each.topic_name)
            for each in self._subscriptions_of.values()
        )

    def missing(self) -> list[str]:
        """Return one text for each topic on which no message has been recorded.

        The text says whether the topic has a publisher.
        """
        silent = [
            each.topic_name
            for each in self._subscriptions_of.values()
            if each.topic_name not in self.writer.topics
        ]
        return [
            f'{name}, which {"sent nothing" if self.count_publishers(name) else "has no publisher"}'
            for name in silent
        ]

    def _receive(self, name: str, topic: Topic, data: bytes, info: dict[str, int]) -> None:
        now = self.get_clock().now().nanoseconds if self._sim_time else info['received_timestamp']
        self.received += 1
        self.losses.note(name, info['publication_sequence_number'])
        if now == 0:  # no /clock message has arrived yet
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
        """Return the durability and reliability that the publishers of a topic offer.

        If the ROS graph shows no publisher, the QoS is the one that the interface of this package
        prescribes for the topic. The graph does not show queue depths, so they have a default.
        """
        offered = [
            offered_qos(
                info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
                reliable=info.qos_profile.reliability == ReliabilityPolicy.RELIABLE,
            )
            for info in self.get_publishers_info_by_topic(name)
        ]
        return offered or [offered_qos(topic.latched)]


def _record(options: Namespace, arguments: list[str]) -> int:
    start_ros(arguments)
    out = options.out or Path(f'{datetime.now():%Y_%m_%d-%H_%M_%S}_bag')  # noqa: DTZ005 - local
    with BagWriter(out, options.compression) as writer:
        node = Record(writer, options.topics)
        with Spinner(node) as spinner:
            with suppress(KeyboardInterrupt):
                # Wait for connections first: the announcement promises that messages published from
                # then on are recorded.
                spinner.spin_until(lambda: False, DISCOVERY_TIME)
                spinner.spin_until(lambda: node.is_connected, CONNECTION_TIME)
                print(f'recording to {out}; Ctrl-C ends it', file=sys.stderr, flush=True)
                spinner.spin_until(lambda: False, options.duration or math.inf)
            drained, before = time.monotonic() + DRAIN_TIME, -1
            while time.monotonic() < drained and node.received != before:
                before = node.received
                spinner.spin_once(0.05)
        missing = node.missing()
        node.count_losses()
        lost = node.losses.lost
        writer.custom = {f'lost messages of {topic}': str(count) for topic, count in lost.items()}
        node.destroy_node()
    if node.timeless:
        problem = 'messages came before the first /clock and were not recorded'
        print(f'warning: {node.timeless} {problem}', file=sys.stderr)
    count = writer.message_count
    print(f'{count} messages recorded to {out}, {lost.total()} lost', file=sys.stderr)
    if lost:
        each = ', '.join(
            f'{topic} {number} of {number + writer.topics[topic].message_count}'
            for topic, number in lost.most_common()
            if topic in writer.topics
        )
        busy = f'this computer or the network was busy (load {load_text()})'
        print(
            f'warning: messages were lost before they were recorded: {each}; {busy}',
            file=sys.stderr,
        )
    if options.are_chosen and missing:
        print(f'warning: no message was recorded of {"; ".join(missing)}', file=sys.stderr)
        return 1
    if not writer.message_count:
        print(
            'warning: nothing was recorded, because no message arrived on any topic; check the '
            'namespace and ROS_DOMAIN_ID',
            file=sys.stderr,
        )
        return 1
    return 0


def parse(arguments: list[str]) -> Namespace:
    """Parse the command line of `record`, and return its options."""
    what = 'Records the topics of this package to a bag that `ros2 bag` can read. Ctrl-C ends it. '
    parser = Parser('record', what + ROS_HELP)
    add = parser.add_argument
    directory_help = 'new directory (default: DATE-TIME_bag)'
    add('directory', nargs='?', type=Path, metavar='DIR', help=directory_help)
    add('-o', '--out', type=Path, metavar='DIR', help='another way to state DIR')
    add('--topics', type=names, metavar='LIST', help='topics, separated by commas (default: all)')
    text = 'robot whose motors.yaml names further topics to record (doc/howto/ros2_control.md)'
    add('--robot', metavar='NAME|DIR', help=text)
    add('--duration', type=positive, metavar='S', help='stop after this time [s]')
    compression_help = 'compression of the chunks of the mcap file'
    add('--compression', choices=COMPRESSIONS, default='zstd', help=compression_help)
    recover_help = (
        'copy all readable messages of a damaged bag (for example, one whose recorder was killed) '
        'to a new bag in DIR (default: BAG_recovered)'
    )
    add('--recover', type=Path, metavar='BAG', help=recover_help)
    options = parser.parse_args(arguments)
    if options.directory and options.out:
        parser.error('DIR is given twice, the second time with --out; state it only once')
    if options.recover and (options.topics or options.duration):
        parser.error('--recover copies the whole recording: remove --topics and --duration')
    options.out = options.out or options.directory
    options.are_chosen = bool(options.topics)
    try:
        topics = topics_with(motor_topics(options.robot) if options.robot else NO_MOTORS)
    except MusculoskeletalError as error:
        parser.error(f'--robot: {error}')
    if unknown := [name for name in options.topics or () if name not in topics]:
        parser.error(f'--topics: unknown topic {unknown[0]!r}; legal: {", ".join(topics)}')
    options.topics = {name: topics[name] for name in options.topics or topics}
    return options


def _work(options: Namespace, arguments: list[str]) -> int:
    if options.recover:
        bag = options.recover
        target = options.out or bag.with_name(f'{bag.stem}_recovered')
        try:
            count, left_out, damaged = recover(bag, target, options.compression)
        except KeyboardInterrupt as stop:
            incomplete = f'{target} is incomplete; remove it, and repeat the command'
            raise KeyboardInterrupt(incomplete) from stop
        print(f'{count} messages recovered to {target}')
        problems = []
        if damaged:
            problems.append(
                f'{", ".join(damaged)} is damaged: messages that cannot be read are '
                'missing, and others may be wrong, because sqlite3 has no checksums'
            )
        if left_out:
            problems.append(f'topics that are not in CDR were not recovered: {", ".join(left_out)}')
        for problem in problems:
            print(f'warning: {bag}: {problem}', file=sys.stderr)
    else:
        with STOP.reacting(Reaction.REMEMBER):  # queued messages are still written
            return _record(options, arguments)
    return 0


main = partial(run_tool, 'record', parse, _work)
