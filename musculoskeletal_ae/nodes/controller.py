# SPDX-License-Identifier: Apache-2.0
"""The node `controller`: computes muscle commands for a target posture, with a latched safe stop.

target_joint_states, joint_trajectory, target_pose, target_twist, estimated_joint_states,
muscle_states, body_state → muscle_length_command, or muscle_tension_command with the methods
`tension` and `float`; controller_state, controller_mode. Action follow_joint_trajectory, where
control_msgs is installed.
"""

import time
from collections.abc import Iterable
from contextlib import suppress
from importlib import import_module
from typing import Any

from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.duration import Duration
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from musculoskeletal_ae.awake_clock import PAUSE
from musculoskeletal_ae.bags.topics import topics_with
from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.control import controller_status
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.settings import BY_LENGTH, Settings
from musculoskeletal_ae.control.stop_memory import BEFORE, StopMemory
from musculoskeletal_ae.estimation.suspect_verification import LONGEST
from musculoskeletal_ae.exceptions import MusculoskeletalError, printable
from musculoskeletal_ae.messages.arrival import STREAM_GAP, is_later, nanoseconds
from musculoskeletal_ae.messages.message_reading import (
    read_pose,
    read_posture,
    read_target,
    read_trajectory,
    read_twist,
    without_orientation,
)
from musculoskeletal_ae.motion.activities import LENGTH, TENSION
from musculoskeletal_ae.nodes.shell import STEADY, Shell
from musculoskeletal_ae.nodes.stop_recording import StopRecording
from musculoskeletal_ae.parameters import naming_parameter, parameters_of
from musculoskeletal_ae.remedy_steps import Step, sentence
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.ros.message_building import (
    LATCHED,
    RELIABLE,
    SENSOR,
    array_message,
    motor_command,
    serve,
)
from musculoskeletal_ae.ros.second_publishers import AUTHORS
from musculoskeletal_ae.signals.reading_limits import LIMITS

#: compute a command after this number of periods without an estimate, so that stale messages stop
#: the arm
OVERDUE = 1.5


