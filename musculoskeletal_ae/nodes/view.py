# SPDX-License-Identifier: Apache-2.0
"""The node `view`: a page in the browser that shows a running arm, and moves it on request.

Nothing is subscribed to while nobody looks. While somebody does, only the newest message of a topic
is taken, at the rate of the picture: an executor would handle every one, at a tenth of a core.
"""

from __future__ import annotations

import math
import queue
import time
from argparse import Namespace
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64, Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError, printable
from musculoskeletal_ae.nodes.messages import joint_message
from musculoskeletal_ae.nodes.qos import LATCHED, RELIABLE
from musculoskeletal_ae.nodes.reception import Reception
from musculoskeletal_ae.nodes.running import ROS_HELP, run_tool, start_ros
from musculoskeletal_ae.nodes.situation import Situation
from musculoskeletal_ae.options import Parser, whole
from musculoskeletal_ae.robot.inverse_kinematics import POSITION_ONLY, inverse_kinematics
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.validity import QUANTITIES, read_array, read_posture

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
MANY = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
PERIOD, TELL_PERIOD, LOOK_PERIOD = 1.0 / 30.0, 0.25, 1.0  # [s] of picture, texts, and the graph
OLD = 1.0  # [s] after which something that moves is no longer shown
ARM_TOPICS = {
    'measured': 'joint_states',
    'estimated': 'estimated_joint_states',
    'simulated': 'sim/joint_states',
}
EMULATOR = 'hardware_emulator'


