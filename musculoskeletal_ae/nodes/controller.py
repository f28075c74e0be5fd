# SPDX-License-Identifier: Apache-2.0
"""The node `controller`: target posture → muscle length command, with a latched safe stop.

target_joint_states, estimated_joint_states, muscle_states, anomaly_detected → muscle_length_command.
"""

from __future__ import annotations

import math
import time

import numpy as np
from rcl_interfaces.msg import ParameterDescriptor
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray
from std_srvs.srv import SetBool, Trigger

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.nodes.messages import (
    QUANTITIES,
    array_message,
    read_array,
    read_joints,
    read_posture,
)
from musculoskeletal_ae.nodes.shell import (
    ERROR,
    LATCHED,
    OK,
    RELIABLE,
    SENSOR,
    STEADY,
    WARN,
    Shell,
    number,
    run,
    text,
)
from musculoskeletal_ae.tasks.posture_control import METHODS, PostureControl, Settings
from musculoskeletal_ae.tasks.safety import SafetyFilter, thermal_limit

PRESETS = ('paper', 'default')


class Controller(Shell):
    """Node shell of posture control and its safety filter."""

    def __init__(self) -> None:
        """Declare parameters, topics and services."""
        super().__init__('controller')
        self.control = PostureControl(self.robot, Settings())
        self.safety = SafetyFilter(self.robot)
        self.anomaly = False
        self.clamped = ''
        self.ticked = self.muscle_arrival = self.estimate_arrival = -math.inf
        self.length = self.tension = self.temperature = None
        self.estimate = None
        self._declare_all()
        self.publisher = self.create_publisher(Float64MultiArray, 'muscle_length_command', RELIABLE)
        self.follow_checkpoints(self.control.use)
        self.listen(Float64MultiArray, 'muscle_states', self._muscles, SENSOR)
        self.listen(JointState, 'estimated_joint_states', self._estimated, SENSOR)
        self.listen(JointState, 'target_joint_states', self._target, RELIABLE)
        self.listen(Bool, 'anomaly_detected', self._anomaly, LATCHED)
        self.create_service(SetBool, 'controller/explore', self._explore)
        self.create_service(Trigger, 'controller/stop', self._stop)
        self.create_service(Trigger, 'controller/reset', self._reset)
        # Watches ages and keeps publishing when no sensor message does it.
        self.create_timer(1.0 / self.rate, self._watch, clock=STEADY)
        if self.get_parameter('explore').value:
            self._start_exploring()

    def _declare_all(self) -> None:
        settings, safety = self.control.settings, self.safety
        self.declare_parameter('explore', False, text('explore from the start', read_only=True))
        self.declare_parameter('seed', 0, text('seed of the exploration', read_only=True))

        def one_of(name: str, legal: tuple[str, ...], meaning: str) -> None:
            def setter(value: str) -> str | None:
                if value not in legal:
                    return f'{value!r}; legal: {", ".join(legal)}'
                setattr(settings, name, value)
                return None

            described = text(f'{meaning}; one of: {", ".join(legal)}')
            self.settable(name, getattr(settings, name), described, setter)

        def of(owner: object, name: str, described: ParameterDescriptor) -> None:
            self.settable(
                name, getattr(owner, name), described, lambda value: setattr(owner, name, value)
            )

        one_of('method', METHODS, 'how a target becomes muscle lengths, from the next target on')
        one_of('preset', PRESETS, 'of the method proposed')
        of(settings, 'first_duration', number('of a movement [s]', 0.1, 60.0))
        of(settings, 'second_duration', number('of the second movement of second [s]', 0.1, 60.0))
        most = self.robot.tension.limit
        of(settings, 'constant_tension', number('T_const of first [N]; 0: T_bias', 0.0, most))
        of(safety, 'hold_time', number('a stop holds the last command so long [s]', 0.0, 60.0))
        self.settable(
            'rate_limit',
            settings.rate_limit,
            number('fastest change of a commanded length [m/s]', 0.001, 1.0),
            self._set_rate_limit,
        )
        self.max_age = 0.2
        self.settable(
            'max_age',
            self.max_age,
            number('older muscle_states or estimated_joint_states stop the arm [s]', 0.01, 10.0),
            lambda value: setattr(self, 'max_age', value),
        )
        self.temperature_limit = 85.0
        self.settable(
            'temperature_limit',
            self.temperature_limit,
            number('a module this hot pulls with T_bias only [°C]', 40.0, 200.0),
            lambda value: setattr(self, 'temperature_limit', value),
        )

    def _set_rate_limit(self, value: float) -> None:
        self.control.settings.rate_limit = self.safety.rate_limit = value

    # -- messages -------------------------------------------------------------------------------

    def _muscles(self, message: Float64MultiArray) -> None:
        rows = read_array(message, len(QUANTITIES), self.robot.muscle_count)
        self.length, self.tension, self.temperature = rows
        self.muscle_arrival = time.monotonic()

    def _estimated(self, message: JointState) -> None:
        self.estimate = read_posture(message, self.robot.joints)
        self.estimate_arrival = time.monotonic()
        # The estimate is made from the newest muscle states: now everything is fresh.
        self._tick()

    def _target(self, message: JointState) -> None:
        found = read_joints(message, self.robot.joints, foreign_allowed=False)
        kept = self.control.theta
        if kept is None:
            kept = self.estimate if self.estimate is not None else np.zeros(self.robot.joint_count)
        theta, effort = kept.copy(), self.control.effort.copy()
        for i, name in enumerate(self.robot.joints):
            if name in found:
                theta[i], effort[i] = found[name]
        inside = np.clip(theta, self.robot.lower, self.robot.upper)
        beyond = [n for n, a, b in zip(self.robot.joints, theta, inside, strict=True) if a != b]
        self.clamped = ', '.join(beyond)
        if beyond:
            self.get_logger().warning(f'target clamped to the joint limits: {self.clamped}')
        self.control.set_target(inside, effort)

    def _anomaly(self, message: Bool) -> None:
        self.anomaly = message.data

    # -- services -------------------------------------------------------------------------------

    def _explore(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success = True
        if not request.data:
            self.control.explore(None)
            response.message = 'holding'
        elif self.safety.cause:
            response.success, response.message = False, f'stopped: {self.safety.cause}'
        else:
            response.success = self._start_exploring()
            response.message = 'exploring' if response.success else 'no posture can be held'
        return response

    def _start_exploring(self) -> bool:
        self.control.explore(self.get_parameter('seed').value)
        return True

    def _stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._stop_for('controller/stop was called')
        response.success, response.message = True, 'stopped'
        return response

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        cause = self._present_cause()
        if cause:
            response.success, response.message = False, f'refused: {cause}'
            return response
        response.success, response.message = True, 'ready'
        if self.safety.cause:
            self.safety.reset()
            self.control.hold()
        return response

    # -- the loop -------------------------------------------------------------------------------

    def _present_cause(self) -> str:
        """Return why the arm must not move now, or ''."""
        now = time.monotonic()
        if self.mae is None:
            return 'no checkpoint'
        if self.anomaly:
            return 'anomaly_detected; call estimator/reset when it is mended'
        for what, arrival in (
            ('muscle_states', self.muscle_arrival),
            ('estimated_joint_states', self.estimate_arrival),
        ):
            if now - arrival > self.max_age:
                return f'{what} older than {self.max_age:g} s'
        return ''

    def _stop_for(self, cause: str) -> None:
        if not self.safety.cause:
            self.get_logger().warning(f'stopped: {cause}')
        self.control.explore(None)
        self.safety.stop(cause)

    def _watch(self) -> None:
        # Before the first command there is nothing to stop.
        cause = self._present_cause()
        if cause and self.safety.command is not None:
            self._stop_for(cause)
        if time.monotonic() - self.ticked > 1.5 / self.rate:
            self._tick()

    def _tick(self) -> None:
        now = time.monotonic()
        dt, self.ticked = min(now - self.ticked, 0.1), now
        if self.length is None:
            return
        limit = thermal_limit(self.robot, self.temperature, self.temperature_limit)
        wished = None
        if not self.safety.cause and not self._present_cause():
            if self.safety.command is None:
                # MSC at the present length pulls with T_bias only: the gentlest start.
                self.control.start_from(self.length)
            try:
                planned = np.minimum(limit, self.robot.tension.limit)
                wished = self.control.step(self.tension, planned, dt)
            except MusculoskeletalError as error:
                self._stop_for(str(error))
        command = self.safety.step(wished, self.length, limit, dt)
        if command is not None:
            self.publisher.publish(array_message(command, 'muscle'))

    def state(self) -> tuple[bytes, str, dict[str, str]]:
        """Return what /diagnostics shows."""
        values = {'method': self.control.settings.method}
        if self.clamped:
            values['target clamped at'] = self.clamped
        if self.temperature is not None:
            limit = thermal_limit(self.robot, self.temperature, self.temperature_limit)
            hot = limit < self.robot.tension.max
            names = [n for n, h in zip(self.robot.muscles, hot, strict=True) if h]
            if names:
                values['tension limited by heat'] = ', '.join(names)
        if self.safety.cause:
            return ERROR, f'stopped: {self.safety.cause}', values
        if self.control.exploring:
            return OK, 'exploring', values
        if np.abs(self.control.missing_torque).max() > 0.0:
            return WARN, 'the target needs more torque than the muscles have', values
        return OK, 'holding' if self.control.theta is not None else 'no target', values


def main() -> None:
    """Run the node."""
    run(Controller)
