# SPDX-License-Identifier: Apache-2.0
"""The node `controller`: target posture → muscle commands, with a latched safe stop.

target_joint_states, estimated_joint_states, muscle_states, anomaly_detected →
muscle_length_command, or muscle_tension_command with method `tension`.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import Field, fields
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray
from std_srvs.srv import SetBool, Trigger

from musculoskeletal_ae.control.controller import Controller as Core
from musculoskeletal_ae.control.report import control_report, stiffness_values
from musculoskeletal_ae.control.safety import LENGTH, TENSION, Muscles
from musculoskeletal_ae.control.settings import Settings, read_stiffness
from musculoskeletal_ae.control.stiffness import StiffnessSolution
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.nodes.messages import array_message
from musculoskeletal_ae.nodes.parameters import number, text, whole
from musculoskeletal_ae.nodes.qos import LATCHED, RELIABLE, SENSOR
from musculoskeletal_ae.nodes.running import run
from musculoskeletal_ae.nodes.shell import ERROR, OK, STEADY, WARN, Shell
from musculoskeletal_ae.validity import QUANTITIES, read_array, read_joints, read_posture

RESUMED = 'going on to the last target, if any; controller/explore explores again'
LEVELS = {'ok': OK, 'warn': WARN, 'error': ERROR}


class Controller(Shell):
    """Node shell of control."""

    def __init__(self) -> None:
        """Declare parameters, topics and services."""
        super().__init__('controller')
        self.declare_parameter('explore', False, text('explore from the start', read_only=True))
        self.declare_parameter('seed', 0, whole('seed of the exploration'))
        self.settings = Settings()
        self.core = Core(self.robot, self.settings, self.get_parameter('seed').value)
        self._declare_settings()
        self.cause = ''
        self.stiffness: StiffnessSolution | None = None
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
        self.listen(Bool, 'anomaly_detected', lambda m: self.core.anomaly(m.data), LATCHED)
        self.create_service(SetBool, 'controller/explore', self._explore)
        self.create_service(Trigger, 'controller/stop', self._stop)
        self.create_service(Trigger, 'controller/reset', self._reset)
        # Watches ages and keeps publishing when no sensor message does it.
        self.create_timer(1.0 / self.rate, self._watch, clock=STEADY)
        if self.get_parameter('explore').value:
            self.core.explore(True)

    def _declare_settings(self) -> None:
        for setting in fields(Settings):
            if setting.metadata:
                self._declare_setting(setting)
        self.settable(
            'joint_stiffness',
            [0.0],
            ParameterDescriptor(
                description='wished joint stiffness [N·m/rad], one per joint; 0 or []: as it comes',
                dynamic_typing=True,  # `[]` is an array of bytes to rclpy
            ),
            self._set_stiffness,
        )

    def _declare_setting(self, setting: Field[Any]) -> None:
        name, told = setting.name, setting.metadata
        legal = told.get('legal')
        if legal is None:
            descriptor = number(told['meaning'], *told['range'])
        else:
            descriptor = text(f'{told["meaning"]}; one of: {", ".join(legal)}')

        def setter(value: Any) -> None:
            if legal is not None and value not in legal:
                raise MusculoskeletalError(f'{value!r}; legal: {", ".join(legal)}')
            setattr(self.settings, name, value)

        self.settable(name, setting.default, descriptor, setter)

    def _set_stiffness(self, wished: Iterable[Any]) -> None:
        self.settings.joint_stiffness = read_stiffness(wished, self.robot.joint_count)
        self.core.posture.start()

    def _muscles(self, message: Float64MultiArray) -> None:
        rows = read_array(message, len(QUANTITIES), self.robot.muscle_count)
        self.core.muscles(Muscles(*rows), time.monotonic())

    def _estimated(self, message: JointState) -> None:
        self.core.estimated(read_posture(message, self.robot.joints), time.monotonic())
        # The estimate is made from the newest muscle states: now everything is fresh.
        self._step()

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

    def _watch(self) -> None:
        if time.monotonic() - self.core.stepped_at > 1.5 / self.rate:
            self._step()

    def _step(self) -> None:
        command = self.core.step(time.monotonic())
        if command is not None:
            self.publishers_of[command.kind].publish(array_message(command.value, 'muscle'))

    def state(self) -> tuple[bytes, str, dict[str, str]]:
        """Return what /diagnostics shows, and log what has changed."""
        report = control_report(self.robot, self.core, time.monotonic())
        cause, found = self.core.safety.cause, self.core.posture.stiffness
        if cause and cause != self.cause:
            self.get_logger().warning(f'stopped: {cause}')
        if found is not None and found is not self.stiffness:
            for what, said in stiffness_values(self.robot, self.settings, found).items():
                self.get_logger().info(f'{what}: {said}')
        self.cause, self.stiffness = cause, found
        return LEVELS[report.level], report.message, report.values


def main() -> None:
    """Run the node."""
    run(Controller)