class ControllerNode(Shell):
    """Passes messages, parameters and services to the core controller; publishes its commands."""

    # While several nodes publish muscle_states, the arm is stopped. Their messages are still
    # accepted, because the stop pays the muscles out and needs the readings for that.
    accepted_from_all = frozenset({'muscle_states'})

    def __init__(self, **options: Any) -> None:
        super().__init__('controller', **options)
        self.publishers_of = {
            kind: self.create_publisher(Float64MultiArray, f'muscle_{kind}_command', RELIABLE)
            for kind in (LENGTH, TENSION)
        }
        self.core = Controller(self.robot, self._settings(), self.parameter('seed'), self.awake)
        self.memory = StopMemory(self.state_directory())
        if self.memory.found is not None:
            self.core.stop(self.memory.found.kind, BEFORE)
        self.recording: StopRecording = StopRecording(
            self.resolve_topic_name, topics=topics_with(self.motors.topics)
        )
        #: cause of the latched stop after its recording has begun; None otherwise
        self.recorded: ConditionKind | None = None
        self.logged: list[str] = []
        self.mode = self.create_publisher(String, 'controller_mode', LATCHED)
        self.published_mode = ''
        self.estimate_sent = -1  # stamp of the newest estimate [ns]; -1 before the first
        self.motor_commands = None
        if topic := self.motors.command_topic:
            self.motor_commands = self.create_publisher(Float64MultiArray, topic, RELIABLE)
        self.follow_accepted_checkpoints(
            self.core.use, lambda reason: self.core.stop(ConditionKind.UNFIT_CHECKPOINT, reason)
        )
        # Settings of one request are applied together, because they may end a motion, which a
        # return to the previous settings would not resume.
        for name in parameters_of(Settings):
            self.parameters.on_change(name, self.core.configure, lambda _: self._settings())
        self.needed.add('muscle_states', 'estimated_joint_states')
        self.follow_body(lambda: self.core.use_body(self.body))
        self.sources.watch(*AUTHORS)
        self.follow_muscle_messages(self._muscles)
        self.listen(JointState, 'estimated_joint_states', self._on_estimate, SENSOR)
        self.listen(JointState, 'target_joint_states', self._target, RELIABLE)
        self.listen(JointTrajectory, 'joint_trajectory', self._trajectory, RELIABLE)
        self.listen(PoseStamped, 'target_pose', self._pose, RELIABLE)
        self.listen(TwistStamped, 'target_twist', self._twist, RELIABLE)
        self.states = self.create_publisher(JointTrajectory, 'controller_state', RELIABLE)
        self.action: Any = None
        with suppress(ImportError):  # raised if control_msgs is not installed
            kind = import_module('control_msgs.action').FollowJointTrajectory
            module = import_module('musculoskeletal_ae.nodes.follow_joint_trajectory')
            refuse = self._reception.reject
            self.action = module.FollowJointTrajectory(
                self, kind, self.core, self._trajectory, refuse
            )
        serve(self, SetBool, 'controller/explore', self._explore)
        serve(self, Trigger, 'controller/stop', self._stop)
        serve(self, Trigger, 'controller/reset', self._reset)
        # Each step resets this timer. The timer therefore makes a step only while no estimates
        # arrive, to check the ages of messages and to publish commands.
        self.overdue = self.create_timer(OVERDUE / self.rate, self._step, clock=STEADY)
        if self.parameter('explore') and (reason := self.core.explore_at_start()):
            self.get_logger().warning(f'not exploring: {reason}')

    def destroy_node(self) -> None:
        """Wait until a stop recording has been written, then destroy the node."""
        self.recording.close()
        self.memory.close()
        super().destroy_node()

    def _settings(self) -> Settings:
        """Return the settings from the parameters, after a check that the robot permits them."""
        settings = Settings(**{name: self.parameter(name) for name in parameters_of(Settings)})
        settings.check_fit(self.robot)
        with naming_parameter('method'):
            self._check_driver(settings)
        return settings

    def _check_driver(self, settings: Settings) -> None:
        """Check that the driver or the motors can follow the commands of the method."""
        method = settings.control_method
        legal = ', '.join(BY_LENGTH)
        if method.commands_tension and self.motors.command_topic:
            problem = (
                f'{settings.method!r} commands tensions, but the motors on '
                f'{self.motors.command_topic} follow lengths only'
            )
            raise MusculoskeletalError(f'{problem}; legal: {legal}')
        followed = {
            kind: publisher.get_subscription_count()
            for kind, publisher in self.publishers_of.items()
        }
        # Position-controlled modules need no tension commands, because the limiter turns tensions
        # into lengths.
        by_tension = method.commands_tension and self.robot.actuation.follows_tensions
        if by_tension and followed[LENGTH] and not followed[TENSION]:
            # Refuse the method, because a driver that gets no commands pays the muscles out.
            problem = (
                f'{settings.method!r} commands tensions, but the driver subscribes to '
                'muscle_length_command only'
            )
            raise MusculoskeletalError(
                f'{problem}; legal: {legal}; or let the driver subscribe to muscle_tension_command'
            )

    def _muscles(self, message: Float64MultiArray, now: float, delay: float) -> None:
        self.core.take(message, now, delay)

    def on_intruders(self, intruders: str) -> None:
        """Stop while `intruders`, other nodes, publish topics that belong to this arm's nodes."""
        self.core.watchdog.second_publisher = intruders

    def _on_estimate(self, message: JointState) -> None:
        theta = read_posture(message, self.robot.units)
        sent = nanoseconds(message.header.stamp)
        if is_new := is_later(sent, self.estimate_sent):
            self.estimate_sent = sent
        self.core.estimated(theta, time.monotonic(), is_new, 1e-9 * sent)
        # Compute a command now. An estimate comes from the newest muscle states, so all inputs are
        # fresh.
        self._step()

    def _target(self, message: JointState) -> None:
        self.core.target(read_target(message, self.robot.units))
        names = ', '.join(f'{n} {p:.3f}' for n, p in zip(message.name, message.position))
        self._log_accepted('target_joint_states', printable(names))
        warn = self.get_logger().warning
        if not self.core.supervisor.is_running:
            condition = self.core.supervisor.condition
            why = '' if condition is None else f' ({condition.text})'
            warn(f'stopped{why}: the arm moves to the target after controller/reset')
        target = self.core.target_state
        if target.unreachable_reason:
            warn(f'out of reach: {target.unreachable_reason}')
        if target.clamped:
            warn(f'target clamped to the joint limits: {", ".join(target.clamped)}')

    def _trajectory(self, message: JointTrajectory) -> None:
        points, stamp = read_trajectory(message, self.robot.units), message.header.stamp
        begin = stamp.sec + 1e-9 * stamp.nanosec  # a stamp of 0 means: begin now
        self.core.trajectory(points, begin - self.now() if begin > 0.0 else 0.0)
        content = 'no points, so the motion ends'
        if message.points:
            end = message.points[-1].time_from_start
            content = f'{len(message.points)} points, {end.sec + 1e-9 * end.nanosec:.1f} s'
        self._log_accepted('joint_trajectory', content)
        self._warn_if_slowed()

    def _pose(self, message: PoseStamped) -> None:
        only = without_orientation(message)
        pose = read_pose(message, self.root_frame, only)
        before = self.core.target_state.unreachable_reason
        self.core.pose(pose, not only, self.now())
        x, y, z = pose.translation
        self._log_accepted('target_pose', f'position ({x:.3f}, {y:.3f}, {z:.3f}) m')
        reason = self.core.target_state.unreachable_reason
        if reason not in ('', before):
            self.get_logger().warning(f'out of reach: {reason}')
        self._warn_if_slowed()

    def _twist(self, message: TwistStamped) -> None:
        self.core.twist(read_twist(message, self.root_frame))
        self._log_accepted('target_twist', 'the hand moves at this velocity')

    def _log_accepted(self, topic: str, content: str) -> None:
        """Log an accepted request for motion; of a stream of requests, log only the first.

        `topic` is the topic of the request, and `content` says what the arm does.
        """
        arrival = self._reception.arrivals[topic]
        if not arrival.was_used or arrival.age(time.monotonic()) > STREAM_GAP:
            self.get_logger().info(f'accepted {topic}: {content}')

    def _warn_if_slowed(self) -> None:
        if slowed := controller_status.slowed(self.core.activities.follower):
            self.get_logger().warning(f'trajectory {slowed}', throttle_duration_sec=1.0)

    def _state(self) -> JointTrajectory:
        """Return the message of `controller_state`.

        It has three points: the desired state, the estimated posture, and the difference of the
        two.
        """
        progress = self.core.activities.follower.progress
        desired, names = progress.desired, ('positions', 'velocities', 'accelerations')
        outside = self.robot.units.to_position
        values = zip(names, map(outside, desired), strict=True)
        parts = {name: part.tolist() for name, part in values}
        estimated, error = outside(desired.theta - progress.error), outside(progress.error)
        points = [
            JointTrajectoryPoint(**parts),
            JointTrajectoryPoint(positions=estimated.tolist()),
            JointTrajectoryPoint(positions=error.tolist()),
        ]
        points[0].time_from_start = Duration(seconds=progress.time).to_msg()
        message = JointTrajectory(joint_names=self.robot.joints, points=points)
        message.header.stamp = self.get_clock().now().to_msg()
        return message

    def _explore(self, request: SetBool.Request) -> str:
        if reason := self.core.explore(request.data):
            raise MusculoskeletalError(reason)
        condition = self.core.supervisor.condition
        holding = 'holding' if condition is None else f'stopped: {condition.text}'
        return 'exploring' if request.data else holding

    def _stop(self, _: Trigger.Request) -> str:
        self.core.stop(ConditionKind.OPERATOR)
        self._remember_stop()
        return 'stopped; call controller/reset to continue'

    def _reset(self, _: Trigger.Request) -> str:
        present = self.core.reset(time.monotonic())
        if present is not None:
            is_anomaly = present.kind is ConditionKind.ANOMALY
            if is_anomaly and self.core.supervisor.ends_by_itself:
                raise MusculoskeletalError(
                    f'refused: {present.text}; the muscle is being verified; wait until the '
                    f'verification has ended, within {LONGEST:g} s; the arm then moves on by '
                    'itself, unless another stop cause needs a reset'
                )
            first = [step for step in present.steps if step is not Step.RESET_CONTROLLER]
            remedy = 'see the remedy of the estimator' if is_anomaly else sentence(first)
            again = f'call controller/reset again {LIMITS.settled:g} s after the cause has ended'
            raise MusculoskeletalError(f'refused: {present.text}; {remedy}; {again}')
        return 'moving to the last target, if there is one; call controller/explore to explore'

    def _step(self) -> None:
        self.overdue.reset()
        begun = time.monotonic()
        command = self.core.step(begun, self.now())
        # Publish the mode first, so that no command of a moving arm follows a mode `stopped`.
        self._publish_mode()
        if time.monotonic() - begun > PAUSE:
            # The process was suspended meanwhile, and the arm may have moved. The next step, which
            # notices the pause as well, computes a new command from the new posture.
            command = None
        if command is not None:
            value, offset = command.value, self.body.offsets.offset
            value = value + offset if command.kind == LENGTH else value
            if self.motor_commands is not None and command.kind == LENGTH:
                self.motor_commands.publish(motor_command(self.motors, value))
            message = serialize_message(array_message(value, 'muscle'))
            self.publishers_of[command.kind].publish(message)
            self.core.sent_at = time.monotonic()
            self.recording.heard(f'muscle_{command.kind}_command', message)
        if self.core.is_following:
            self.states.publish(self._state())
        if self.action is not None:
            self.action.step(self._state, self.now())
        if command is not None:
            self._remember_stop()
        self._record_stop()

    def _publish_mode(self) -> None:
        """Publish the identifiers of mode and stop cause when one of them changes."""
        supervisor = self.core.supervisor
        mode = supervisor.mode
        if supervisor.condition is not None:
            mode = f'{mode}:{supervisor.condition.identifier}'
        if mode != self.published_mode:
            self.published_mode = mode
            self.mode.publish(String(data=mode))

    def _remember_stop(self) -> None:
        """Keep a latched stop on disk, so that a restarted controller is still stopped."""
        supervisor = self.core.supervisor
        self.memory.note(supervisor.condition if supervisor.is_latched else None)

    def _record_stop(self) -> None:
        """Record the last seconds before a latched stop, once for each stop."""
        supervisor = self.core.supervisor
        if not supervisor.is_latched or supervisor.condition is None:
            self.recorded = None
        elif self.recorded is None:
            self.recorded = supervisor.condition.kind
            self.recording.save(supervisor.condition.text, self.parameter('stop_recordings'))

    def conditions(self) -> Iterable[Condition]:
        """Yield the conditions of the core, and one if a latched stop could not be saved."""
        yield from super().conditions()
        if problem := self.memory.problem:
            yield ConditionKind.STATE_NOT_SAVED.condition(problem, ['controller'])

    def status(self) -> Report:
        """Return what the controller does; log stops and joint stiffness when they change."""
        report = self.core.report(time.monotonic())
        if kept := self.recording.problem or self.recording.saved:
            report.values['last stop'] = str(kept)
        if left_out := self.recording.left_out:
            report.values['messages too large for a stop recording'] = str(left_out)
        stopped = [] if self.core.supervisor.is_running else [report.message]
        changing = self.core.is_following and self.core.activities.follower.progress.is_moving
        held = {} if changing else report.values
        stiffness = [f'{k}: {v}' for k, v in held.items() if k.startswith('joint stiff')]
        before, self.logged = self.logged, stopped + stiffness
        # Log in two loops, because rclpy refuses to log with two severities from one line of code.
        for line in stopped:
            if line not in before:
                self.get_logger().warning(line)
        for line in stiffness:
            if line not in before:
                self.get_logger().info(line)
        return report
