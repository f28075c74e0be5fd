# SPDX-License-Identifier: Apache-2.0
"""The node `view`: shows a running arm on a web page, and moves it on request.

The node subscribes when the first visitor opens the page. Once for each picture, it then takes the
newest message of each topic, and all messages of /diagnostics. An executor would instead handle
every message of every topic, which would take a tenth of a core. The subscriptions remain after the
last visitor has left, because Fast DDS may crash if a subscription is destroyed while publishers of
its topic come and go (`ros/latched_values.py`).

The page shows the arm of the node's namespace. If the ROS graph has other arms, it lists them all,
with links to their pages.
"""

import math
import platform
import queue
import time
import traceback
from argparse import Namespace
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3, WrenchStamped
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.awake_clock import AwakeClock
from musculoskeletal_ae.control.supervisor import Activity
from musculoskeletal_ae.exceptions import MusculoskeletalError, printable
from musculoskeletal_ae.messages.arrival import SILENCE, Arrival
from musculoskeletal_ae.messages.message_reading import (
    read_array,
    read_posture,
)
from musculoskeletal_ae.messages.reception import Reception
from musculoskeletal_ae.nodes.reported_conditions import PAGE, Arms, figures, nodes_in_graph
from musculoskeletal_ae.options import Parser, whole
from musculoskeletal_ae.process_signals import STOP, Reaction, import_heavy
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.inverse_kinematics import POSITION_ONLY, inverse_kinematics
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.ros import diagnostics
from musculoskeletal_ae.ros.message_building import LATCHED, RELIABLE, joint_message
from musculoskeletal_ae.ros_tools.ros_tool import ROS_HELP, message_class, run_tool, start_ros
from musculoskeletal_ae.signals.body_state import ROWS, BodyState
from musculoskeletal_ae.signals.motor_interface import STATES, MotorInterface
from musculoskeletal_ae.signals.muscle_states import MuscleReadings, read_muscle_states

#: QoS of topics of which only the newest message counts
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
PERIOD = 1.0 / 30.0  # draw a picture at this interval [s]
TEXT_PERIOD = 0.25  # update texts and curves at this interval [s]
GRAPH_PERIOD = 1.0  # look for running nodes and other arms at this interval [s]
PATIENCE = 10.0  # wait at most this long for the response of a service [s]
STOP_CHECK_PERIOD = 0.1  # check for a stop signal after at most this time [s]
#: topics from which the arms on the page are drawn
ARM_TOPICS = {
    'measured': 'joint_states',
    'estimated': 'estimated_joint_states',
    'simulated': 'sim/joint_states',
}
RUPTURE = 'rupture'  # kind of the emulated fault with which visitors rupture tendons
#: service that sets a parameter of the emulator, such as `faults`
SET = 'hardware_emulator/set_parameters'
GET = 'hardware_emulator/get_parameters'
#: Trigger services that visitors may call
TRIGGERS = (
    'controller/stop', 'controller/reset', 'estimator/reset', 'estimator/restore',
    'estimator/zero', 'replay/pause', 'replay/resume',
)  # fmt: skip
SERVICES = {'controller/explore': SetBool, **dict.fromkeys(TRIGGERS, Trigger), GET: GetParameters}
SERVICES |= {SET: SetParameters, 'replay/set_parameters': SetParameters}
EXPLORING = Activity.EXPLORING.value, Activity.CALIBRATING.value  # modes in which the arm explores
#: for each node, a service that is available only while the node is running
SIGNS = {'controller': 'controller/stop', 'replay': 'replay/pause', 'hardware_emulator': GET}


class Pending(NamedTuple):
    """A service request without a response."""

    since: float  # monotonic time at which it was sent [s]
    future: Any
    answered: Callable[[Any], None]  # called with the response
    failed: Callable[[str], None]  # called with the reason if no response comes


