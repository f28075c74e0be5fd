# SPDX-License-Identifier: Apache-2.0
"""The tool `check_driver`: checks the driver of a real arm against its contract.

It reads muscle_states and joint_states, and with --move it publishes muscle_length_command. On a
ros2_control robot, it reads the JointState of the motors instead of muscle_states, and commands the
positions of the motors.
"""

from __future__ import annotations

import math
import time
from argparse import Namespace
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from musculoskeletal_ae.awake_clock import AwakeClock
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.messages.arrival import SILENCE, Arrival
from musculoskeletal_ae.options import Parser, names, number, numbers, positive
from musculoskeletal_ae.process_signals import import_heavy
from musculoskeletal_ae.ros.message_building import RELIABLE, SENSOR, array_message, motor_command
from musculoskeletal_ae.ros.second_publishers import LOOK_PERIOD, Authorship, publishers_of
from musculoskeletal_ae.ros_tools.ros_tool import (
    ROS_HELP,
    Spinner,
    message_class,
    run_tool,
    start_ros,
)

if TYPE_CHECKING:  # slow imports, which --help does not need
    from musculoskeletal_ae.driver.verdict import Verdict
    from musculoskeletal_ae.robot.robot import Robot
    from musculoskeletal_ae.signals.motor_interface import MotorInterface

JOINTS = 'joint_states'
DISCOVERY_TIME = 1.0  # wait this long for other nodes to be discovered [s]
COUNTDOWN = 10.0  # state the remaining time at this interval [s]
TICK = 0.02  # tick at this interval [s]; a late tick shows that this process was paused
#: treat a longer time between two ticks as a pause of this process [s]; the limit is lower than
#: that of the nodes, because check_driver judges gaps of 0.2 s between messages
LONGEST_TICK = 0.07


def _say(text: object) -> None:
    print(text, flush=True)


def _instruction(robot: Robot, options: Namespace, has_joint_sensors: bool) -> str:
    """Return what the user has to do with the arm while `check_driver` listens.

    An arm without joint sensors has to be held still.
    """
    if options.move:
        return 'do not touch the arm; if this check finds no fault, the arm then moves by itself'
    if options.posture:
        return 'hold the arm still in the posture that --posture states'
    by_hand = 'move the arm by hand through its whole range'
    if not has_joint_sensors:
        by_hand = 'hold the arm still, because joint_states has no publisher'
    return robot.actuation.choose(by_hand, 'the modules hold the arm, so do not touch it')


