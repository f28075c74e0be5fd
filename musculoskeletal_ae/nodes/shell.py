# SPDX-License-Identifier: Apache-2.0
"""Base class of the nodes of an arm: parameters, checkpoints, subscriptions, diagnostics.

The nodes of tools, such as `replay` and `view`, do not derive from it.
"""

from __future__ import annotations

import math
import os
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from inspect import iscoroutinefunction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, UInt8MultiArray

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.awake_clock import AwakeClock
from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.estimation.network_validation.validator import CheckpointValidator
from musculoskeletal_ae.exceptions import (
    CheckpointError,
    MessageError,
    MusculoskeletalError,
    printable,
)
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.messages.message_reading import (
    joints_not_finite,
    read_array,
    read_posture,
)
from musculoskeletal_ae.messages.reception import SHOWN, Reception
from musculoskeletal_ae.nodes.checkpoint_queue import ACCEPTED, CANDIDATES, CheckpointQueue
from musculoskeletal_ae.nodes.declared_parameters import check_names
from musculoskeletal_ae.nodes.node_parameters import NodeParameters
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.ros.diagnostics import MANY_REPORTS, PERIOD, Diagnostics
from musculoskeletal_ae.ros.executor import parameter_overrides
from musculoskeletal_ae.ros.latched_values import LatchedRequests
from musculoskeletal_ae.ros.message_building import LATCHED, RELIABLE, SENSOR, refuse
from musculoskeletal_ae.ros.needed_topics import NeededTopics
from musculoskeletal_ae.ros.second_publishers import (
    AUTHORS,
    CLOCK,
    LOOK_PERIOD,
    MOTOR_COMMAND,
    Sources,
    Twins,
)
from musculoskeletal_ae.signals.body_state import ROWS, BodyState
from musculoskeletal_ae.signals.joint_trust_message import JointTrust
from musculoskeletal_ae.signals.motor_interface import STATES, MotorInterface

if TYPE_CHECKING:  # a slow import, because it loads the bag writer
    from musculoskeletal_ae.nodes.stop_recording import StopRecording

#: clock for message ages and watchdogs; independent of /clock
STEADY = Clock(clock_type=ClockType.STEADY_TIME)
TIMER = 'Timer'  # source of an exception that escaped a timer's callback
#: remedies for incompatible QoS, by the side that states the policy and by policy
QOS_REMEDIES = {
    ('publisher offers', QoSPolicyKind.RELIABILITY): 'publish it reliable',
    ('publisher offers', QoSPolicyKind.DURABILITY): 'publish it transient local (latched)',
    ('subscriber needs', QoSPolicyKind.RELIABILITY): 'subscribe best-effort',
    ('subscriber needs', QoSPolicyKind.DURABILITY): 'subscribe volatile',
}


