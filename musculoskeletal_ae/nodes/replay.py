# SPDX-License-Identifier: Apache-2.0
"""The node `replay`: plays a recorded bag onto the topics, or reports what is in it."""

import sys
import time
from argparse import Namespace
from functools import partial
from pathlib import Path

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger
from tqdm import tqdm
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from musculoskeletal_ae.bags.playback import (
    LEAD_TIME,
    TAUGHT_TOPIC,
    Timeline,
    lap,
    taught_motion,
    window,
)
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.topics import ALL, DEFAULT, latched_topics, select
from musculoskeletal_ae.exceptions import BagError, MusculoskeletalError
from musculoskeletal_ae.nodes.diagnostics import PERIOD, Diagnostics
from musculoskeletal_ae.nodes.messages import LATCHED, RELIABLE, array_message, serve
from musculoskeletal_ae.nodes.ros_tool import ROS_HELP, Spinner, message_class, run_tool, start_ros
from musculoskeletal_ae.options import Parser, names, not_negative, number, positive
from musculoskeletal_ae.reception import Reception
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.stop_signals import STOP, Reaction

# Deep enough that a reader that is late by a second still gets everything.
DEPTH = 1000
# Services are answered at least so often; between, a short wait is slept.
SERVICE_PERIOD, SLEPT = 0.02, 0.002  # [s]
# A publisher sees its subscriber a little before the subscriber sees it and takes messages.
SETTLE_TIME = 0.3  # [s]
LAP_GAP = 10_000_000  # [ns] between the last message of a lap and the first of the next
TRAJECTORY = 'joint_trajectory'
# How a report on /diagnostics says that no message was used since the one before.
NO_RATE = '0.0 Hz'
# [s] for a first report of those that listen, and for two reports after a message was sent.
FIRST_REPORT_TIME, REPORT_TIME = 2.0 * PERIOD, 5.0 * PERIOD
SENDINGS = 3  # of a trajectory that does not arrive
# [s] for subscribers: a recording may begin without them, one message is worth a longer wait.
WAIT, SEND_WAIT = 2.0, 10.0
ACKNOWLEDGE_TIME = 2.0  # [s] for reliable readers at the end
# Recorded time between two messages on /clock, but not more often than nodes can bear.
CLOCK_PERIOD, SHORTEST_CLOCK_PERIOD = 0.005, 0.001  # [s]


