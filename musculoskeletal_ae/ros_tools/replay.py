# SPDX-License-Identifier: Apache-2.0
"""The node `replay`: plays a recorded bag onto its topics, or checks its contents."""

import math
import sys
import time
from argparse import Namespace
from collections.abc import Callable
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

from musculoskeletal_ae.bags.playback import TAUGHT_TOPIC, Timeline, lap, window
from musculoskeletal_ae.bags.reader import Bag
from musculoskeletal_ae.bags.storage import LONGEST_PAUSE
from musculoskeletal_ae.bags.timed_messages import TimedMessages
from musculoskeletal_ae.bags.topics import ALL, DEFAULT, DIAGNOSTICS, latched_topics, select
from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.exceptions import MusculoskeletalError, printable
from musculoskeletal_ae.messages.reception import Reception
from musculoskeletal_ae.options import Parser, names, not_negative, number, positive
from musculoskeletal_ae.process_signals import STOP, Reaction
from musculoskeletal_ae.progress_bar import is_bar_visible
from musculoskeletal_ae.report import (
    END_OF_RECORDING,
    NOT_WAITED_FOR,
    PAUSED,
    PLAYING,
    WAITING,
    Report,
    with_load,
)
from musculoskeletal_ae.robot.motors import NO_MOTORS, motor_topics
from musculoskeletal_ae.ros.diagnostics import MANY_REPORTS, PERIOD, Diagnostics
from musculoskeletal_ae.ros.latched_values import LatchedPublisher
from musculoskeletal_ae.ros.message_building import RELIABLE, array_message, serve
from musculoskeletal_ae.ros_tools.lockstep import Lockstep
from musculoskeletal_ae.ros_tools.rejecting_nodes import Rejections
from musculoskeletal_ae.ros_tools.ros_tool import (
    ROS_HELP,
    Spinner,
    message_class,
    run_tool,
    start_ros,
)
from musculoskeletal_ae.ros_tools.taught_motion import ACKNOWLEDGE_TIME, send_taught_motion
from musculoskeletal_ae.signals.motor_interface import STATES

#: depth of the publishers' queues; a subscriber that is one second late still gets every message
DEPTH = 1000
SERVICE_PERIOD = 0.02  # let a service request wait at most this long [s]
LONGEST_SLEEP = 0.002  # sleep at most this long [s]; run service callbacks during a longer wait
#: wait this long after the discovery of a subscriber, until it can receive messages [s]
SETTLE_TIME = 0.3
#: with --loop, let this recorded time pass between the last message and the first one [ns]
LAP_GAP = 10_000_000
WAIT = 2.0  # by default, wait at most this long for subscribers, and then play without them [s]
#: by default, wait at most this long for the subscriber that --as-trajectory needs [s]
SEND_WAIT = 10.0
CLOCK_PERIOD = 0.005  # publish /clock at this interval of recorded time [s]
SLOW = 0.5  # report playback as slow below this share of the wanted speed
LONGEST_LAG = 1.0  # after an interruption longer than this [s], do not catch up
LOCKSTEP_LAG = 0.005  # in lockstep, do not catch up after a longer delay than this [s]
#: publish /clock at intervals of at least this wall time [s]; nodes cannot use a faster clock
SHORTEST_CLOCK_PERIOD = 0.001