class CheckDriver:
    """Checks the messages of one driver, and how its muscles respond to commands."""

    def __init__(self, robot: Robot, options: Namespace) -> None:
        self.node = Node('check_driver')
        self.robot, self.options = robot, options
        self.has_listened = False
        kind: Any = import_heavy('musculoskeletal_ae.signals.motor_interface').MotorInterface
        self.motors: MotorInterface = kind(robot.description.motors, robot.tension_source)
        command = self.motors.command_topic or 'muscle_length_command'
        resolve = self.node.resolve_topic_name
        self.topic, self.command = resolve(self.motors.state_topic), resolve(command)
        self.joint_topic = resolve(JOINTS)
        #: order of the messages of each topic, and whether they come from a single node
        self.arrivals = {topic: Arrival() for topic in (self.topic, self.joint_topic)}
        self.authorships = {topic: Authorship() for topic in self.arrivals}
        self.muscles: Callable[[Any, dict[str, int]], object] = lambda *_: None
        self.joints: Callable[[JointState], object] = lambda _: None
        self.measured: Callable[[], Any] = lambda: None  # returns the newest θ of the joint sensors
        subscribe: Any = self.node.create_subscription
        kind = message_class(self.motors.state_type)

        def take_muscles(message: Any, info: dict[str, int]) -> None:
            self._note_order(self.topic, info)
            self.muscles(message, info)

        def take_joints(message: JointState, info: dict[str, int]) -> None:
            self._note_order(self.joint_topic, info)
            self.joints(message)

        subscribe(kind, self.topic, take_muscles, SENSOR)
        subscribe(JointState, JOINTS, take_joints, SENSOR)
        self.awake = AwakeClock(LONGEST_TICK)
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.node.create_timer(TICK, lambda: self.awake.tick(time.monotonic()), clock=clock)
        self.node.create_timer(LOOK_PERIOD, self._look, clock=clock)
        self.spin_until = Spinner(self.node).spin_until
        self.spin_until(lambda: False, DISCOVERY_TIME)

    def _note_order(self, topic: str, info: dict[str, int]) -> None:
        sent, number = info['source_timestamp'], info['publication_sequence_number']
        self.arrivals[topic].receive(time.monotonic(), sent, number)

    def _look(self) -> None:
        """Look for second publishers on the graph."""
        for topic, authorship in self.authorships.items():
            publishers = publishers_of(self.node, topic)
            authorship.look(publishers, self.arrivals[topic].turns, time.monotonic())

    def _mistyped(self) -> str:
        kinds = {info.topic_type for info in self.node.get_publishers_info_by_topic(self.topic)}
        return ', '.join(sorted(kinds - {self.motors.state_type}))

    def _listen_for(self, duration: float) -> None:
        """Receive messages for `duration` [s]; print the remaining time now and then."""
        left = duration
        while left > COUNTDOWN:
            self.spin_until(lambda: False, COUNTDOWN)
            left -= COUNTDOWN
            _say(f'{left:g} s left')
        self.spin_until(lambda: False, left)

    def listen(self) -> Verdict:
        """Wait for a driver, listen to its messages, and return the verdict on them."""
        chosen, node = self.options, self.node
        if is_first := not self.has_listened:
            self.has_listened = True
            _say(f'check_driver expects messages of {self.topic}')
        kind: Any = import_heavy('musculoskeletal_ae.driver.listening').Listening
        self.motors.reset()
        listening = kind(
            self.robot, chosen.rate, chosen.posture, not chosen.unzeroed, self.motors, self.awake
        )

        def take(message: Any, info: dict[str, int]) -> None:
            sent = 1e-9 * info['source_timestamp'] or math.nan
            number = info['publication_sequence_number']
            listening.muscles(message, time.monotonic(), sent, number)

        self.muscles, self.joints = take, listening.joints
        self.measured = lambda: listening.measured
        self.spin_until(lambda: listening.count, 2.0)
        if not listening.count:
            _say(f'waiting for {self.topic} (ROS_DOMAIN_ID {node.context.get_domain_id()})')
            wait = math.inf if chosen.wait else chosen.seconds
            self.spin_until(lambda: listening.count or self._mistyped(), wait)
        if listening.count:
            if is_first:
                text = f'listening for {chosen.seconds:g} s'
                # Give an instruction only if there is time to follow it.
                if chosen.move or chosen.seconds >= COUNTDOWN:
                    has_joint_sensors = node.count_publishers(self.joint_topic) > 0
                    text += f': {_instruction(self.robot, chosen, has_joint_sensors)}'
                _say(text)
            self._listen_for(chosen.seconds)
        verdict: Verdict = listening.verdict(time.monotonic())
        if wrong := self._mistyped():
            expected = self.motors.state_type
            verdict.failed('type', topic=self.topic, type=wrong, expected=expected)
        elif nodes := self.authorships[self.topic].intruders:
            verdict.failed('several', nodes=nodes, topic=self.topic)
        nodes = self.authorships[self.joint_topic].intruders
        if nodes and self.joint_topic != self.topic:
            verdict.failed('several of joints', nodes=nodes, topic=self.joint_topic)
        if not node.count_publishers(self.joint_topic):
            verdict.notes.append(
                'joint_states has no publisher; the learner needs it, unless its parameter '
                '`joint_source` is `marker` or `none`'
            )
        return verdict

    def alone(self, own: int = 0) -> bool:
        """Return True if no other node publishes commands to the arm.

        Args:
            own: Number of this tool's own publishers of commands.

        Raises:
            MusculoskeletalError: If another node publishes commands.
        """
        if self.node.count_publishers(self.command) > own:
            raise MusculoskeletalError(
                f'{self.command} is published by another node: stop the controller before the '
                'motion test'
            )
        return True

    def wind(self, verdict: Verdict) -> None:
        """Wind the tested muscles in slightly; add the faults of their responses to the verdict."""
        winding = _winding(self.robot, verdict, self.options)
        readings = import_heavy('musculoskeletal_ae.signals.muscle_states')
        publisher = self.node.create_publisher(Float64MultiArray, self.command, RELIABLE)
        self.spin_until(publisher.get_subscription_count, 3.0)
        if not publisher.get_subscription_count():
            verdict.failed('deaf', topic=self.command)
            return
        _say('the arm moves now: all muscles hold it, then each muscle is wound in slightly')
        arrival, trying = Arrival(self.awake, time.monotonic()), ''

        def follow(message: Any, _: dict[str, int]) -> None:
            nonlocal trying
            now = time.monotonic()
            try:
                states = readings.read_muscle_states(self.motors.reading(message), self.robot)
            except MusculoskeletalError:
                return
            arrival.use(now)
            target = winding.step(states, now, self.measured())
            if target is not None:
                if self.motors.command_topic:
                    publisher.publish(motor_command(self.motors, target))
                else:
                    publisher.publish(array_message(target, 'muscle'))
            if winding.trying != trying and not winding.done:
                trying = winding.trying
                _say(f'moving: {trying}')

        self.muscles = follow

        def ended() -> bool:
            # Check in every round that no other node commands the arm, because a node may be
            # discovered late.
            return self.alone(1) and (winding.done or arrival.age(time.monotonic()) > SILENCE)

        try:
            self.spin_until(ended, math.inf)
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(
                'no more commands are sent, and the driver must release the arm by itself'
            ) from stop
        if not winding.done:
            verdict.failed('silence', gap=SILENCE)