class View(Node):
    """Shows messages on the page, and passes requests of visitors to topics and services."""

    def __init__(self, robot: Robot, options: Namespace) -> None:
        super().__init__('view', start_parameter_services=False)
        try:
            # Use `import_heavy`, because importing trimesh may swallow Ctrl-C.
            page = import_heavy('musculoskeletal_ae.view.page')
        except ImportError as error:
            raise MusculoskeletalError(
                'the page needs viser; install it with: pip install -r requirements.txt'
            ) from error
        self.robot = robot
        self.motors = MotorInterface(robot.description.motors, robot.tension_source)
        self.requests: queue.SimpleQueue[tuple[Any, ...]] = queue.SimpleQueue()
        address, request = (options.host, options.port), lambda *what: self.requests.put(what)
        title = f'{self.get_namespace().strip("/")} {robot.description.directory.name}'.strip()
        self.page = page.Page(robot, *address, options.read_only, request, title)
        self.address = _address(options)
        for note in self.page.scene.notes:
            self.get_logger().warning(f'mesh omitted: {printable(note)}')
        self.awake = AwakeClock()
        self.arms = Arms(
            lambda: nodes_in_graph(self),
            lambda: self.awake.at(time.monotonic()),
        )
        self.situation = self.arms.situation(self.get_namespace())
        self.reception = Reception(lambda text: self.get_logger().warning(text), self.awake)
        hardware = robot.description.directory.name
        self.diagnostics = diagnostics.Diagnostics(self, self.reception, hardware)
        #: the newest value, and the arrival of its topic, by name
        self.newest: dict[str, tuple[Any, Arrival]] = {}
        self.subscribed: list[Any] = []  # subscriptions, from the first visitor on
        #: monotonic time [s] of the last update of texts, check of the graph, and report
        self.texts_at = self.graph_at = self.reported_at = -math.inf
        self.faults: list[str] = []  # faults that the hardware emulator imitates
        self.payload = 0.0
        self.pending: list[Pending] = []
        self.answers = SingleThreadedExecutor()
        self.answers.add_node(self)
        self.clients_of = {name: self.create_client(kind, name) for name, kind in SERVICES.items()}
        self.pushes: list[Any] = []
        if not options.read_only:
            self.targets = self.create_publisher(JointState, 'target_joint_states', RELIABLE)
            self.pushes = [
                self.create_publisher(WrenchStamped, f'{arm}/external_wrench', RELIABLE)
                for arm in ('hardware_emulator', 'sim')
            ]

    # -- messages -------------------------------------------------------------------------------

    def _subscribe(self) -> None:
        robot, units = self.robot, self.robot.units

        def muscles(message: Any) -> MuscleReadings:
            reading = self.motors.reading(message)
            return read_muscle_states(reading, robot, self._isolated())

        def body(message: Any) -> BodyState:
            return BodyState.of_rows(read_array(message, ROWS, robot.muscle_count))

        table: list[tuple[str, type, str, QoSProfile, Callable[[Any], Any]]] = [
            (arm, JointState, topic, NEWEST, partial(read_posture, units=units, some=is_measured))
            for arm, topic in ARM_TOPICS.items()
            for is_measured in [arm == 'measured']
        ]
        table += [
            ('muscles', message_class(self.motors.state_type), STATES, NEWEST, muscles),
            ('played', Float64MultiArray, 'replay/position', NEWEST,
             lambda m: read_array(m, 1, 2).tolist()),
            ('anomaly', Float64, 'anomaly', NEWEST, lambda m: m.data),
            ('body', Float64MultiArray, 'body_state', LATCHED, body),
            ('mode', String, 'controller_mode', LATCHED, lambda m: m.data),
            ('', DiagnosticArray, '/diagnostics', diagnostics.MANY_REPORTS, self.arms.diagnosed),
        ]  # fmt: skip

        def note(what: str, topic: str, read: Callable[[Any], Any], message: Any) -> None:
            self.newest[what] = read(message), self.reception.arrivals[topic]

        for what, kind, topic, qos, read in table:
            wire = self.motors.state_topic if topic == STATES else topic
            publishers = partial(self.count_publishers, self.resolve_topic_name(wire))
            receive: Any = self.reception.of(topic, partial(note, what, topic, read), publishers)
            self.subscribed.append(self.create_subscription(kind, wire, receive, qos))

    def _newest(self, what: str, largest_age: float = SILENCE) -> Any:
        """Return the newest value named `what`; None if it is older than `largest_age` [s]."""
        value, arrival = self.newest.get(what, (None, None))
        is_recent = arrival is not None and arrival.age(time.monotonic()) < largest_age
        return value if is_recent else None

    def _take(self) -> None:
        for each in self.subscribed:
            with each.handle:
                while message := each.handle.take_message(each.msg_type, each.raw):
                    each.callback(*message)
        for _ in range(len(self.pending) + 1 if self.pending else 0):
            self.answers.spin_once(timeout_sec=0.0)
        waiting, self.pending = self.pending, []
        # Call the callbacks here, because an executor would call them one request late.
        for each in waiting:
            if each.future.done():
                each.answered(each.future.result())
            elif time.monotonic() - each.since < PATIENCE:
                self.pending.append(each)
            else:
                each.failed(f'no answer for {PATIENCE:g} s; the node may hang or have ended')

    # -- the loop -------------------------------------------------------------------------------

    def run(self) -> None:
        """Show messages until the process receives a stop signal."""
        while rclpy.ok() and not STOP.received:
            is_viewed = self.page.looked_at.wait(timeout=STOP_CHECK_PERIOD)
            now = time.monotonic()
            self.awake.tick(now)
            if now >= self.reported_at + diagnostics.PERIOD:
                self.reported_at = now
                state = 'viewed' if is_viewed else 'the page has no visitors'
                self.reception.measure_rates()
                self.diagnostics.tell(Report(state, {PAGE: self.address}))
            self.page.send_entries()
            while not self.requests.empty():  # also after the last visitor has left
                what, *value = self.requests.get()
                try:
                    self._do(what, *value)
                except Exception as error:  # noqa: BLE001 - a page may send anything
                    self.page.notify(printable(f'{what}: {error}'), False)
            if is_viewed and not self.subscribed:
                self._subscribe()
            begun = time.monotonic()
            try:
                self._take()
                if not is_viewed:
                    continue
                self._show(begun)
            except Exception as error:  # noqa: BLE001 - topics and services may bring anything
                if self.reception.reject_error('page', error):
                    self.get_logger().error(printable(traceback.format_exc()))
            time.sleep(max(0.0, begun + PERIOD - time.monotonic()))

    def _show(self, now: float) -> None:
        """Show the newest messages; `now` is monotonic time [s]."""
        self.arms.forget_ended()
        posture = {arm: at for arm in ARM_TOPICS if (at := self._newest(arm)) is not None}
        if (measured := posture.get('measured')) is not None and np.isnan(measured).any():
            # Draw joints without a working sensor at the estimated angle.
            filled = np.where(np.isnan(measured), posture.get('estimated', measured), measured)
            posture['measured'] = filled
            if np.isnan(filled).any():
                del posture['measured']
        muscles = self._newest('muscles')
        self.page.draw(posture, None if muscles is None else muscles.tension, self._kinds())
        if now >= self.texts_at + TEXT_PERIOD:
            self.texts_at = now
            self._tell(posture, muscles)
        if now >= self.graph_at + GRAPH_PERIOD:
            self.graph_at = now
            self._look()

    def _kinds(self) -> Ints:
        suspects = list(self.situation.suspects)
        groups = self._places(suspects), self._isolated(), self._places(self._ruptured())
        kinds = np.zeros(self.robot.muscle_count, dtype=int)
        for kind, muscles in enumerate(groups, 1):  # the numbers are values of `body.DrawnState`
            kinds[muscles] = kind
        return kinds

    def _places(self, names: list[str]) -> Ints:
        return np.flatnonzero(np.isin(self.robot.muscles, names))

    def _isolated(self) -> Ints:
        body = self._newest('body', math.inf)
        return np.array([] if body is None else body.isolated, dtype=int)

    def _tell(self, posture: dict[str, Array], muscles: MuscleReadings | None) -> None:
        situation, anomaly = self.situation, self._newest('anomaly')
        error, error_text = math.nan, ''
        if {'measured', 'estimated'} <= posture.keys():
            off = posture['estimated'] - posture['measured']
            error, error_text = float(np.linalg.norm(off)), self.robot.units.error_text(off, '.3f')
        anomaly = math.nan if anomaly is None else anomaly
        distance = situation.number('estimator', 'd')
        shown_distance = '' if math.isnan(distance) else f'  d {distance:.0f}'
        counts = situation.count('samples'), situation.count('checkpoints')
        learned = f'samples {counts[0]} · networks {counts[1]}'
        lines = [
            figures('measured' in posture, error_text, anomaly) + shown_distance,
            f'{learned} · {situation.doing or "–"}',
            f'waiting for {self.motors.state_topic}' if muscles is None else situation.hint(),
        ]
        trouble = self.page.with_buttons(situation.trouble())
        if len(isolated := self._isolated()):
            lines.append(f'isolated: {self.robot.names(isolated)}')
        if muscles is None:
            muscles = MuscleReadings(length=np.full(self.robot.muscle_count, np.nan))
        values = error, anomaly, distance, situation.number('estimator', 'd limit')
        now, is_urgent = time.monotonic(), situation.level() == 'error'
        self.page.tell([*filter(None, lines)], trouble, muscles, now, values, is_urgent)
        self.page.follow(self.payload, self._newest('played', math.inf))

    def _reset(self) -> None:
        """Reset anomaly and stop, unless a ruptured muscle of the emulated arm is not isolated."""
        isolated = set(self.robot.names(self._isolated()).split(', '))
        if remaining := [name for name in self._ruptured() if name not in isolated]:
            problem = f'ruptured muscles ({", ".join(remaining)}) would stop the arm again'
            self.page.notify(f'{problem}; press "Repair" first', False)
            return

        def go_on(answer: Any) -> None:
            if answer.success:
                self._ask('controller/reset')
            else:
                self.page.notify(printable(f'estimator/reset: {answer.message}'), False)

        if self.clients_of['estimator/reset'].service_is_ready():
            self._ask('estimator/reset', then=go_on, quiet=True)
        else:
            self._ask('controller/reset')

    def _look(self) -> None:
        """Show all arms and the controls for running nodes, and request the emulator's state."""
        running = {node for node, name in SIGNS.items() if self.clients_of[name].service_is_ready()}
        if any(push.get_subscription_count() for push in self.pushes):
            running.add('pushed')
        self.page.offer(running, self._newest('mode', math.inf) in EXPLORING)
        self.page.list_arms(self.arms.summaries(), self.get_namespace())
        # No visitor has asked for this, so that it fails is not shown.
        names, no_note = ['faults', 'payload'], lambda _: None
        self._ask(GET, self._on_emulator_state, quiet=True, failed=no_note, names=names)

    def _on_emulator_state(self, answer: Any) -> None:
        match [parameter_value_to_python(value) for value in answer.values]:
            case [[*faults], float(payload)]:
                self.faults, self.payload = [str(line) for line in faults if line], payload

    def _ruptured(self) -> list[str]:
        """Return the names of the muscles that the emulator ruptures."""
        lines = [line.partition(':') for line in self.faults]
        names = [name for kind, _, name in lines if kind == RUPTURE]
        return names if all(names) else [*self.robot.muscles]  # '' stands for all muscles

    def _ask(
        self,
        name: str,
        then: Callable[[Any], object] | None = None,
        quiet: bool = False,
        failed: Callable[[str], None] | None = None,
        **fields: Any,
    ) -> None:
        """Call a service, and tell the visitors if it is not available or does not answer.

        Args:
            name: Name of the service.
            then: Called with the response.
            quiet: Whether to hide the response from the visitors.
            failed: Called with the reason if there is no response, instead of telling the visitors.
            fields: Fields of the request.
        """

        def tell_failure(reason: str) -> None:
            self.page.notify(f'{name}: {reason}', False)

        def answered(answer: Any) -> None:
            if not quiet:
                # The response of SetParameters has a list with one result; the response of every
                # other service is itself the result.
                result = [*getattr(answer, 'results', ()), answer][0]
                good = getattr(result, 'success', getattr(result, 'successful', False))
                why = getattr(result, 'message', getattr(result, 'reason', '')) or 'done'
                self.page.notify(printable(f'{name}: {why}'), good)
            if then is not None:
                then(answer)

        if self.clients_of[name].service_is_ready():
            future = self.clients_of[name].call_async(SERVICES[name].Request(**fields))
            now = time.monotonic()
            self.pending.append(Pending(now, future, answered, failed or tell_failure))
        else:
            (failed or tell_failure)(
                f'no running node has this service; start {name.split("/")[0]}'
            )

    def _do(self, what: str, value: Any = None) -> None:
        """Carry out a request of a visitor.

        Args:
            what: Name of the request, such as 'targets', 'push' or 'reset'.
            value: What the visitor has entered, depending on the request.
        """
        match what:
            case 'targets':
                stamp, position = self.get_clock().now().to_msg(), np.array([*value.values()])
                self.targets.publish(joint_message([*value], position, stamp))
            case 'hand':
                if value.shape != (3,) or not np.isfinite(value).all():
                    raise ValueError(f'expected a position of three numbers [m], got {value}')
                if (theta := self._newest('estimated')) is not None:
                    pose = pin.SE3(np.eye(3), value)
                    target = inverse_kinematics(self.robot, pose, theta, POSITION_ONLY).theta
                    position = self.robot.units.to_position(target)
                    self._do('targets', dict(zip(self.robot.joints, position)))
            case 'push':
                wrench = WrenchStamped()
                wrench.wrench.force = Vector3(**dict(zip('xyz', value.tolist())))
                for publisher in self.pushes:
                    publisher.publish(wrench)
            case 'rupture' | 'repair':
                names = [name for name in self._ruptured() if name != value]
                names += [value] if what == 'rupture' else []
                others = [line for line in self.faults if line.partition(':')[0] != RUPTURE]
                self.faults = [*others, *(f'{RUPTURE}:{name}' for name in names)]
                self._do('faults', self.faults or [''])
            case 'faults' | 'payload' | 'position':
                parameter = Parameter(what, value=value).to_parameter_msg()
                service = 'replay/set_parameters' if what == 'position' else SET
                self._ask(service, parameters=[parameter])
            case 'reset':
                self._reset()
            case 'refused':
                self.page.notify(value, False)
            case 'controller/explore':
                self._ask(what, data=True)
            case 'end exploring':
                self._ask('controller/explore', data=False)
            case _:
                self._ask(what)