class Replay(Node):
    """Publishes recorded messages, as serialized bytes, at their recorded times."""

    def __init__(self, messages: TimedMessages, names: dict[str, str], options: Namespace) -> None:
        """Advertise the topics of the recorded messages, and prepare the services.

        Args:
            messages: The messages to play.
            names: The topic on which to publish, by recorded topic.
            options: Options of the command line.
        """
        super().__init__('replay')
        self._messages, bag = messages, messages.bag
        self._start, self._stop = window(bag, options.start, options.duration)
        self.length = (self._stop - self._start) / 1e9  # duration of the played part [s]
        self._before = (self._start - bag.start) / 1e9  # skipped time at the start of the bag [s]
        latched, reliable = latched_topics(bag), QoSProfile(depth=DEPTH)
        # Publishers, and the functions that publish a message with them, by recorded topic.
        self._publisher: dict[str, Publisher] = {}
        self._publish: dict[str, Callable[[bytes], None]] = {}
        for recorded, name in names.items():
            kind = message_class(bag.topics[recorded].type)
            if recorded in latched:
                values = LatchedPublisher(self, kind, name)
                self._publisher[recorded] = values.publisher
                self._publish[recorded] = values.publish
            else:
                publisher = self.create_publisher(kind, name, reliable)
                self._publisher[recorded] = publisher
                self._publish[recorded] = publisher.publish
        self._recorded_time = None
        if options.clock:
            self._recorded_time = self.create_publisher(Clock, '/clock', QoSProfile(depth=1))
        self._clock_period = max(CLOCK_PERIOD / max(options.rate, 1.0), SHORTEST_CLOCK_PERIOD)
        # Times of the next /clock message, service round and report on the steady clock [s].
        self._next_tick = self._next_service = self._next_report = 0.0
        #: recorded time at which playback shall continue after a seek [ns]; None without a seek
        self._sought: int | None = None
        self._rate, self._skips_pauses = options.rate, options.skip_pauses
        self._printed = ''  # names of the nodes for which the replay waits, as last printed
        # Steady time and recorded time of the last report, and steady time of the last seek [s].
        self._reported, self._seek_time = (math.inf, 0.0), math.inf
        description = 'position in the bag [s]; set this parameter to seek'
        descriptor = ParameterDescriptor(description=description)
        end = self._before + self.length
        legal = FloatingPointRange(from_value=self._before, to_value=end)
        descriptor.floating_point_range = [legal]
        self.declare_parameter('position', self._before, descriptor)
        self.add_post_set_parameters_callback(self._seek)
        self._position_publisher = self.create_publisher(
            Float64MultiArray, 'replay/position', RELIABLE
        )
        reception = Reception(self.get_logger().warning)  # stays empty: no topic is subscribed to
        self._diagnostics = Diagnostics(self, reception, bag.path.name)
        self._next_time = self._start
        self._timeline = Timeline(self._start - 1, options.rate, time.monotonic())
        self._lockstep: Lockstep | None = None
        if options.wait_for:
            self._lockstep = Lockstep(self, options.wait_for, _warn)
        topics = [publisher.topic_name for publisher in self._publisher.values()]
        if options.motors.states:  # nodes count messages of motors as muscle_states
            topics.append(self.resolve_topic_name(STATES))
        if DIAGNOSTICS not in topics:  # otherwise, a report may come from the recording
            rejections = Rejections(topics, str(options.bag), _warn)
            self.create_subscription(DiagnosticArray, DIAGNOSTICS, rejections.take, MANY_REPORTS)
        if options.paused:
            self._timeline.hold(True, time.monotonic())
        self._spinner = Spinner(self)

    def get_ready(self, longest: float) -> None:
        """Get ready to play: wait until messages can be received, then offer services.

        In lockstep, wait for the nodes. Otherwise wait at most `longest` [s] until every topic has
        a subscriber.

        Raises:
            MusculoskeletalError: If a node of the option --wait-for does not start.
        """
        if self._lockstep is not None:
            self._lockstep.start(self._spinner, self._report_waiting)
            time.sleep(SETTLE_TIME)
        else:
            topics = [*self._publisher.values(), *filter(None, [self._recorded_time])]
            _await_subscribers(self._spinner, topics, longest)
        for work in (self.pause, self.resume, self.step):
            serve(self, Trigger, f'replay/{work.__name__}', work)

    def play(self, progress: tqdm, again: bool) -> None:
        """Play all messages from start to stop; if `again`, repeat until the process ends."""
        self._lap(progress)
        while again:
            self._wait(self._stop + LAP_GAP, progress)
            self._lap(progress)

    def _lap(self, progress: tqdm) -> None:
        progress.reset()
        self._sought = self._start if self._sought is None else self._sought
        while self._sought is not None:
            start, self._sought = self._sought, None
            self._seek_time = time.monotonic()
            # Jump to just before the first message, so that it is not due while playback is paused.
            self._timeline.jump(start - 1, time.monotonic())
            before = start
            for message in lap(self._messages, start, self._stop):
                if self._skips_pauses:
                    self._timeline.skip_pause(before, message.log_time, time.monotonic())
                before = message.log_time
                if not self._wait(message.log_time, progress):
                    break
                self._wait_for_nodes(message.log_time)
                self._tick()
                STOP.raise_if_received()
                self._publish[message.topic](message.data)
                if self._lockstep is not None:
                    self._lockstep.count()

    def _wait_for_nodes(self, recorded: int) -> None:
        """Wait until nodes are ready for a message with the recorded time `recorded` [ns].

        If the message is late, recorded time goes on from `recorded`.
        """
        longest = LONGEST_LAG
        if self._lockstep is not None:
            longest = LOCKSTEP_LAG
            if self._lockstep.is_due(recorded):
                self._lockstep.step(recorded, self._spinner)
            # Publish /clock at once, so that the nodes know the time of this message.
            self._next_tick = 0.0
        self._timeline.catch_up(recorded, time.monotonic(), longest)

    def _report_waiting(self) -> None:
        """Report, once a second, which nodes the replay waits for."""
        STOP.raise_if_received()
        if self._lockstep is not None and time.monotonic() > self._next_report:
            self._next_report = time.monotonic() + PERIOD
            waiting = f'waiting until {" and ".join(self._lockstep.missing())} can receive'
            stands = (ConditionKind.REPLAY_STANDS.condition(waiting),)
            self._diagnostics.tell(Report('', {'state': WAITING}, stands))
            if waiting != self._printed:
                self._printed = waiting
                print(waiting, file=sys.stderr, flush=True)

    def acknowledge(self) -> None:
        """Report the end, and wait until reliable subscribers have received the last messages."""
        values = {'position': self._position(), 'state': END_OF_RECORDING}
        if self._lockstep is not None:
            self._lockstep.step(self._stop, self._spinner)
            values[NOT_WAITED_FOR] = ', '.join(self._lockstep.lost)
        stands = (ConditionKind.REPLAY_STANDS.condition('end of the recording'),)
        self._diagnostics.tell(Report('', values, stands))
        end = time.monotonic() + ACKNOWLEDGE_TIME
        for publisher in self._publisher.values():
            left = max(0.0, end - time.monotonic())
            publisher.wait_for_all_acked(Duration(nanoseconds=int(left * 1e9)))

    def _wait(self, recorded: int, progress: tqdm) -> bool:
        """Answer services and publish the clock until the time `recorded` [ns] is due.

        Returns:
            False if a seek was requested meanwhile.
        """
        self._next_time = recorded
        while (due := self._timeline.wait(recorded, now := time.monotonic())) > 0:
            if self._sought is not None:
                break
            if self._lockstep is not None and self._lockstep.is_due(recorded):
                self._lockstep.ask()  # early, so that answers arrive in time
            # A node that has not used the last messages yet must not receive a later time.
            is_asking = self._lockstep is not None and bool(self._lockstep.missing())
            wait = min(due, SERVICE_PERIOD)
            if self._recorded_time and not is_asking:
                self._tick()
                wait = min(wait, max(self._next_tick - now, 0.0))
            if is_asking or wait > LONGEST_SLEEP or now > self._next_service:
                self._next_service = now + SERVICE_PERIOD
                self._spinner.spin_once(wait)
                STOP.raise_if_received()
                if now > self._next_report:
                    self._next_report = now + PERIOD
                    self._diagnostics.tell(self._report(now))
                    seconds = self._before + np.array([self._done(), self.length])
                    self._position_publisher.publish(array_message(seconds, ''))
                progress.update(max(0.0, self._done() - progress.n))
            else:
                time.sleep(wait)
        return self._sought is None

    def _report(self, now: float) -> Report:
        """Return the status during playback; `now` is the time of the steady clock [s]."""
        state = PAUSED if self._timeline.paused else PLAYING
        conditions = list[Condition]()
        if state == PAUSED:
            conditions.append(ConditionKind.REPLAY_STANDS.condition(PAUSED))
        # Only lockstep delays playback for long, so report slow playback only in lockstep.
        before, self._reported = self._reported, (now, self._done())
        speed = (self._reported[1] - before[1]) / max(now - before[0], 1e-3)
        is_slow = 0.0 < speed < SLOW * self._rate and before[0] > self._seek_time
        if state == PLAYING and self._lockstep is not None and is_slow:
            detail = f'at {speed / self._rate:.0%} of the wanted speed, because it waits for nodes'
            conditions.append(ConditionKind.REPLAY_SLOW.condition(with_load(detail)))
        return Report(state, {'position': self._position(), 'state': state}, tuple(conditions))

    def _tick(self) -> None:
        """Publish the recorded time on /clock, if enabled and due.

        The clock does not run ahead of a message that is late, so it never goes back when recorded
        time goes on from that message.
        """
        if self._recorded_time and (now := time.monotonic()) >= self._next_tick:
            self._next_tick = now + self._clock_period
            recorded = min(self._timeline.recorded(now), self._next_time)
            seconds, nanoseconds = divmod(recorded, 1_000_000_000)
            self._recorded_time.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))

    def _seek(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == 'position':
                self._sought = self._messages.bag.start + int(1e9 * parameter.value)

    def pause(self, _: Trigger.Request) -> str:
        """Pause playback; return a message that states the present position."""
        self._timeline.hold(True, time.monotonic())
        return f'paused at {self._position()}'

    def resume(self, _: Trigger.Request) -> str:
        """Resume playback; return a message that states the present position."""
        self._timeline.hold(False, time.monotonic())
        return f'playing at {self._position()}'

    def step(self, _: Trigger.Request) -> str:
        """Publish the messages of the next recorded time, and remain paused.

        Returns:
            A message that states the new position.

        Raises:
            MusculoskeletalError: If playback is not paused.
        """
        if not self._timeline.paused:
            raise MusculoskeletalError('not paused: call replay/pause first')
        self._timeline.jump(self._next_time, time.monotonic())
        return f'stepped at {self._position()}'

    def _done(self) -> float:
        """Return the recorded time since the start of the played part [s]."""
        return max(0.0, (self._timeline.recorded(time.monotonic()) - self._start) / 1e9)

    def _position(self) -> str:
        return f'{self._before + self._done():.6f} s'


def _warn(text: str) -> None:
    """Print a warning, above the progress bar if there is one."""
    tqdm.write(printable(f'warning: {text}'), file=sys.stderr)


def _await_subscribers(spinner: Spinner, publishers: list[Publisher], longest: float) -> None:
    """Wait at most `longest` [s] until every topic has a subscriber that can receive messages."""
    spinner.spin_until(lambda: all(p.get_subscription_count() for p in publishers), longest)
    time.sleep(SETTLE_TIME if longest else 0.0)


def _warn_of_pauses(messages: TimedMessages, played: tuple[int, int]) -> None:
    """Warn of pauses between the recorded times `played` [ns], in which playback will wait."""
    pauses = [each for each in messages.pauses if each.end > played[0] and each.begin < played[1]]
    if not pauses:
        return
    longest = max(pauses, key=lambda pause: pause.end - pause.begin)
    others = f' ({len(pauses) - 1} more such jumps)' if len(pauses) > 1 else ''
    problem = f'{longest.text(messages.bag.start)}{others}, and playback waits as long'
    print(f'warning: {problem}; --skip-pauses goes on at once', file=sys.stderr, flush=True)


def _replay(options: Namespace, arguments: list[str]) -> int:
    bag = Bag.open(options.bag)
    for reason in bag.unfinished:
        print(f'warning: {options.bag} is unfinished: {reason}', file=sys.stderr)
    if options.as_trajectory:
        return send_taught_motion(bag, options, arguments)
    options.motors = motor_topics(options.robot) if options.robot else NO_MOTORS
    names = select(bag, options.topics, options.from_namespace, options.keep_names, options.motors)
    if options.loop and not options.clock:
        problem = (
            'nodes do not notice that time jumps back; add --clock, and set use_sim_time in '
            'the nodes'
        )
        print(f'warning: --loop: {problem}', file=sys.stderr)
    messages = TimedMessages(bag, names)
    if messages.note:
        print(f'note: {messages.note}', file=sys.stderr)
    if not options.skip_pauses:
        _warn_of_pauses(messages, window(bag, options.start, options.duration))
    with STOP.reacting(Reaction.REMEMBER):
        start_ros(arguments)
        node = Replay(messages, names, options)
        bar = '{percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s'
        with tqdm(
            total=node.length, bar_format=bar, disable=not is_bar_visible(), leave=False
        ) as progress:
            node.get_ready(options.wait)
            node.play(progress, options.loop)
        node.acknowledge()
    return 0


def parse(arguments: list[str]) -> Namespace:
    """Parse the command line of `replay`, and return its options."""
    parser = Parser(
        'replay',
        'Publishes the messages of a recorded bag on their topics, at the recorded intervals. '
        + ROS_HELP,
        'During playback, the services replay/pause, replay/resume and replay/step '
        '(std_srvs/Trigger) pause it, resume it, and play the messages of the next recorded time. '
        'Set the parameter `position` [s] of the node to seek.',
    )
    add = parser.add_argument
    add('bag', type=Path, metavar='BAG', help='a bag directory, or one mcap or sqlite3 file')
    check = 'check the contents without playing them (exit status 1: faults)'
    add('--check', action='store_true', help=check)
    robot = (
        'a shipped robot or a directory: with --check, the robot that the bag must fit; otherwise, '
        'a robot whose motors.yaml names further topics to play (doc/howto/ros2_control.md)'
    )
    add('--robot', metavar='NAME|DIR', help=robot)
    topics = (
        f'{DEFAULT}: topics of hardware, vision, user and controller; {ALL}: also the topics that '
        'nodes compute; or names of topics, separated by commas'
    )
    add('--topics', type=names, default=[DEFAULT], metavar='LIST', help=topics)
    keep = 'publish on the recorded names, of all arms of the bag unless --from-namespace is given'
    add('--keep-names', action='store_true', help=keep)
    arm = 'namespace of the arm to play, if the bag has several arms'
    add('--from-namespace', metavar='NS', help=arm)
    rate = 'playback speed as a multiple of the recorded speed; needs --clock'
    add('--rate', type=number(1e-3, 1e3), default=1.0, help=rate)
    add('--clock', action='store_true', help='publish the recorded time on /clock')
    add('--loop', action='store_true', help='start again after the end of the recording')
    text = (
        f'skip gaps of more than {LONGEST_PAUSE / 1e9:g} s in the recording; the recorded time on '
        '/clock then jumps'
    )
    add('--skip-pauses', action='store_true', help=text)
    start = 'start this far into the bag [s]'
    add('--start', type=not_negative, default=0.0, metavar='S', help=start)
    add('--duration', type=positive, metavar='S', help='duration of the part to play [s]')
    teach = f'send the motion of {TAUGHT_TOPIC} as one smooth joint_trajectory, then exit'
    add('--as-trajectory', action='store_true', help=teach)
    paused = 'start paused: wait for replay/resume or replay/step'
    add('--paused', action='store_true', help=paused)
    wait = f'longest wait for subscribers [s] (default: {WAIT:g}, --as-trajectory: {SEND_WAIT:g})'
    nodes = (
        'nodes that have to receive every message, separated by commas: playback begins when they '
        'run, and waits for them when they are slow; needs --clock'
    )
    add('--wait-for', type=names, default=[], metavar='NODES', help=nodes)
    add('--wait', type=not_negative, metavar='S', help=wait)
    options = parser.parse_args(arguments)
    _check_combination(parser, options)
    if options.wait is None:
        options.wait = SEND_WAIT if options.as_trajectory else WAIT
    return options


def _check_combination(parser: Parser, options: Namespace) -> None:
    """Check that options fit together and have an effect; otherwise, exit with an error."""
    if options.rate != 1 and not options.clock:
        parser.error(
            '--rate other than 1 needs --clock, because nodes with clocks of their own would '
            'compute wrong speeds; add --clock, and start the nodes with use_sim_time'
        )
    if options.wait_for and not options.clock:
        parser.error(
            '--wait-for needs --clock, and nodes with use_sim_time, because recorded time stands '
            'still while the replay waits; add --clock'
        )
    if options.check:
        changed = {
            name for name, value in vars(options).items() if value != parser.get_default(name)
        }
        if ignored := sorted(changed - {'bag', 'check', 'robot', 'from_namespace'}):
            parser.error(f'--check plays nothing: remove --{ignored[0].replace("_", "-")}')
    plays = options.loop, options.clock, options.paused, options.skip_pauses
    if options.as_trajectory and any(plays):
        parser.error(
            '--as-trajectory sends one message: remove --loop, --clock, --paused and --skip-pauses'
        )
    if options.as_trajectory and options.topics != [DEFAULT]:
        listed = ','.join(options.topics)
        parser.error(
            f'--as-trajectory sends the motion of {TAUGHT_TOPIC}: remove --topics {listed}'
        )


def _work(options: Namespace, arguments: list[str]) -> int:
    if options.check:
        # Imported here, because loading the robot model takes a second that playback does not need.
        from musculoskeletal_ae.bags.check import check_bag

        check = check_bag(options.bag, options.robot, options.from_namespace)
        print(check)
        return 1 if check.faults else 0
    try:
        return _replay(options, arguments)
    except KeyboardInterrupt:
        return 0  # `ros2 bag play` also returns 0 after Ctrl-C


main = partial(run_tool, 'replay', parse, _work)