def _winding(robot: Robot, verdict: Verdict, options: Namespace) -> Any:
    """Return the motion test of the muscles that the options name, or of all muscles.

    The test is a `Winding`, or a `Positioning` for modules that follow positions.

    Raises:
        MusculoskeletalError: If the options name an unknown muscle, or a tension at which the
            muscles cannot be tested.
    """
    muscles = robot.muscle_indices(options.muscles or [])
    winding: Any = import_heavy('musculoskeletal_ae.driver.stiffness_motion_test').Winding
    positioning = import_heavy('musculoskeletal_ae.driver.position_motion_test').Positioning
    return robot.actuation.choose(winding, positioning)(verdict, muscles, options.tension)


def _check(options: Namespace, arguments: list[str]) -> int:
    robot = import_heavy('musculoskeletal_ae.robot.robot').Robot.load(options.robot)
    if options.posture and len(options.posture) != robot.joint_count:
        raise MusculoskeletalError(
            f'--posture: expected {robot.joint_count} values, one per joint, got '
            f'{len(options.posture)}'
        )
    if options.move:  # refuse wrong options before waiting for a driver
        kind = import_heavy('musculoskeletal_ae.driver.verdict').Verdict
        _winding(robot, kind(robot), options)
    start_ros(arguments)
    driver, reported, remarks = CheckDriver(robot, options), None, list[str]()
    while True:
        verdict = driver.listen()
        faults = {(fault.check, fault.subjects) for fault in verdict.faults}
        if faults != reported:
            _say(verdict)
            remarks = verdict.remarks
        reported = faults
        if verdict.allows_motion or not options.wait:
            break
        _say(
            'correct the faults of the driver before the arm moves; still listening'
            if faults
            else f'{verdict.obstacle}; still listening'
        )
    if options.move:
        driver.alone()
        if verdict.allows_motion:
            driver.wind(verdict)
            new = [remark for remark in verdict.remarks if remark not in remarks]
            _say('\n'.join(['after the motion test:', verdict.table, *new]))
        else:
            reason = (
                'the driver has the faults above; correct them first'
                if verdict.faults
                else verdict.obstacle
            )
            _say(f'motion test skipped: {reason}')
    _say(verdict.conclusion)
    was_skipped = options.move and bool(verdict.obstacle)
    return 1 if verdict.faults or was_skipped else 0


def _parse(arguments: list[str]) -> Namespace:
    parser = Parser(
        'check_driver',
        'Listens to the driver of a real arm and checks each muscle against the contract of '
        'doc/howto/your_driver.md. Reports what was measured and what to change. Meanwhile, move '
        'the arm gently by hand if you can. Exit status 0: check passed, 1: check failed.',
        ROS_HELP,
    )
    parser.add_robot()
    add = parser.add_argument
    add('--seconds', type=positive, default=30.0, metavar='S', help='how long to listen [s]')
    add(
        '--rate',
        type=number(1.0, 1000.0),
        default=100.0,
        metavar='HZ',
        help='lowest rate of muscle_states, or of the states of the motors, that the driver is '
        'expected to keep [Hz]; 20 %% less is tolerated',
    )
    text = 'posture [rad or m] in which the arm is held, if it has no joint sensors'
    add('--posture', type=numbers, metavar='θ,…', help=text)
    text = 'for winches without absolute encoders: do not check the length offsets'
    add('--unzeroed', action='store_true', help=text)
    add(
        '--move',
        action='store_true',
        help='after listening, if no fault was found: hold the arm where it is with all muscles, '
        'at no more than the test tension (--tension), then wind in each muscle slightly, one at '
        'a time. If a muscle pulls more than demanded, it is released, and the test ends',
    )
    text = 'with --move: wind in only these muscles; before that, all muscles hold the arm'
    add('--muscles', type=names, metavar='NAME,…', help=text)
    text = (
        'with --move: test tension, to which muscles are wound in [N] (default: T_bias + 40 N, or '
        'T_bias + 0.8 mm times K for modules with a stiffness K above 50 kN/m; at most '
        'tension.max, or tension.limit for actuation: position)'
    )
    add('--tension', type=positive, metavar='N', help=text)
    add('--wait', action='store_true', help='wait for a driver, and listen until it has no faults')
    options = parser.parse_args(arguments)
    if (options.muscles or options.tension) and not options.move:
        parser.error('--muscles and --tension need --move; add it, or remove them')
    return options


main = partial(run_tool, 'check_driver', _parse, _check)