def _parse(arguments: list[str]) -> Namespace:
    what = 'Shows a running arm on a web page, and lets visitors move it.'
    parser = Parser('view', what, ROS_HELP)
    parser.add_robot()
    add = parser.add_argument
    host = 'address to listen on; with 0.0.0.0 the whole network can move the arm'
    add('--port', type=whole(1, 65535), default=8080, metavar='N', help='port of the page')
    add('--host', default='127.0.0.1', help=host)
    add('--read-only', action='store_true', help='show no controls: visitors cannot move the arm')
    return parser.parse_args(arguments)


def _address(options: Namespace) -> str:
    """Return the address of the page, as a browser needs it."""
    host = f'[{options.host}]' if ':' in options.host else options.host
    names = {'127.0.0.1': 'localhost', '0.0.0.0': platform.node()}  # noqa: S104 - only read
    return f'http://{names.get(host, host)}:{options.port}'


def _view(options: Namespace, arguments: list[str]) -> int:
    robot = Robot.load(options.robot)
    start_ros(arguments)
    view = View(robot, options)
    print(view.address, flush=True)
    try:
        with STOP.reacting(Reaction.REMEMBER):
            view.run()
    finally:
        view.page.close()
    STOP.raise_if_received()
    return 0


main = partial(run_tool, 'view', _parse, _view)