class Replay(Node):
    """Publishes recorded bytes at their time."""

    def __init__(self, bag: Bag, names: dict[str, str], options: Namespace) -> None:
        """Advertise the topics: `names` says what to publish each recorded one on."""
        super().__init__('replay')
        self._bag, self._names = bag, names
        self._start, self._stop = window(bag, options.start, options.duration)
        self.length = (self._stop - self._start) / 1e9  # [s]
        self._before = (self._start - bag.start) / 1e9  # [s] of the bag
        latched, reliable = latched_topics(bag), QoSProfile(depth=DEPTH)
        self._publisher: dict[str, Publisher] = {}
        for recorded, name in names.items():
            kind, qos = bag.topics[recorded].type, LATCHED if recorded in latched else reliable
            self._publisher[recorded] = self.create_publisher(message_class(kind), name, qos)
        self._recorded_time = None
        if options.clock:
            self._recorded_time = self.create_publisher(Clock, '/clock', QoSProfile(depth=1))
        self._clock_period = max(CLOCK_PERIOD / max(options.rate, 1.0), SHORTEST_CLOCK_PERIOD)
        self._next_tick = self._next_service = self._next_report = 0.0  # on the steady clock [s]
        self._sought: int | None = None  # where to go on [ns]
        description = 'go on from here, counted from the beginning [s]'
        descriptor = ParameterDescriptor(description=description)
        end = self._before + self.length
        legal = FloatingPointRange(from_value=self._before, to_value=end)
        descriptor.floating_point_range = [legal]
        self.declare_parameter('position', self._before, descriptor)
        self.add_post_set_parameters_callback(self._seek)
        self._position_publisher = self.create_publisher(
            Float64MultiArray, 'replay/position', RELIABLE
        )
        reception = Reception(self.get_logger().warning)  # of nothing: it only sends
        self._diagnostics = Diagnostics(self, reception, bag.path.name)
        self._next_time = self._start
        self._timeline = Timeline(self._start - 1, options.rate, time.monotonic())
        if options.paused:
            self._timeline.hold(True, time.monotonic())
        self._spinner = Spinner(self)

    def get_ready(self, longest: float) -> None:
        """Wait until every topic has a subscriber, at most so long [s]; then offer services."""
        topics = [*self._publisher.values(), *filter(None, [self._recorded_time])]
        _await_subscribers(self._spinner, topics, longest)
        for work in (self.pause, self.resume, self.step):
            serve(self, Trigger, f'replay/{work.__name__}', work)

    def play(self, progress: tqdm, again: bool) -> None:
        """Publish everything, from start to stop; again and again until the process is ended."""
        self._lap(progress)
        while again:
            self._wait(self._stop + LAP_GAP, progress)
            self._lap(progress)

    def _lap(self, progress: tqdm) -> None:
        progress.reset()
        self._sought = self._start if self._sought is None else self._sought
        while self._sought is not None:
            start, self._sought = self._sought, None
            # Just before the first message, so that it is not due when the lap begins paused.
            self._timeline.jump(start - 1, time.monotonic())
            for message in lap(self._bag, self._names, start, self._stop):
                if not self._wait(message.log_time, progress):
                    break
                self._timeline.catch_up(message.log_time, time.monotonic())
                self._tick()
                STOP.raise_if_received()
                self._publisher[message.topic].publish(message.data)

    def acknowledge(self) -> None:
        """Give reliable readers time to get the last messages."""
        end = time.monotonic() + ACKNOWLEDGE_TIME
        for publisher in self._publisher.values():
            left = max(0.0, end - time.monotonic())
            publisher.wait_for_all_acked(Duration(nanoseconds=int(left * 1e9)))

    def _wait(self, recorded: int, progress: tqdm) -> bool:
        """Answer services and publish the clock until a recorded time [ns] is due; False: seek."""
        self._next_time = recorded
        while (due := self._timeline.wait(recorded, now := time.monotonic())) > 0:
            if self._sought is not None:
                break
            self._tick()
            wait = min(due, SERVICE_PERIOD)
            if self._recorded_time:
                wait = min(wait, max(self._next_tick - now, 0.0))
            if wait > SLEPT or now > self._next_service:
                self._next_service = now + SERVICE_PERIOD
                self._spinner.spin_once(wait)
                STOP.raise_if_received()
                if now > self._next_report:
                    self._next_report = now + PERIOD
                    doing = 'paused' if self._timeline.paused else 'playing'
                    report = Report('ok', doing, {'position': self._position()})
                    self._diagnostics.tell(report)
                    seconds = self._before + np.array([self._done(), self.length])
                    self._position_publisher.publish(array_message(seconds, ''))
                progress.update(max(0.0, self._done() - progress.n))
            else:
                time.sleep(wait)
        return self._sought is None

    def _tick(self) -> None:
        """Publish the recorded time, if it is wanted and due."""
        if self._recorded_time and (now := time.monotonic()) >= self._next_tick:
            self._next_tick = now + self._clock_period
            seconds, nanoseconds = divmod(self._timeline.recorded(now), 1_000_000_000)
            self._recorded_time.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))

    def _seek(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == 'position':
                self._sought = self._bag.start + int(1e9 * parameter.value)

    def pause(self, _: Trigger.Request) -> str:
        """Stop where it is."""
        self._timeline.hold(True, time.monotonic())
        return f'paused at {self._position()}'

    def resume(self, _: Trigger.Request) -> str:
        """Go on."""
        self._timeline.hold(False, time.monotonic())
        return f'playing at {self._position()}'

    def step(self, _: Trigger.Request) -> str:
        """Publish the messages of the next recorded time."""
        if not self._timeline.paused:
            raise MusculoskeletalError('not paused: call replay/pause first')
        self._timeline.jump(self._next_time, time.monotonic())
        return f'stepped at {self._position()}'

    def _done(self) -> float:
        """Return how much has been played [s]."""
        return max(0.0, (self._timeline.recorded(time.monotonic()) - self._start) / 1e9)

    def _position(self) -> str:
        return f'{self._before + self._done():.6f} s'


def _await_subscribers(spinner: Spinner, publishers: list[Publisher], longest: float) -> None:
    """Wait until every topic has a subscriber that takes messages, at most so long [s]."""
    spinner.spin_until(lambda: all(p.get_subscription_count() for p in publishers), longest)
    time.sleep(SETTLE_TIME if longest else 0.0)


class _Answers:
    """What the nodes that listen to a topic say of it on /diagnostics."""

    def __init__(self, node: Node, topic: str) -> None:
        self._node, self._topic = node, topic
        self._refused_before = 0
        self.reports: list[dict[str, str]] = []
        node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, RELIABLE)

    @property
    def listeners(self) -> set[str]:
        """The names under which the nodes that listen report."""
        infos = self._node.get_subscriptions_info_by_topic(self._topic)
        return {f'{info.node_namespace.rstrip("/")}/{info.node_name}: state' for info in infos}

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name in self.listeners:
                self.reports.append({value.key: value.value for value in status.values})

    def begin(self) -> None:
        """Forget the reports so far; what they count as refused is an earlier message."""
        self._refused_before = self._refused
        self.reports.clear()

    @property
    def _refused(self) -> int:
        counted = f'rejected {TRAJECTORY}: '
        last = self.reports[-1] if self.reports else {}
        return sum(int(n) for key, n in last.items() if key.startswith(counted) and n.isdecimal())

    @property
    def is_taken(self) -> bool:
        """Whether a node reports that it has used a message since."""
        key = f'{TRAJECTORY} rate'
        return any(values.get(key, NO_RATE) != NO_RATE for values in self.reports)

    @property
    def refusal(self) -> str:
        """Why a node has refused a message since; '' if none reports that."""
        if not self.reports or self._refused <= self._refused_before:
            return ''
        last = self.reports[-1].get('last rejected', '')
        return last if last.startswith(TRAJECTORY) else 'see its /diagnostics for the reason'


