# SPDX-License-Identifier: Apache-2.0
"""What all node shells share: parameters, checkpoints, subscriptions, diagnostics."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from inspect import iscoroutinefunction
from typing import TYPE_CHECKING, Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import QoSPolicyKind, QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray, String, UInt8MultiArray

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.estimation.checkpoint_validation import CheckpointValidator
from musculoskeletal_ae.exceptions import (
    CheckpointError,
    MessageError,
    MusculoskeletalError,
    printable,
)
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.nodes.anomaly_latch import AnomalyLatch
from musculoskeletal_ae.nodes.checkpoint_queue import ACCEPTED, CANDIDATES, CheckpointQueue
from musculoskeletal_ae.nodes.diagnostics import PERIOD, Diagnostics
from musculoskeletal_ae.nodes.messages import LATCHED, RELIABLE, SENSOR, refuse
from musculoskeletal_ae.nodes.parameters import PARAMETERS, check_names
from musculoskeletal_ae.nodes.sources import AUTHORS, LOOK_PERIOD, SEVERAL, Sources, Twins
from musculoskeletal_ae.parameters import Parameter
from musculoskeletal_ae.reception import Reception
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.body_state import BodyState, LengthOffsets
from musculoskeletal_ae.validity import (
    joints_not_finite,
    read_array,
    read_names,
    read_posture,
)

if TYPE_CHECKING:  # it needs what writes bags
    from musculoskeletal_ae.nodes.stop_recording import StopRecording

#: for ages and watchdogs; never stands still, whatever /clock does
STEADY = Clock(clock_type=ClockType.STEADY_TIME)
TIMER = 'Timer'  # source of an exception that escaped a timer's callback
MOST_ZERO = 10.0  # [m] of a length sensor
#: what to do about a quality of service that does not fit, by who states it
QOS_REMEDIES = {
    ('publisher offers', QoSPolicyKind.RELIABILITY): 'publish it reliable',
    ('publisher offers', QoSPolicyKind.DURABILITY): 'publish it transient local (latched)',
    ('subscriber asks', QoSPolicyKind.RELIABILITY): 'subscribe best-effort',
    ('subscriber asks', QoSPolicyKind.DURABILITY): 'subscribe volatile',
}
MANY_REPORTS = QoSProfile(depth=50)  # of all nodes of the graph


class Shell(Node):
    """A node that knows its robot, counts what it rejects and reports once a second."""

    core: Any = None  # what computes
    is_time_critical = True  # whether commands wait for it
    is_watched = True  # whether the process ends if it makes no progress for 10 s
    recording: StopRecording | None = None  # told of every message that is new, before it is used
    #: topics that have one rightful publisher, but on which this node takes what anybody sends
    accepted_from_all: frozenset[str] = frozenset()

    def __init__(self, name: str, **options: Any) -> None:
        """Start the node, declare its parameters and load its robot; options are those of Node."""
        super().__init__(name, **options)
        self._table = PARAMETERS[name]
        self._setters: dict[str, Callable[[Any], object]] = {}
        self._prepare: dict[str, Callable[[Any], object]] = {}
        self._proposed: dict[str, Any] = {}  # values that are being judged
        for key, parameter in self._table.items():
            default = parameter.default
            default = list(default) if isinstance(default, tuple) else default
            self.declare_parameter(key, default, _descriptor(parameter))
            self.parameter(key)  # refuses what is not legal
        check_names(getattr(self, '_parameter_overrides', {}))
        self.robot = Robot.load(self.parameter('robot'))
        self.rate: float = self.parameter('rate')  # of the muscle modules [Hz]
        #: name of the root link's frame in messages that are published
        self.root_frame = self.parameter('frame_prefix') + self.robot.root_link
        warn = self.get_logger().warning
        self._reception = Reception(lambda text: warn(f'{text} (counted in /diagnostics)'))
        self._latched: dict[str, tuple[Any, Callable[[], Any]]] = {}  # how to subscribe anew
        self.sources = Sources(self, self._reception.turns, self._subscribe_anew)
        self.rejected = self._reception.rejected  # messages, by topic and reason
        #: as the estimator publishes it
        self.body = BodyState.healthy(self.robot.muscle_count)
        self.add_on_set_parameters_callback(self._set_parameters)
        hardware = self.robot.description.directory.name
        self._diagnostics = Diagnostics(self, self._reception, hardware)
        self.twins = Twins(self._diagnostics.status_name, self._diagnostics.identity)
        self.create_subscription(
            DiagnosticArray,
            '/diagnostics',
            lambda report: self.twins.take(report, time.monotonic()),
            MANY_REPORTS,
            raw=True,
        )
        self.create_timer(LOOK_PERIOD, self._look_around, clock=STEADY)
        self.create_timer(PERIOD, self._report, clock=STEADY)
        self._fault = self._waiting = ''
        self.checkpoint_version: int | None = None  # of the network in use
        self.needed: list[str] = []  # topics without which the node has nothing to do
        backward = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True
        )
        self._jump = self.get_clock().create_jump_callback(
            backward, post_callback=lambda _: self.clock_jumped_back()
        )

    # -- what a node overrides ------------------------------------------------------------------

    def report(self) -> Report:
        """Return what /diagnostics shows: what the core says, where there is one."""
        return self.core.report(time.monotonic()) if self.core else Report('ok', 'running', {})

    def clock_jumped_back(self) -> None:
        """Forget buffers, rates and filters; latches stay."""
        if self.core:
            self.core.clock_jumped_back()

    # -- what must not end the node -------------------------------------------------------------

    def on_callback_error(self, source: str, error: Exception) -> None:
        """Count and log an exception that escaped a callback, by topic or service."""
        if source == TIMER:  # no message caused it
            self._fault = f'fault of its own: {type(error).__name__}: {error}'
        if self._reception.reject_error(source, error):
            self.get_logger().error(printable(traceback.format_exc()))

    def create_subscription(  # type: ignore[override]
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **options: Any
    ) -> Any:
        """Subscribe; an exception that escapes the callback is counted.

        rclpy subscribes to /clock by this method as well.
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
        """Advertise; a subscriber that cannot be served is reported."""
        events = PublisherEventCallbacks(
            incompatible_qos=lambda event: self._on_incompatible(topic, 'subscriber asks', event)
        )
        options.setdefault('event_callbacks', events)
        return super().create_publisher(msg_type, topic, qos_profile, **options)

    def _on_incompatible(self, topic: str, who: str, event: Any) -> None:
        policy = QoSPolicyKind(event.last_policy_kind)
        remedy = QOS_REMEDIES.get((who, policy), 'see "Quality of service" in the interface')
        problem = f'a {who} another {policy.name.lower()} than this node: {remedy}'
        self._reception.reject(topic, 'incompatible QoS', f'incompatible QoS: {problem}')
        self._reception.refuse(f'{topic}: incompatible QoS: {problem}')

    def create_timer(  # type: ignore[override]
        self, timer_period_sec: float, callback: Any, **options: Any
    ) -> Any:
        """Create a timer; an exception that escapes the callback is counted as a fault."""
        return super().create_timer(timer_period_sec, self._guarded(TIMER, callback), **options)

    def _guarded(self, source: str, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Return a callback that counts what escapes `callback`; rclpy sees the same signature."""

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
        except ExternalShutdownException:  # asks for the end of the node
            raise
        except Exception as error:  # noqa: BLE001
            self.on_callback_error(source, error)

    def create_service(  # type: ignore[override]
        self, srv_type: Any, srv_name: str, callback: Any, **options: Any
    ) -> Any:
        """Offer a service that answers even if an exception escapes its callback."""

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
        """Return a parameter's value, if it is legal; lists as tuples, without empty names."""
        with _blaming(name):
            value = self._proposed.get(name, self._held(name))
            return self._table[name].checked(value)

    def _held(self, name: str) -> Any:
        value = self.get_parameter_or(name, RosParameter(name)).value
        # What rcl makes of an empty list that is given at the start.
        return [] if value is None and isinstance(self._table[name].default, tuple) else value

    def follow_parameter(
        self,
        name: str,
        setter: Callable[[Any], object],
        prepare: Callable[[Any], object] | None = None,
    ) -> None:
        """Call `setter`, which raises to refuse, with a parameter's value now and when set.

        It is called again with the value before if another one of those set together is refused.
        Where that would bring nothing back, `prepare` makes of the value what the setter takes, or
        None for nothing to do, and raises to refuse: such setters are called last, in the order in
        which they were given, one that several parameters share once. Only the first may raise.
        """
        self._setters[name] = setter
        if prepare is not None:
            self._prepare[name] = prepare
        self._take({name: self._held(name)})

    def _take(self, values: dict[str, Any]) -> None:
        """Call the setters of parameters, of all or, if one is refused, of none."""
        legal, last = dict[str, Any](), dict[Callable[[Any], object], tuple[str, Any]]()
        for name in filter(values.__contains__, self._setters):
            with _blaming(name):
                legal[name] = self._table[name].checked(values[name])
                if prepare := self._prepare.get(name):
                    prepared = prepare(legal.pop(name))
                    if prepared is not None:
                        last[self._setters[name]] = name, prepared
        taken: list[str] = []
        try:
            for name, value in legal.items():
                with _blaming(name):
                    self._setters[name](value)
                taken.append(name)
            for setter, (name, value) in last.items():
                with _blaming(name):
                    setter(value)
        except MusculoskeletalError:
            self._proposed = {}
            for name in reversed(taken):
                self._setters[name](self.parameter(name))
            raise

    def _set_parameters(self, parameters: list[RosParameter]) -> SetParametersResult:
        self._proposed = {p.name: p.value for p in parameters}
        try:
            self._take(self._proposed)
        except MusculoskeletalError as error:
            return SetParametersResult(successful=False, reason=str(error))
        finally:
            self._proposed = {}
        return SetParametersResult(successful=True)

    # -- checkpoints ----------------------------------------------------------------------------

    def follow_accepted_checkpoints(
        self, use: Callable[[Mae], None], unfit: Callable[[str], None] = lambda _: None
    ) -> None:
        """Use the network that the estimator has accepted, or until there is one that of a file.

        `unfit` is called with the reason if a network cannot be computed with; the one in use
        stays.
        """
        has_accepted = False

        def put_to_use(mae: Mae) -> None:
            try:
                use(mae)
            except (np.linalg.LinAlgError, FloatingPointError) as error:
                raise CheckpointError(f'cannot be computed with ({error})') from error
            self.checkpoint_version = mae.version
            self.stop_waiting_for(ACCEPTED)

        def handle(message: UInt8MultiArray) -> Iterator[None]:
            mae = checkpoint.from_bytes(bytes(message.data), self.robot)
            yield
            put_to_use(mae)
            nonlocal has_accepted
            has_accepted = True

        def use_file(mae: Mae) -> None:
            if has_accepted:
                raise MusculoskeletalError(
                    'all nodes use the network of the estimator; set its `checkpoint` instead'
                )
            CheckpointValidator(self.robot).check(mae)
            put_to_use(mae)

        self.accepted = self.checkpoint_queue(ACCEPTED, handle, unfit)
        self.needed.append(ACCEPTED)
        self.follow_parameter('checkpoint', use_file, self.load_checkpoint)
        self.listen(UInt8MultiArray, ACCEPTED, self.accepted.propose, LATCHED)

    def load_checkpoint(self, path: str) -> Mae | None:
        """Return the network of a file, which has to be one of this robot; None without a path."""
        return checkpoint.load(path, self.robot) if path else None

    def checkpoint_queue(
        self,
        topic: str,
        handle: Callable[[UInt8MultiArray], Iterator[None]],
        unfit: Callable[[str], None] = lambda _: None,
    ) -> CheckpointQueue:
        """Return what handles the checkpoints of a topic in small steps."""
        return CheckpointQueue(self, self._reception, topic, handle, unfit)

    def stop_waiting_for(self, topic: str) -> None:
        """Report this topic as missing no longer."""
        self.needed = [other for other in self.needed if other != topic]

    # -- messages -------------------------------------------------------------------------------

    def now(self) -> float:
        """Return the time of a message that comes now, by the ROS clock [s]."""
        return self.get_clock().now().nanoseconds * 1e-9

    def listen(
        self, kind: type, topic: str, callback: Callable[[Any], object], qos: QoSProfile
    ) -> None:
        """Subscribe; what comes twice or late, or the callback refuses by raising, is counted.

        Topics that have one rightful publisher are watched (`sources`). What comes while there are
        several is rejected, unless the topic is one of `accepted_from_all`.
        """
        full, recording = self.resolve_topic_name(topic), self.recording
        if topic in AUTHORS and topic not in self.accepted_from_all:
            self.sources.watch(topic)
            callback = self._from_author(topic, callback, qos is LATCHED)
        if recording is not None:
            callback = _recorded(recording, topic, kind, callback)

        def subscribe() -> Any:
            receive = self._reception.of(
                topic,
                callback,
                lambda: self.count_publishers(full),
                is_used_at_once=topic not in (CANDIDATES, ACCEPTED),
            )
            # rclpy accepts (message, info) callbacks; its annotations do not know them.
            raw = recording is not None
            return self.create_subscription(kind, topic, receive, qos, raw=raw)

        subscription = subscribe()
        if qos is LATCHED:
            self._latched[topic] = subscription, subscribe

    def _from_author(
        self, topic: str, callback: Callable[[Any], object], is_latched: bool
    ) -> Callable[[Any], None]:
        """Return a callback that rejects what comes while several nodes publish the topic."""

        def take(message: Any) -> None:
            self.sources.check(topic, is_latched)
            callback(message)

        return take

    def _subscribe_anew(self, topic: str) -> None:
        """Let a latched topic bring its value again."""
        subscription, subscribe = self._latched[topic]
        self.destroy_subscription(subscription)
        self._latched[topic] = subscribe(), subscribe

    def _look_around(self) -> None:
        self.sources.look()
        self.on_intruders(self.intruders)

    @property
    def intruders(self) -> str:
        """Which other nodes publish what this arm's nodes alone should, or ''."""
        found = [self.sources.intruders]
        if not self.twins.is_alone(time.monotonic()):
            found.append(f'two nodes are named {self.get_fully_qualified_name()}')
        return '; '.join(filter(None, found))

    def on_intruders(self, intruders: str) -> None:
        """Take who publishes beside the rightful publishers; '' if nobody does."""

    def follow_muscles(
        self,
        topic: str,
        follow: Callable[[Array], object],
        rows: int = 1,
        qos: QoSProfile = RELIABLE,
    ) -> None:
        """Give `follow` what comes on a topic with a value for each muscle, (M,) or (rows, M)."""
        muscles = self.robot.muscle_count
        self.listen(Float64MultiArray, topic, lambda m: follow(read_array(m, rows, muscles)), qos)

    def follow_muscle_messages(self, follow: Callable[[Float64MultiArray], object]) -> None:
        """Give `follow` the messages of muscle_states as they are."""
        self.listen(Float64MultiArray, 'muscle_states', follow, SENSOR)

    def follow_offsets(self, changed: Callable[[], object]) -> None:
        """Keep the estimator's length offsets in `body`, and call `changed` when they are others.

        Known offsets that differ from the known ones before come from an estimator that was
        started again and has not heard of those. They count as unknown until it has found them.
        """
        heard = LengthOffsets.unknown(self.robot.muscle_count)

        def take(rows: Array) -> None:
            nonlocal heard
            if np.abs(rows[0]).max() > MOST_ZERO or rows[1].min() < 0.0:
                detail = f'{rows.tolist()}, legal: ± {MOST_ZERO:g} m, deviations from 0 on'
                raise MessageError('impossible zeros', detail)
            zeros, before, heard = LengthOffsets(*rows), heard, LengthOffsets(*rows)
            if before.known and zeros.known:
                if (zeros.offset == before.offset).all():
                    return
                zeros = replace(LengthOffsets.unknown(len(zeros.offset)), offset=zeros.offset)
            self.body = self.body.with_offsets(zeros)
            changed()

        self.follow_muscles('muscle_length_zeros', take, 2, LATCHED)

    def follow_isolated(self, changed: Callable[[], object]) -> None:
        """Keep in `body` which muscles the estimator has isolated, and call `changed` then."""

        def take(message: String) -> None:
            muscles = self.robot.muscle_indices(read_names(message))
            self.body = self.body.with_isolated(muscles)
            changed()

        self.listen(String, 'isolated_muscles', take, LATCHED)

    def follow_anomaly(self, follow: Callable[[bool], object]) -> None:
        """Tell whether the estimator has detected an anomaly, when that changes.

        The end of an anomaly counts once the estimator has confirmed it, asked by a service.
        """
        latch = AnomalyLatch(self, follow)
        self.listen(Bool, 'anomaly_detected', lambda message: latch.take(message.data), LATCHED)

    def follow_posture(
        self, topic: str, follow: Callable[[Array], object], some: bool = False
    ) -> None:
        """Give `follow` the θ [rad] (D,) that comes on a topic of joint states.

        If `some` joints are enough, the others are NaN. A position that is not finite then costs
        that joint only, and is counted.
        """
        joints = self.robot.joints

        def take(message: JointState) -> None:
            follow(read_posture(message, joints, some))
            for name in joints_not_finite(message, joints):
                self._reception.ignore(topic, f'position of {name} is not finite')

        self.listen(JointState, topic, take, SENSOR)

    # -- diagnostics ----------------------------------------------------------------------------

    def _tell_waiting(self, missing: list[str]) -> None:
        """Say, whenever it changes, which topics have brought nothing yet, and why."""
        told = [
            f'{self.resolve_topic_name(topic)}, which nobody publishes'
            if self.count_publishers(topic) == 0
            else f'{self.resolve_topic_name(topic)} that can be used'
            for topic in missing
        ]
        before, self._waiting = self._waiting, '; '.join(told)
        if self._waiting != before:
            self.get_logger().info(f'waiting for {self._waiting}' if told else 'all is there')

    def _report(self) -> None:
        try:
            report = self.report()
        except Exception as error:  # noqa: BLE001 - who reports nothing seems well
            self.on_callback_error(TIMER, error)
            report = Report('error', self._fault, {})
        if self.checkpoint_version is not None:
            report.values.setdefault('checkpoint version', str(self.checkpoint_version))
        if self._fault:
            values = {**report.values, 'fault': self._fault}
            report, self._fault = Report('error', self._fault, values), ''
        if (intruders := self.intruders) and report.level != 'error':
            text = f'{SEVERAL}: {intruders}; {self.sources.remedy()}'
            report = Report('error', text, {**report.values, SEVERAL: intruders})
        received = self._diagnostics.tell(report)
        self._tell_waiting([topic for topic in self.needed if topic not in received])


def _recorded(
    recording: StopRecording, topic: str, kind: type, callback: Callable[[Any], Any]
) -> Callable[[bytes], Any]:
    """Return what takes the bytes of a message, records them, and calls back with the message."""

    def read(data: bytes) -> Any:
        message = deserialize_message(data, kind)
        recording.heard(topic, data)
        return message

    return lambda data: callback(read(data))


@contextmanager
def _blaming(name: str) -> Iterator[None]:
    """Let errors name the parameter that they are about."""
    try:
        yield
    except (MusculoskeletalError, OSError) as error:
        raise MusculoskeletalError(f'parameter {name}: {error}') from error


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=parameter.description,
        read_only=not parameter.settable,
        dynamic_typing=parameter.is_number_list,  # `[]` is an array of bytes to rclpy
    )
    if parameter.within is not None:
        low, high = parameter.within
        if isinstance(parameter.default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return descriptor
