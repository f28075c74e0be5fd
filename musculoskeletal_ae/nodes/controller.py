# SPDX-License-Identifier: Apache-2.0
"""The node `controller`: target posture → muscle commands, with a latched safe stop.

target_joint_states, joint_trajectory, target_pose, target_twist, estimated_joint_states,
muscle_states, anomaly_detected, isolated_muscles → muscle_length_command, or muscle_tension_command
with method `tension`; controller_state. Action follow_joint_trajectory, where control_msgs is
installed.
"""

import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any

from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.duration import Duration
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control import status
from musculoskeletal_ae.control.controller import Controller as Core
from musculoskeletal_ae.control.safety import LENGTH, TENSION, Muscles
from musculoskeletal_ae.control.settings import BY_TENSION, METHODS, Settings
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.nodes.messages import RELIABLE, array_message, serve
from musculoskeletal_ae.nodes.shell import STEADY, Shell
from musculoskeletal_ae.nodes.stop_recording import StopRecording
from musculoskeletal_ae.parameters import parameters_of
from musculoskeletal_ae.plausibility import SETTLED
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.validity import (
    read_pose,
    read_target,
    read_trajectory,
    read_twist,
    without_orientation,
)


class Controller(Shell):
    """Node shell of control."""

    def __init__(self, **options: Any) -> None:
        super().__init__('controller', **options)
        self.core = Core(self.robot, seed=self.parameter('seed'))
        self.recording: StopRecording = StopRecording(self.resolve_topic_name)
        self.latched = False  # the stop, as of the last step
        self.logged: list[str] = []
        self.publishers_of = {
            kind: self.create_publisher(Float64MultiArray, f'muscle_{kind}_command', RELIABLE)
            for kind in (LENGTH, TENSION)
        }
        checks = {'joint_stiffness': self._check_stiffness, 'method': self._check_method}
        for name in parameters_of(Settings):
            self.follow_parameter(name, partial(self._configure, name), checks.get(name))
        self.follow_accepted_checkpoints(
            self.core.use, lambda why: self.core.stop(f'unfit checkpoint: {why}')
        )
        self.needed += ['muscle_states', 'estimated_joint_states']
        self.follow_zeros(self._shift)
        self.follow_muscle_states(self._muscles, partial(setattr, self.core.watch, 'intruder'))
        self.follow_posture('estimated_joint_states', self._estimated)
        self.listen(JointState, 'target_joint_states', self._target, RELIABLE)
        self.listen(JointTrajectory, 'joint_trajectory', self._trajectory, RELIABLE)
        self.listen(PoseStamped, 'target_pose', self._pose, RELIABLE)
        self.listen(TwistStamped, 'target_twist', self._twist, RELIABLE)
        self.states = self.create_publisher(JointTrajectory, 'controller_state', RELIABLE)
        self.action: Any = None
        with suppress(ImportError):  # control_msgs
            kind = import_module('control_msgs.action').FollowJointTrajectory
            module = import_module('musculoskeletal_ae.nodes.follow_joint_trajectory')
            refuse = self._reception.reject
            self.action = module.FollowJointTrajectory(
                self, kind, self.core, self._trajectory, refuse
            )
        self.follow_anomaly(self._anomaly)
        self.follow_isolated(self._isolate)
        serve(self, SetBool, 'controller/explore', self._explore)
        serve(self, Trigger, 'controller/stop', self._stop)
        serve(self, Trigger, 'controller/reset', self._reset)
        # Watches ages and keeps publishing when no sensor message does it.
        self.create_timer(1.0 / self.rate, self._watch, clock=STEADY)
        if self.parameter('explore'):
            self.core.explore(True)

    def destroy_node(self) -> None:
        """Let a recording be finished."""
        self.recording.close()
        super().destroy_node()

    def _configure(self, name: str, value: Any) -> None:
        self.core.configure(replace(self.core.settings, **{name: value}))

    def _check_stiffness(self, value: Any) -> Any:
        # Before any other that is set with it: what those end would not come back.
        checked = replace(self.core.settings, joint_stiffness=value)
        checked.desired_stiffness(self.robot.kinematics.radian)
        return value

    def _check_method(self, value: Any) -> Any:
        followed = {
            kind: publisher.get_subscription_count()
            for kind, publisher in self.publishers_of.items()
        }
        if value in BY_TENSION and followed[LENGTH] and not followed[TENSION]:
            # It would let the arm go, as if no commands came.
            legal = ', '.join(method for method in METHODS if method not in BY_TENSION)
            told = f'{value!r}: the driver follows muscle_length_command only; legal: {legal}'
            raise MusculoskeletalError(f'{told}; or let it follow muscle_tension_command, too')
        return value

    def _shift(self, known: bool, less: Array) -> None:
        self.core.zeros(known, less)

    def _isolate(self, muscles: tuple[int, ...]) -> None:
        self.core.isolate(muscles)

    def _muscles(self, states: Array) -> None:
        self.core.muscles(Muscles(*states), time.monotonic())

    def _anomaly(self, detected: bool) -> None:
        self.core.anomaly(detected)

    def _estimated(self, theta: Array) -> None:
        self.core.estimated(theta, time.monotonic())
        # The estimate is made from the newest muscle states: now everything is fresh.
        self._step()

    def _target(self, message: JointState) -> None:
        self.core.target(read_target(message, self.robot.joints))
        warn = self.get_logger().warning
        if cause := self.core.safety.cause:
            warn(f'stopped ({cause}): the target waits for controller/reset')
        if short := self.core.short:
            warn(f'out of reach: {short}')
        if clamped := ', '.join(self.core.clamped):
            warn(f'target clamped to the joint limits: {clamped}')

    def _trajectory(self, message: JointTrajectory) -> None:
        points, stamp = read_trajectory(message, self.robot.joints), message.header.stamp
        begin = stamp.sec + 1e-9 * stamp.nanosec  # 0: now
        self.core.trajectory(points, begin - self.now() if begin > 0.0 else 0.0)
        self._tell_slowed()

    def _pose(self, message: PoseStamped) -> None:
        only = without_orientation(message)
        pose = read_pose(message, self.root_frame, only)
        before = self.core.short
        self.core.pose(pose, not only, self.now())
        if self.core.short not in ('', before):
            self.get_logger().warning(f'out of reach: {self.core.short}')
        self._tell_slowed()

    def _twist(self, message: TwistStamped) -> None:
        self.core.twist(read_twist(message, self.root_frame))

    def _tell_slowed(self) -> None:
        if slowed := status.slowed(self.core.motion):
            self.get_logger().warning(f'trajectory {slowed}', throttle_duration_sec=1.0)

    def _state(self) -> JointTrajectory:
        """Say what is desired, what is estimated, and the error, as three points."""
        motion = self.core.motion
        desired, names = motion.desired, ('positions', 'velocities', 'accelerations')
        parts = {name: part.tolist() for name, part in zip(names, desired, strict=True)}
        estimated = desired.theta - motion.error
        points = [
            JointTrajectoryPoint(**parts),
            JointTrajectoryPoint(positions=estimated.tolist()),
            JointTrajectoryPoint(positions=motion.error.tolist()),
        ]
        points[0].time_from_start = Duration(seconds=motion.time).to_msg()
        message = JointTrajectory(joint_names=self.robot.joints, points=points)
        message.header.stamp = self.get_clock().now().to_msg()
        return message

    def _explore(self, request: SetBool.Request) -> str:
        if reason := self.core.explore(request.data):
            raise MusculoskeletalError(reason)
        stopped = self.core.safety.cause
        holding = f'stopped: {stopped}' if stopped else 'holding'
        return 'exploring' if request.data else holding

    def _stop(self, _: Trigger.Request) -> str:
        self.core.stop('controller/stop was called')
        return 'stopped; controller/reset ends it'

    def _reset(self, _: Trigger.Request) -> str:
        if reason := self.core.reset(time.monotonic()):
            again = f'call again once that is over, {SETTLED:g} s after it is mended'
            raise MusculoskeletalError(f'refused: {reason}; {again}')
        return 'going on to the last target, if any; controller/explore explores again'

    def _watch(self) -> None:
        if time.monotonic() - self.core.watch.stepped_at > 1.5 / self.rate:
            self._step()

    def _step(self) -> None:
        command = self.core.step(time.monotonic(), self.now())
        if command is not None:
            value = command.value + self.zeros.offset if command.kind == LENGTH else command.value
            message = serialize_message(array_message(value, 'muscle'))
            self.publishers_of[command.kind].publish(message)
            self.core.sent_at = time.monotonic()
            self.recording.heard(f'muscle_{command.kind}_command', message)
        if self.core.follows:
            self.states.publish(self._state())
        if self.action is not None:
            self.action.step(self._state)
        safety, before = self.core.safety, self.latched
        self.latched = bool(safety.cause) and not safety.passing
        if self.latched and not before:
            self.recording.save(safety.cause, self.parameter('stop_recordings'))

    def report(self) -> Report:
        """Return what /diagnostics shows, and log what has changed."""
        report = status.report(self.core, time.monotonic())
        if kept := self.recording.problem or self.recording.saved:
            report.values['last stop'] = str(kept)
        stopped = [report.message] if self.core.safety.cause else []
        changing = self.core.follows and self.core.motion.moving
        held = {} if changing else report.values
        stiffness = [f'{k}: {v}' for k, v in held.items() if k.startswith('joint stiff')]
        before, self.logged = self.logged, stopped + stiffness
        # In two places: rclpy lets no line of code log with two severities.
        for line in stopped:
            if line not in before:
                self.get_logger().warning(line)
        for line in stiffness:
            if line not in before:
                self.get_logger().info(line)
        return report