class Shell(Node):
    """A node that knows its robot, counts the messages it rejects, and reports once a second."""

    core: Any = None  # object, independent of ROS, that computes what the node publishes
    is_time_critical = True  # whether a delay of this node delays commands
    is_watched = True  # whether the process ends if it makes no progress for 10 s
    #: recorder of every message that arrives, before the message is used; None to record nothing
    recording: StopRecording | None = None
    #: topics of `AUTHORS` whose messages this node accepts from several publishers
    accepted_from_all: frozenset[str] = frozenset()

    def __init__(self, name: str, **options: Any) -> None:
        """Start the node, declare its parameters and load its robot.

        Args:
            name: Name of the node, also in `PARAMETERS`.
            options: Keyword arguments of `Node`.

        Raises:
            MusculoskeletalError: If a parameter or the robot cannot be used.
        """
        super().__init__(name, **options)
        self.parameters = NodeParameters(self, name)
        check_names(parameter_overrides(self))
        self.robot = Robot.load(self.parameter('robot'))
        self.rate: float = self.parameter('rate')  # rate of the muscle modules [Hz]
        self.motors = MotorInterface(self.robot.description.motors, self.robot.tension_source)
        #: topics of a ros2_control robot, by the names of the topics that they replace
        self._wires = {STATES: self.motors.state_topic, MOTOR_COMMAND: self.motors.command_topic}
        #: name of the root link's frame in published messages
        self.root_frame = self.parameter('frame_prefix') + self.robot.root_link
        warn = self.get_logger().warning
        self.awake = AwakeClock()  # clock that stops while this process is blocked
        self._reception = Reception(
            lambda text: warn(f'{text} (counted in /diagnostics)'), self.awake
        )
        self._latched_requests = LatchedRequests(self)
        self.sources = Sources(
            self,
            self.full_name,
            lambda topic: self._reception.arrivals[topic].turns,
            self._request_again,
        )
        self.rejected = self._reception.rejected  # number of messages, by topic and reason
        #: the newest body state that the estimator has published
        self.body = BodyState.healthy(self.robot.muscle_count)
        hardware = self.robot.description.directory.name
        self._diagnostics = Diagnostics(self, self._reception, hardware)
        self.twins = Twins(self._diagnostics.status_name, self._diagnostics.identity, self.awake)
        self._reports_of_twins: Any = None  # the subscription, since a namesake was seen
        self.create_timer(LOOK_PERIOD, self._look_around, clock=STEADY)
        self.create_timer(PERIOD, self._report_periodically, clock=STEADY)
        self._fault = '', -math.inf  # the last internal error, and its time [s]
        #: identifiers, levels and subjects of the conditions in the last report
        self._reported: frozenset[tuple[str, str, tuple[str, ...]]] = frozenset()
        self.needed = NeededTopics(self, self.full_name, self._reception)
        backward = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True
        )
        self._jump = self.get_clock().create_jump_callback(
            backward, post_callback=lambda _: self._on_clock_jump()
        )

    # -- methods for subclasses to override -----------------------------------------------------

    def report(self) -> Report:
        """Return the diagnostic report, with all conditions."""
        return self.status()._replace(conditions=tuple(self.conditions()))

    def status(self) -> Report:
        """Return what the node does, with its values; by default those of the core, if any."""
        return self.core.report(time.monotonic()) if self.core else Report('running', {})

    def conditions(self) -> Iterable[Condition]:
        """Yield all conditions that this node reports; an overriding method adds its own."""
        now, kind = time.monotonic(), ConditionKind
        if self.core:
            yield from self.core.conditions(now)
        yield from self.needed.conditions()
        if intruders := self.intruders:
            remedy = self.sources.remedy()
            steps = [Step.STOP_SECOND_PUBLISHER]
            yield kind.SECOND_PUBLISHER.condition(f'{intruders}; {remedy}', steps=steps)
        if refusal := self._reception.refusal:
            yield kind.REQUEST_REFUSED.condition(refusal)
        fault, at = self._fault
        if now - at < SHOWN:
            yield kind.INTERNAL_ERROR.condition(fault)

    def clock_jumped_back(self) -> None:
        """Discard buffers, rates and filters after the ROS clock has jumped back.

        Keep latched anomalies and stops.
        """
        if self.core:
            self.core.clock_jumped_back()

    def _on_clock_jump(self) -> None:
        self.motors.reset()
        self.clock_jumped_back()

    # -- errors in callbacks --------------------------------------------------------------------

    def on_callback_error(self, source: str, error: Exception) -> None:
        """Count and log an exception that escaped a callback.

        Args:
            source: Topic or service of the callback, or TIMER.
            error: The exception.
        """
        if source == TIMER:  # no message caused it
            self._fault = f'{type(error).__name__}: {error}', time.monotonic()
        if self._reception.reject_error(source, error):
            self.get_logger().error(printable(traceback.format_exc()))

    def create_subscription(  # type: ignore[override]
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **options: Any
    ) -> Any:
        """Create a subscription; count exceptions that escape its callback.

        rclpy calls this method for /clock as well.
        """
        guarded = self._guarded(self.resolve_topic_name(topic), callback)
        if qos_profile is RELIABLE:
            self._reception.commands.add(topic)
        events = SubscriptionEventCallbacks(
            incompatible_qos=lambda event: self._on_incompatible(topic, 'publisher offers', event)
        )
        options.setdefault('event_callbacks', events)
        return super().create_subscription(msg_type, topic, guarded, qos_profile, **options)

    def create_publisher(  # type: ignore[override]
        self, msg_type: Any, topic: str, qos_profile: Any, **options: Any
    ) -> Any:
        """Create a publisher; report subscribers with incompatible QoS."""
        events = PublisherEventCallbacks(
            incompatible_qos=lambda event: self._on_incompatible(topic, 'subscriber needs', event)
        )
        options.setdefault('event_callbacks', events)
        return super().create_publisher(msg_type, topic, qos_profile, **options)

    def _on_incompatible(self, topic: str, who: str, event: Any) -> None:
        policy = QoSPolicyKind(event.last_policy_kind)
        remedy = QOS_REMEDIES.get(
            (who, policy), 'see "Quality of service" in doc/reference/topics_and_services.md'
        )
        this_node = 'this node needs' if who == 'publisher offers' else 'this node offers'
        problem = f'a {who} another {policy.name.lower()} than {this_node}; {remedy}'
        self._reception.reject(topic, 'incompatible QoS', f'incompatible QoS: {problem}')
        self._reception.refuse(f'{topic}: incompatible QoS: {problem}')

    def create_timer(  # type: ignore[override]
        self, timer_period_sec: float, callback: Any, **options: Any
    ) -> Any:
        """Create a timer; count and report exceptions that escape its callback."""
        return super().create_timer(timer_period_sec, self._guarded(TIMER, callback), **options)

    def _guarded(self, source: str, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Return a callback with the same signature that counts exceptions of `callback`."""

        @wraps(callback)
        def call(*arguments: Any) -> None:
            with self._counting_errors(source):
                callback(*arguments)

        @wraps(callback)
        async def call_asynchronously(*arguments: Any) -> None:
            with self._counting_errors(source):
                await callback(*arguments)

        return call_asynchronously if iscoroutinefunction(callback) else call

    @contextmanager
    def _counting_errors(self, source: str) -> Iterator[None]:
        try:
            yield
        except ExternalShutdownException:  # requests the end of the node
            raise
        except Exception as error:  # noqa: BLE001
            self.on_callback_error(source, error)

    def create_service(  # type: ignore[override]
        self, srv_type: Any, srv_name: str, callback: Any, **options: Any
    ) -> Any:
        """Create a service that responds even if an exception escapes its callback."""

        def answer(request: Any, response: Any) -> Any:
            try:
                response = callback(request, response)
            except Exception as error:  # noqa: BLE001
                self.on_callback_error(srv_name, error)
                refuse(request, response, printable(error))
            if hasattr(response, 'message'):
                response.message = printable(response.message)
            return response

        return super().create_service(srv_type, srv_name, answer, **options)

    # -- parameters -----------------------------------------------------------------------------

    def parameter(self, name: str) -> Any:
        """Return a parameter's checked value; see `NodeParameters.value`."""
        return self.parameters.value(name)

    def state_directory(self) -> Path | None:
        """Return the directory of the parameter `state_directory`; None if nothing is to be saved.

        The value `auto` stands for a separate directory for each robot and namespace. A ~ in the
        result is not expanded.
        """
        value = self.parameter('state_directory')
        if value != 'auto':
            return Path(value) if value else None
        home = os.environ.get('XDG_STATE_HOME') or '~/.local/state'
        place = Path(home) / 'musculoskeletal_ae' / self.robot.description.directory.name
        return place.joinpath(*self.get_namespace().strip('/').split('/'))

    # -- checkpoints ----------------------------------------------------------------------------

    def follow_accepted_checkpoints(
        self, use: Callable[[Mae], None], unfit: Callable[[str], None] = lambda _: None
    ) -> None:
        """Use each network that the estimator accepts.

        Until the first network arrives, use that of the parameter `checkpoint`, if it is set.

        Args:
            use: Called with each network that this node is to use from now on.
            unfit: Called with the reason if a network is unusable; the previous network stays in
                use.
        """
        arrival = self._reception.arrivals[ACCEPTED]
        used: Any = None  # content of the message whose network is in use

        def put_to_use(mae: Mae) -> None:
            try:
                use(mae)
            except (np.linalg.LinAlgError, FloatingPointError) as error:
                raise CheckpointError(f'the network cannot be evaluated ({error})') from error
            self.needed.remove(ACCEPTED)

        def handle(message: UInt8MultiArray) -> Iterator[None]:
            nonlocal used
            if message.data == used:  # another node has requested the network again
                return
            mae = checkpoint.from_bytes(bytes(message.data), self.robot)
            yield
            put_to_use(mae)
            used = message.data

        def use_file(mae: Mae) -> None:
            if arrival.was_used:
                raise MusculoskeletalError(
                    'all nodes use the network of the estimator; set the parameter `checkpoint` of '
                    'the estimator instead'
                )
            put_to_use(mae)

        accepted = self.checkpoint_queue(ACCEPTED, handle, unfit)
        self.needed.add(ACCEPTED)
        self.parameters.follow('checkpoint', use_file, self.load_checkpoint)
        self.listen(UInt8MultiArray, ACCEPTED, accepted.propose, LATCHED)

    def load_checkpoint(self, path: str) -> Mae | None:
        """Return the network in a file; None if the path is empty.

        Raises:
            CheckpointError: If the file cannot be read, or is invalid; if the network belongs to
                another robot, or its predictions are implausible for this one.
        """
        if not path:
            return None
        mae = checkpoint.load(path, self.robot)
        CheckpointValidator(self.robot).check(mae)
        return mae

    def checkpoint_queue(
        self,
        topic: str,
        handle: Callable[[UInt8MultiArray], Iterator[None]],
        unfit: Callable[[str], None] = lambda _: None,
    ) -> CheckpointQueue:
        """Return a queue that processes the checkpoints of a topic in small steps.

        `handle` yields after each step. `unfit` is called with the reason if a checkpoint is
        unusable.
        """
        return CheckpointQueue(self, self._reception, topic, handle, unfit)

    # -- messages -------------------------------------------------------------------------------

    def now(self) -> float:
        """Return the time of the ROS clock [s]."""
        return self.get_clock().now().nanoseconds * 1e-9

    def full_name(self, topic: str) -> str:
        """Return the full name of a topic.

        On a ros2_control robot, this is the name of the topic of the motors that replaces `topic`.
        The result is '' for `motor_command` if the robot has no topic for commands to motors, and
        for `/clock` if this node does not use it.
        """
        if topic == CLOCK and not self.get_parameter('use_sim_time').value:
            return ''
        name = self._wires.get(topic, topic)
        return self.resolve_topic_name(name) if name else ''

    def listen(
        self, kind: type, topic: str, callback: Callable[[Any], object], qos: QoSProfile
    ) -> None:
        """Subscribe, and count messages that are repeated, late or refused by the callback.

        A topic in `AUTHORS` should have exactly one publisher. While such a topic has several
        publishers, its messages are rejected (`second_publishers`), unless it is in
        `accepted_from_all`.

        Args:
            kind: Message type.
            topic: Name of the topic in the interface of this package. On a ros2_control robot, the
                messages may come from another topic (`full_name`).
            callback: Uses the message it is called with, or raises a MusculoskeletalError to
                refuse it.
            qos: Quality of service.
        """
        wire, full, recording = self._wires.get(topic, topic), self.full_name(topic), self.recording
        if topic in AUTHORS and topic not in self.accepted_from_all:
            self.sources.watch(topic)
            callback = self._from_author(topic, callback, qos is LATCHED)
        if recording is not None:
            callback = _recorded(recording, wire, kind, callback)

        receive = self._reception.of(
            topic,
            callback,
            lambda: self.count_publishers(full),
            is_used_at_once=topic not in (CANDIDATES, ACCEPTED),
        )
        self.create_subscription(kind, wire, receive, qos, raw=recording is not None)

    def _from_author(
        self, topic: str, callback: Callable[[Any], object], is_latched: bool
    ) -> Callable[[Any], None]:
        """Return a callback that rejects messages while several nodes publish the topic.

        On a latched topic, it also rejects them while the node of one of several publishers is
        not known yet.
        """

        def take(message: Any) -> None:
            self.sources.check(topic, is_latched)
            callback(message)

        return take

    def _request_again(self, topic: str) -> None:
        """Request the last value of a latched topic, which only one node publishes now."""
        self._reception.arrivals[topic].forget_order()
        self._latched_requests.send(self.full_name(topic))

    def _look_around(self) -> None:
        self.awake.tick(time.monotonic())
        self.sources.watch(CLOCK)  # `use_sim_time` may be set at any time
        self.sources.look()
        has_namesake = self._look_for_namesake()
        self.on_intruders(self.intruders)
        if has_namesake:  # two nodes of one name know each other by their reports, so report often
            self._report()
        else:
            self._report_changes()

    def _look_for_namesake(self) -> bool:
        """Return whether the graph has several nodes of this node's name; if so, read reports.

        The node reads the reports of all nodes only from the first namesake on. Otherwise, the
        nodes of ten arms would receive 3600 reports a second.
        """
        parameters = f'{self.get_fully_qualified_name()}/get_parameters'  # a service of every node
        has_namesake = self.count_services(parameters) > 1
        if has_namesake and self._reports_of_twins is None:
            self._reports_of_twins = self.create_subscription(
                DiagnosticArray,
                '/diagnostics',
                lambda report: self.twins.take(report, time.monotonic()),
                MANY_REPORTS,
                raw=True,
            )
        return has_namesake

    @property
    def intruders(self) -> str:
        """The nodes that must not run beside those of this arm, as a text; '' if there are none.

        These are other publishers of topics that belong to this arm's nodes, and other nodes with
        the name of this node.
        """
        problems = [self.sources.intruders]
        if not self.twins.is_alone(time.monotonic()):
            problems.append(f'two nodes are named {self.get_fully_qualified_name()}')
        return '; '.join(filter(None, problems))

    def on_intruders(self, intruders: str) -> None:
        """React to intruding nodes; called ten times a second with the property `intruders`."""

    def follow_muscles(
        self,
        topic: str,
        follow: Callable[[Array], object],
        rows: int = 1,
        qos: QoSProfile = RELIABLE,
    ) -> None:
        """Call `follow` with each array from a topic: (rows, M), or (M,) for a single row."""
        muscles = self.robot.muscle_count
        self.listen(Float64MultiArray, topic, lambda m: follow(read_array(m, rows, muscles)), qos)

    def follow_muscle_messages(self, follow: Callable[[Any, float, float], object]) -> None:
        """Call `follow` with each message of muscle_states, whose values are not checked yet.

        On a ros2_control robot, the messages of the motors are converted to muscle_states.

        Args:
            follow: Called with the message, the time of its reception by the steady clock [s], and
                its delay [s] (`Arrival.delay`).
        """
        kind = JointState if self.motors.is_ros2_control else Float64MultiArray
        arrival = self._reception.arrivals[STATES]

        def take(message: Any) -> None:
            follow(self.motors.reading(message), arrival.received_at, arrival.delay)

        self.listen(kind, STATES, take, SENSOR)

    def follow_body(self, changed: Callable[[], object]) -> None:
        """Update `body` with each new body state of the estimator, then call `changed`.

        A body state may be received several times, because the topic is latched. It is used once.
        """

        def take(rows: Array) -> None:
            body = BodyState.of_rows(rows)
            if body.generation != self.body.generation:
                self.body = body
                changed()

        self.follow_muscles('body_state', take, ROWS, LATCHED)

    def follow_joint_trust(self, follow: Callable[[JointTrust], object]) -> None:
        """Call `follow` with the estimator's trust in the joint sensors, by the clock of `now`."""

        def take(message: Float64MultiArray) -> None:
            rows = read_array(message, JointTrust.ROWS, self.robot.joint_count, 'joint')
            rows[-1] = self.robot.units.to_theta(rows[-1])
            try:
                follow(JointTrust.from_rows(rows, self.now()))
            except ValueError as error:
                raise MessageError('impossible trust', str(error)) from error

        self.listen(Float64MultiArray, 'joint_sensor_trust', take, LATCHED)

    def follow_posture(
        self, topic: str, follow: Callable[[Array], object], some: bool = False
    ) -> None:
        """Call `follow` with θ [rad], (D,), of each message from a topic of joint states.

        Args:
            topic: Name of the topic.
            follow: Called with θ.
            some: Whether a message may lack joints, or have positions that are not finite. These
                positions are NaN in θ, and those that are not finite are counted as ignored.
        """
        units = self.robot.units

        def take(message: JointState) -> None:
            follow(read_posture(message, units, some))
            for name in joints_not_finite(message, units.names):
                self._reception.ignore(topic, f'position of {name} is not finite')

        self.listen(JointState, topic, take, SENSOR)

    # -- diagnostics ----------------------------------------------------------------------------

    def _report_periodically(self) -> None:
        self._reception.measure_rates()
        self.needed.check_rates()
        self._report()

    def _report_changes(self) -> None:
        """Report at once if other conditions are present than in the last report."""
        try:
            present = _signs(self.conditions())
        except Exception as error:  # noqa: BLE001 - the error has to be reported
            self.on_callback_error(TIMER, error)
            return
        if present != self._reported:
            self._report()

    def _report(self) -> None:
        try:
            report = self.report()
        except Exception as error:  # noqa: BLE001 - the error has to be reported
            self.on_callback_error(TIMER, error)
            report = Report('', {}, (ConditionKind.INTERNAL_ERROR.condition(self._fault[0]),))
        self._reported = _signs(report.conditions)
        self._diagnostics.tell(report)


def _signs(conditions: Iterable[Condition]) -> frozenset[tuple[str, str, tuple[str, ...]]]:
    """Return identifiers, levels and subjects of conditions, without the values in their texts."""
    return frozenset((each.identifier, each.level, each.subjects) for each in conditions)


def _recorded(
    recording: StopRecording, topic: str, kind: type, callback: Callable[[Any], Any]
) -> Callable[[bytes], Any]:
    """Return a callback that records a serialized message of a topic, and calls `callback` with it.

    `callback` receives the deserialized message, of the type `kind`.
    """

    def read(data: bytes) -> Any:
        message = deserialize_message(data, kind)
        recording.heard(topic, data)
        return message

    return lambda data: callback(read(data))