class View(Node):
    """What comes on topics onto the page; what is asked for there to topics and services."""

    def __init__(self, robot: Robot, options: Namespace) -> None:
        """Serve the page."""
        super().__init__('view', start_parameter_services=False)
        from musculoskeletal_ae.view.page import Page

        self.robot, self.options = robot, options
        self.asked: queue.SimpleQueue[tuple[Any, ...]] = queue.SimpleQueue()
        self.page = Page(
            robot, options.host, options.port, options.read_only, lambda *what: self.asked.put(what)
        )
        for note in self.page.notes:
            self.get_logger().warning(f'mesh left out: {printable(note)}')
        self.situation = Situation(self.get_namespace())
        self.reception = Reception(lambda text: self.get_logger().warning(text))
        self.came: dict[str, tuple[float, Any]] = {}  # when, and what, by topic or arm
        self.taken: list[Any] = []  # subscriptions
        self.ruptured: list[str] = []
        self.isolated: set[str] = set()
        self.payload = 0.0
        self.played: tuple[float, float] | None = None  # where in a bag, and how long it is [s]
        self.pending: list[tuple[Any, Callable[[Any], object]]] = []
        self.spinner = SingleThreadedExecutor()
        self.spinner.add_node(self)
        trigger = partial(self.create_client, Trigger)
        self.asks = {
            name: trigger(name)
            for name in ('controller/stop', 'controller/reset', 'estimator/reset')
        }
        self.asks |= {f'replay/{do}': trigger(f'replay/{do}') for do in ('pause', 'resume')}
        self.asks['controller/explore'] = self.create_client(SetBool, 'controller/explore')
        for node in (EMULATOR, 'replay'):
            name = f'{node}/set_parameters'
            self.asks[name] = self.create_client(SetParameters, name)
        self.told_by_emulator = self.create_client(GetParameters, f'{EMULATOR}/get_parameters')
        if not options.read_only:
            self.targets = self.create_publisher(JointState, 'target_joint_states', RELIABLE)
            self.pushes = [
                self.create_publisher(WrenchStamped, f'{arm}/external_wrench', RELIABLE)
                for arm in (EMULATOR, 'sim')
            ]

    # -- what comes -----------------------------------------------------------------------------

    def _subscribe(self) -> None:
        muscles = self.robot.muscle_count

        def take(kind: type, topic: str, qos: QoSProfile, callback: Callable[[Any], Any]) -> None:
            publishers = partial(self.count_publishers, self.resolve_topic_name(topic))
            receive = self.reception.of(topic, callback, publishers)
            self.taken.append(self.create_subscription(kind, topic, receive, qos))  # type: ignore[arg-type]

        for arm, topic in ARM_TOPICS.items():

            def posture(message: Any, arm: str = arm) -> None:
                self._note(arm, read_posture(message, self.robot.joints))

            take(JointState, topic, NEWEST, posture)
        take(
            Float64MultiArray,
            'muscle_states',
            NEWEST,
            lambda m: self._note('muscles', read_array(m, len(QUANTITIES), muscles)),
        )
        take(Float64, 'anomaly', NEWEST, lambda m: self._note('anomaly', float(m.data)))
        take(Float64MultiArray, 'replay/position', NEWEST, self._played)
        take(Bool, 'anomaly_detected', LATCHED, self._detected)
        take(String, 'isolated_muscles', LATCHED, self._isolated)
        take(DiagnosticArray, '/diagnostics', MANY, self.situation.diagnosed)

    def _played(self, message: Float64MultiArray) -> None:
        at, length = read_array(message, 1, 2).tolist()
        self.played = at, length

    def _detected(self, message: Bool) -> None:
        self.situation.detected = message.data

    def _isolated(self, message: String) -> None:
        self.isolated = {name.strip() for name in message.data.split(',')}

    def _note(self, what: str, value: Any) -> None:
        self.came[what] = time.monotonic(), value

    def _newest(self, what: str) -> Any:
        """Return what came last, None if that is too long ago."""
        when, value = self.came.get(what, (-math.inf, None))
        return value if time.monotonic() - when < OLD else None

    def _take(self) -> None:
        for subscription in self.taken:
            while True:
                with subscription.handle:
                    message = subscription.handle.take_message(
                        subscription.msg_type, subscription.raw
                    )
                if message is None:
                    break
                subscription.callback(*message)
        if self.pending:
            for _ in range(len(self.pending) + 1):
                self.spinner.spin_once(timeout_sec=0.0)
        waiting, self.pending = self.pending, []
        for future, answered in waiting:
            if future.done():
                answered(future.result())
            else:
                self.pending.append((future, answered))

    # -- the loop -------------------------------------------------------------------------------

    def run(self) -> None:
        """Show what comes until the process is asked to end."""
        tell = look = 0.0
        while rclpy.ok():
            if not self.page.looked_at.wait(timeout=1.0):
                for subscription in self.taken:
                    self.destroy_subscription(subscription)
                self.taken, self.came = [], {}
                continue
            if not self.taken:
                self._subscribe()
            begun = time.monotonic()
            self._take()
            while not self.asked.empty():
                self._do(*self.asked.get())
            self._draw()
            if begun >= tell:
                tell = begun + TELL_PERIOD
                self._tell()
            if begun >= look:
                look = begun + LOOK_PERIOD
                self._look()
            time.sleep(max(0.0, begun + PERIOD - time.monotonic()))

    def _draw(self) -> None:
        posture = {arm: theta for arm in ARM_TOPICS if (theta := self._newest(arm)) is not None}
        states, told = self._newest('muscles'), self.situation
        self.page.draw(posture, None if states is None else states[1], self._kinds())
        error = math.nan
        if {'measured', 'estimated'} <= posture.keys():
            error = float(np.linalg.norm(posture['measured'] - posture['estimated']))
        anomaly = self._newest('anomaly')
        self.error, self.anomaly = error, math.nan if anomaly is None else anomaly
        self.page.sample(time.monotonic(), error, self.anomaly, told.distance, told.limit)

    def _kinds(self) -> Any:
        from musculoskeletal_ae.view.body import Kind

        suspects = {self.situation.suspect} if self.situation.detected else set()
        kinds = np.zeros(self.robot.muscle_count, dtype=int)
        named = (Kind.SUSPECT, suspects), (Kind.ISOLATED, self.isolated), (Kind.CUT, self.ruptured)
        for kind, names in named:
            for name in names:
                if name in self.robot.muscles:
                    kinds[self.robot.muscles.index(name)] = kind
        return kinds

    def _tell(self) -> None:
        told = self.situation
        lines = [
            f'error {self.error:.3f} rad · A {self.anomaly:.3f} · d {told.distance:.0f}',
            f'samples {told.samples or 0} · networks {told.checkpoints or 0} · {told.doing or "–"}',
        ]
        if hint := told.hint():
            lines.append(hint)
        states = self._newest('muscles')
        blank = np.zeros(self.robot.muscle_count), np.full(self.robot.muscle_count, np.nan)
        tension, temperature = blank if states is None else states[1:]
        if states is None:
            lines = ['waiting for muscle_states', *lines[1:]]
        self.page.tell(lines, told.trouble(), tension, temperature)
        self.page.follow(self.payload, self.played)

    def _look(self) -> None:
        """Offer what the nodes that are there can do, and ask the emulator how it is."""
        ready = {'controller': 'controller/stop', 'replay': 'replay/pause'}
        there = {node for node, name in ready.items() if self.asks[name].service_is_ready()}
        if self.told_by_emulator.service_is_ready():
            there.add(EMULATOR)
            asked = GetParameters.Request(names=['ruptured_muscles', 'payload'])
            self._call(self.told_by_emulator, asked, self._emulated)
        if there & {EMULATOR} or self.count_subscribers(self._full('sim/external_wrench')):
            there.add('sim')
        self.page.offer(there)

    def _full(self, topic: str) -> str:
        return self.resolve_topic_name(topic)

    def _emulated(self, answer: Any) -> None:
        values = [parameter_value_to_python(value) for value in answer.values]
        if len(values) == 2:
            self.ruptured, self.payload = [name for name in values[0] or [] if name], values[1]

    # -- what is asked for ----------------------------------------------------------------------

    def _call(self, client: Any, request: Any, answered: Callable[[Any], object]) -> None:
        if client.service_is_ready():
            self.pending.append((client.call_async(request), answered))

    def _ask(self, name: str, request: Any = None, then: Callable[[], None] | None = None) -> None:
        """Call a service, tell the page what it said, and go on where it did."""

        def answered(answer: Any) -> None:
            results = getattr(answer, 'results', [answer])
            good = all(getattr(r, 'success', getattr(r, 'successful', False)) for r in results)
            said = ' '.join(getattr(r, 'message', '') or getattr(r, 'reason', '') for r in results)
            self.page.notify(printable(f'{name}: {said.strip() or "done"}'), good)
            if then is not None:
                then()

        self._call(self.asks[name], request or Trigger.Request(), answered)

    def _set(self, node: str, name: str, value: Any) -> None:
        message: ParameterMessage = Parameter(name, value=value).to_parameter_msg()
        self._ask(f'{node}/set_parameters', SetParameters.Request(parameters=[message]))

    def _do(self, what: str, *values: Any) -> None:
        """Do what a visitor asked for."""
        if what == 'explore':
            self._ask('controller/explore', SetBool.Request(data=True))
        elif what == 'stop':
            self._ask('controller/stop')
        elif what == 'reset':
            self._ask('estimator/reset', then=lambda: self._ask('controller/reset'))
        elif what == 'targets':
            self._publish_targets(list(values[0]), np.array(list(values[0].values())))
        elif what == 'hand':
            theta = self._newest('estimated')
            if theta is not None:
                pose = pin.SE3(np.eye(3), values[0])
                target = inverse_kinematics(self.robot, pose, theta, POSITION_ONLY).theta
                self._publish_targets(list(self.robot.joints), target)
        elif what in ('cut', 'mend'):
            names = [name for name in self.ruptured if name != values[0]]
            self.ruptured = [*names, values[0]] if what == 'cut' else names
            self._set(EMULATOR, 'ruptured_muscles', self.ruptured or [''])
        elif what == 'payload':
            self._set(EMULATOR, 'payload', float(values[0]))
        elif what == 'push':
            wrench = WrenchStamped()
            force = wrench.wrench.force
            force.x, force.y, force.z = values[0].tolist()
            for publisher in self.pushes:
                publisher.publish(wrench)
        elif what == 'seek':
            self._set('replay', 'position', float(values[0]))
        else:  # pause, resume
            self._ask(f'replay/{what}')

    def _publish_targets(self, joints: list[str], theta: Array) -> None:
        self.targets.publish(joint_message(joints, theta, self.get_clock().now().to_msg()))


def _parse(arguments: list[str]) -> Namespace:
    parser = Parser('view', 'Shows a running arm on a page in the browser.', ROS_HELP)
    parser.add_robot()
    port = 'port of the page'
    parser.add_argument('--port', type=whole(1, 65535), default=8080, metavar='N', help=port)
    host = 'address to listen on; 0.0.0.0 lets everybody on the network see and move the arm'
    parser.add_argument('--host', default='127.0.0.1', help=host)
    parser.add_argument('--read-only', action='store_true', help='no controls')
    return parser.parse_args(arguments)


def _view(options: Namespace, arguments: list[str]) -> int:
    robot = Robot.load(options.robot)
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise MusculoskeletalError(
            'the page needs viser: ./bringup.sh --view installs it, or '
            'pip install -r .ci/requirements-view.txt'
        ) from error
    start_ros(arguments)
    view = View(robot, options)
    name = 'localhost' if options.host == '127.0.0.1' else options.host
    print(f'http://{name}:{options.port}', flush=True)
    try:
        view.run()
    finally:
        view.page.close()
    return 0


def main(argv: list[str] | None = None) -> int:
    """Serve the page until Ctrl-C."""
    return run_tool('view', _parse, _view, argv)