def _send(node: Node, spinner: Spinner, message: JointTrajectory, topic: str, wait: float) -> None:
    """Publish a trajectory to nodes that have been matched, and wait until it has been used.

    Raises:
        MusculoskeletalError: If nobody listens, or the trajectory did not arrive or was refused.
    """
    publisher = node.create_publisher(JointTrajectory, topic, RELIABLE)
    answers = _Answers(node, publisher.topic_name)
    # The list of subscribers may come before the connection to them, or after it.
    spinner.spin_until(lambda: publisher.get_subscription_count() and answers.listeners, wait)
    if not publisher.get_subscription_count():
        found = ', '.join(sorted(answers.listeners))
        raise MusculoskeletalError(
            f'no connection to {found} within {wait:g} s: try again, or with a longer --wait'
            if found
            else f'nobody listens to {topic}: start the controller first'
        )
    spinner.spin_until(lambda: answers.reports, FIRST_REPORT_TIME)
    has_reported = bool(answers.reports)
    for _ in range(SENDINGS):
        answers.begin()
        publisher.publish(message)
        is_acknowledged = publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGE_TIME))
        # The first report may have been on its way when the trajectory arrived.
        spinner.spin_until(
            lambda: answers.is_taken or answers.refusal or len(answers.reports) > 1,
            REPORT_TIME if has_reported else 0.0,
        )
        if answers.refusal:
            raise MusculoskeletalError(f'the controller did not take it: {answers.refusal}')
        if answers.is_taken:
            return
        if is_acknowledged and not answers.reports:
            print(f'{topic}: received; whether it was taken has not been reported', file=sys.stderr)
            return
    raise MusculoskeletalError(
        f'{topic} was sent {SENDINGS} times and did not arrive; is this machine overloaded?'
    )


def _teach(bag: Bag, options: Namespace, arguments: list[str]) -> int:
    """Publish what a hand taught as one trajectory, and say whether the controller took it."""
    names = select(bag, [TAUGHT_TOPIC], options.from_namespace, options.keep_names)
    if len(names) > 1:  # all arms' names are kept
        problem = f'has the motion of several arms: {", ".join(names)}'
        raise BagError(bag.path, problem, 'choose one with --from-namespace')
    ((recorded, name),) = names.items()
    motion = taught_motion(bag, recorded, *window(bag, options.start, options.duration))
    message = JointTrajectory(joint_names=motion.joints)
    for seconds, theta, velocity in zip(*motion[1:]):
        point = JointTrajectoryPoint(positions=theta.tolist(), velocities=velocity.tolist())
        point.time_from_start = Duration(seconds=float(seconds)).to_msg()
        message.points.append(point)
    start_ros(arguments)
    node = Node('replay')
    topic, spinner = name.removesuffix(TAUGHT_TOPIC) + TRAJECTORY, Spinner(node)
    _send(node, spinner, message, topic, options.wait)
    length = f'{len(message.points)} points, {motion.time[-1]:.1f} s'
    print(f'{topic}: {length}, the first {LEAD_TIME:g} s of it to where it begins')
    return 0


