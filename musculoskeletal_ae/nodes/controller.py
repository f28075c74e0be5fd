# SPDX-License-Identifier: Apache-2.0
"""The node `controller`: target posture → muscle commands, with a latched safe stop.

target_joint_states, estimated_joint_states, muscle_states, anomaly_detected →
muscle_length_command, or muscle_tension_command with method `tension`.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import Any

from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray
from std_srvs.srv import SetBool, Trigger

from musculoskeletal_ae.control.controller import Controller as Core
from musculoskeletal_ae.control.safety import LENGTH, TENSION, Muscles
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.nodes.messages import array_message
from musculoskeletal_ae.nodes.qos import LATCHED, RELIABLE, SENSOR
from musculoskeletal_ae.nodes.shell import STEADY, Shell
from musculoskeletal_ae.parameters import parameters_of
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.validity import QUANTITIES, read_array, read_joints, read_posture

LOOK_AROUND = 0.1  # [s] between looks at who publishes
RESUMED = 'going on to the last target, if any; controller/explore explores again'


class Controller(Shell):
    """Node shell of control."""

    def __init__(self, **options: Any) -> None:
        """Declare topics and services; options are those of Node."""
        super().__init__('controller', **options)
        self.core = Core(self.robot, seed=self.parameter('seed'))
        for name in parameters_of(Settings):
            self.follow_parameter(name, partial(self._configure, name))
        self.logged: list[str] = []
        self.publishers_of = {
            LENGTH: self.create_publisher(Float64MultiArray, 'muscle_length_command', RELIABLE),
            TENSION: self.create_publisher(Float64MultiArray, 'muscle_tension_command', RELIABLE),
        }
        self.follow_checkpoints(
            self.core.use, lambda why: self.core.stop(f'unfit checkpoint: {why}')
        )
        self.listen(Float64MultiArray, 'muscle_states', self._muscles, SENSOR)
        self.listen(JointState, 'estimated_joint_states', self._estimated, SENSOR)
        self.listen(JointState, 'target_joint_states', self._target, RELIABLE)
        self.listen(Bool, 'anomaly_detected', self._anomaly, LATCHED)
        self.create_service(SetBool, 'controller/explore', self._explore)
        self.create_service(Trigger, 'controller/stop', self._stop)
        self.create_service(Trigger, 'controller/reset', self._reset)
        # Watches ages and keeps publishing when no sensor message does it.
        self.create_timer(1.0 / self.rate, self._watch, clock=STEADY)
        self.create_timer(LOOK_AROUND, self._look_around, clock=STEADY)
        if self.parameter('explore'):
            self.core.explore(True)

    def _configure(self, name: str, value: Any) -> None:
        self.core.configure(replace(self.core.settings, **{name: value}))

    def _muscles(self, message: Float64MultiArray) -> None:
        now, count = time.monotonic(), self.robot.muscle_count
        muscles = Muscles(*read_array(message, len(QUANTITIES), count))
        self.core.muscles(muscles, now)
        self.gate.message(muscles.tension, muscles.length, now)

    def _estimated(self, message: JointState) -> None:
        self.core.estimated(read_posture(message, self.robot.joints), time.monotonic())
        # The estimate is made from the newest muscle states: now everything is fresh.
        self._step()

    def _anomaly(self, message: Bool) -> None:
        self.core.anomaly(message.data)
        self.take_anomaly(message.data)

    def _target(self, message: JointState) -> None:
        self.core.target(read_joints(message, self.robot.joints, foreign_allowed=False))
        if self.core.safety.cause:
            self.get_logger().warning(
                f'stopped ({self.core.safety.cause}): the target waits for controller/reset'
            )
        if self.core.clamped:
            clamped = ', '.join(self.core.clamped)
            self.get_logger().warning(f'target clamped to the joint limits: {clamped}')

    def _explore(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        reason = self.core.explore(request.data)
        response.success = not reason
        stopped = self.core.safety.cause
        holding = f'stopped: {stopped}' if stopped else 'holding'
        response.message = reason or ('exploring' if request.data else holding)
        return response

    def _stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.core.stop('controller/stop was called')
        response.success, response.message = True, 'stopped; controller/reset ends it'
        return response

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        reason = self.core.reset(time.monotonic())
        response.success = not reason
        response.message = f'refused: {reason}' if reason else RESUMED
        return response

    def _look_around(self) -> None:
        """Let nobody else say how the muscles are."""
        topic = self.resolve_topic_name('muscle_states')
        if self.count_publishers(topic) <= 1:
            self.core.intruder = ''
            return
        names = sorted(
            f'{publisher.node_namespace.rstrip("/")}/{publisher.node_name}'
            for publisher in self.get_publishers_info_by_topic(topic)
        )
        # One name twice: a node that was killed stays known for a while beside its successor.
        several = len(set(names)) > 1
        self.core.intruder = f'muscle_states come from {" and ".join(names)}' if several else ''

    def _watch(self) -> None:
        if time.monotonic() - self.core.stepped_at > 1.5 / self.rate:
            self._step()

    def _step(self) -> None:
        command = self.core.step(time.monotonic(), self.get_clock().now().nanoseconds * 1e-9)
        if command is not None:
            self.publishers_of[command.kind].publish(array_message(command.value, 'muscle'))

    def clock_jumped_back(self) -> None:
        """Count time from here; latches stay."""
        self.core.clock_jumped_back()

    def report(self) -> Report:
        """Return what /diagnostics shows, and log what has changed."""
        report = self.core.report(time.monotonic())
        stopped = [report.message] if self.core.safety.cause else []
        stiffness = [f'{k}: {v}' for k, v in report.values.items() if k.startswith('joint stiff')]
        for line in stopped + stiffness:
            if line not in self.logged:
                log = self.get_logger().warning if line in stopped else self.get_logger().info
                log(line)
        self.logged = stopped + stiffness
        return report
