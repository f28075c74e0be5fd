# SPDX-License-Identifier: Apache-2.0
"""The node `sim`: simulates the learned body, driven by the same commands as the real arm.

muscle_length_command, body_state → sim/joint_states, sim/muscle_states, sim/markers. With
as_robot:=true the node replaces a healthy robot, and publishes joint_states, muscle_states,
robot_description, sim/markers.
The topic sim/external_wrench applies an external wrench, and sim/fixed_joint_states fixes joints. A
command holds until the next command; before the first command, muscles are at T_bias. The node
ignores muscle_tension_command, and its modules stay at 25 °C.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.messages.message_reading import read_target
from musculoskeletal_ae.nodes.arm_node import ArmNode, Markers
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.drawing import Line, draw_arm
from musculoskeletal_ae.ros.message_building import RELIABLE
from musculoskeletal_ae.ros.second_publishers import MOTOR_COMMAND
from musculoskeletal_ae.signals.muscle_states import MuscleReadings
from musculoskeletal_ae.simulation.equilibrium import PAID_OUT
from musculoskeletal_ae.simulation.simulation import Simulation

MOST_RATE = 100.0  # beside a robot, simulate at no higher rate [Hz], because nothing is controlled
TEMPERATURE = 25.0  # report this temperature of all modules [°C]


class SimNode(ArmNode):
    """Passes commands and wrenches to the simulation of the learned body; publishes its states."""

    def __init__(self, **options: Any) -> None:
        super().__init__('sim', **options)
        Markers(self, 'sim', self._lines)
        self.is_time_critical = self.as_robot = self.parameter('as_robot')
        prefix = '' if self.as_robot else 'sim/'
        self.advertise(prefix, joint_sensors=True, description=self.as_robot)
        self.arm: Simulation | None = None
        self.command = np.full(self.robot.muscle_count, PAID_OUT)
        self.wrench = np.zeros(6)
        self.fixed = np.full(self.robot.joint_count, np.nan)
        takes_motor_commands = self.as_robot and self.motors.command_topic
        self.needed.add(MOTOR_COMMAND if takes_motor_commands else 'muscle_length_command')
        self.follow_accepted_checkpoints(self._use_checkpoint)
        if self.as_robot:
            self.follow_length_commands(self._command)
        else:
            self.follow_muscles('muscle_length_command', self._command)
        self.follow_wrench('sim', partial(setattr, self, 'wrench'))
        # With `as_robot`, this node replaces a real arm: its sensors have no offsets, and isolation
        # does not change how it moves. Therefore it does not follow the body state.
        if not self.as_robot:
            self.follow_body(self._isolate)  # `_command` reads `body.offsets`
        self.listen(JointState, 'sim/fixed_joint_states', self._fix, RELIABLE)
        self.ticked = self.get_clock().now()
        rate = self.rate if self.as_robot else min(self.rate, MOST_RATE)
        self.create_timer(1.0 / rate, self._tick)

    def _use_checkpoint(self, mae: Mae) -> None:
        if self.arm is None:
            arm = Simulation(self.robot, mae, self.parameter('preset'))
            arm.isolate(self.body.isolated)
            arm.settle()
            self.arm = arm
        else:
            self.arm.use(mae)

    def _isolate(self) -> None:
        if self.arm is not None and self.arm.robot.isolated != self.body.isolated:
            self.arm.isolate(self.body.isolated)

    def _command(self, length: Array) -> None:
        self.command = length - self.body.offsets.offset

    def _fix(self, message: JointState) -> None:
        fixed = np.full(self.robot.joint_count, np.nan)
        if message.name or message.position or message.velocity or message.effort:
            for name, (angle, _) in read_target(message, self.robot.units).items():
                fixed[self.robot.joints.index(name)] = angle
        self.fixed = fixed

    def _tick(self) -> None:
        now = self.get_clock().now()
        elapsed = min((now - self.ticked).nanoseconds * 1e-9, self.longest_step)
        self.ticked = now
        if self.arm is None or elapsed <= 0.0:
            return
        arm = self.arm
        arm.command, arm.wrench, arm.fixed = self.command[None], self.wrench[None], self.fixed[None]
        state = arm.step(elapsed)
        temperature = np.full(self.robot.muscle_count, TEMPERATURE)
        read = arm.mae.transmission.reading(state.tension[0], state.slid[0])
        muscles = MuscleReadings(length=state.length[0], tension=read, temperature=temperature)
        self.publish_state(state.theta[0], muscles)

    def _lines(self) -> list[Line]:
        if self.arm is None:
            return []
        return draw_arm(self.robot, self.arm.state.theta[0], self.arm.state.tension[0])

    def clock_jumped_back(self) -> None:
        """Continue the simulation from the new time, with an unchanged state of the arm."""
        self.ticked = self.get_clock().now()

    def conditions(self) -> Iterable[Condition]:
        """Yield the conditions of every node, and one while there is no network."""
        yield from super().conditions()
        if self.arm is None:
            yield ConditionKind.NO_CHECKPOINT.condition(steps=[Step.PROVIDE_CHECKPOINT])

    def status(self) -> Report:
        """Return what the simulated arm does, with its values."""
        return Report('', {}) if self.arm is None else self.arm.report()