def _replay(options: Namespace, arguments: list[str]) -> int:
    bag = Bag.open(options.bag)
    for reason in bag.unfinished:
        print(f'warning: {options.bag} is unfinished: {reason}', file=sys.stderr)
    if options.as_trajectory:
        return _teach(bag, options, arguments)
    names = select(bag, options.topics, options.from_namespace, options.keep_names)
    if options.loop and not options.clock:
        problem = 'without --clock and use_sim_time nodes do not notice that time jumps back'
        print(f'warning: --loop: {problem}', file=sys.stderr)
    with STOP.reacting(Reaction.REMEMBER):
        start_ros(arguments)
        node = Replay(bag, names, options)
        bar = '{percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s'
        with tqdm(total=node.length, bar_format=bar, disable=None, leave=False) as progress:
            node.get_ready(options.wait)
            node.play(progress, options.loop)
        node.acknowledge()
    return 0


def parse(arguments: list[str]) -> Namespace:
    """Return the options of `replay`."""
    parser = Parser(
        'replay',
        'Plays a recorded bag onto the topics, with the recorded spacing. ' + ROS_HELP,
        'While it plays, the services replay/pause, replay/resume and replay/step '
        '(std_srvs/Trigger) stop it, go on, and play the messages of the next recorded time. Its '
        'parameter `position` [s] goes there.',
    )
    add = parser.add_argument
    add('bag', type=Path, metavar='BAG', help='a bag directory, or one mcap or sqlite3 file')
    add('--check', action='store_true', help='play nothing; say what is in it (exit status 1: bad)')
    add('--robot', help='for --check: a shipped robot or a directory that the bag must fit')
    topics = (
        f'{DEFAULT}: what hardware, vision, user and controller sent; {ALL}: also what nodes '
        'compute; or names separated by commas'
    )
    add('--topics', type=names, default=[DEFAULT], metavar='LIST', help=topics)
    add('--keep-names', action='store_true', help='keep the recorded namespace')
    add('--from-namespace', metavar='NS', help='which arm, of a bag that has several')
    rate = 'multiple of the recorded speed; needs --clock'
    add('--rate', type=number(1e-3, 1e3), default=1.0, help=rate)
    add('--clock', action='store_true', help='publish the recorded time on /clock')
    add('--loop', action='store_true', help='start again at the end')
    start = 'start this far into the bag [s]'
    add('--start', type=not_negative, default=0.0, metavar='S', help=start)
    add('--duration', type=positive, metavar='S', help='play this much of the bag [s]')
    teach = f'send the motion of {TAUGHT_TOPIC} as one smooth joint_trajectory, and end'
    add('--as-trajectory', action='store_true', help=teach)
    add('--paused', action='store_true', help='wait for replay/resume or replay/step')
    wait = f'longest wait for subscribers [s] (default: {WAIT:g}, --as-trajectory: {SEND_WAIT:g})'
    add('--wait', type=not_negative, metavar='S', help=wait)
    options = parser.parse_args(arguments)
    if options.rate != 1 and not options.clock:
        parser.error(
            '--rate other than 1 needs --clock, and nodes with use_sim_time: '
            'by their own clocks they would take the arm to be faster or slower than it was'
        )
    if options.robot and not options.check:
        parser.error('--robot is for --check')
    if options.check:
        changed = {
            name for name, value in vars(options).items() if value != parser.get_default(name)
        }
        if ignored := sorted(changed - {'bag', 'check', 'robot', 'from_namespace'}):
            parser.error(f'--check plays nothing: without --{ignored[0].replace("_", "-")}')
    if options.wait is None:
        options.wait = SEND_WAIT if options.as_trajectory else WAIT
    if options.as_trajectory and (options.loop or options.clock or options.paused):
        parser.error('--as-trajectory sends one message: without --loop, --clock and --paused')
    if options.as_trajectory and options.topics != [DEFAULT]:
        listed = ','.join(options.topics)
        parser.error(
            f'--as-trajectory sends the motion of {TAUGHT_TOPIC}: without --topics {listed}'
        )
    return options


def _work(options: Namespace, arguments: list[str]) -> int:
    if options.check:
        # The robot's model takes a second to load, which playing does not need.
        from musculoskeletal_ae.bags.check import check_bag

        check = check_bag(options.bag, options.robot, options.from_namespace)
        print(check)
        return 1 if check.faults else 0
    try:
        return _replay(options, arguments)
    except KeyboardInterrupt:
        return 0  # as `ros2 bag play`


main = partial(run_tool, 'replay', parse, _work)
