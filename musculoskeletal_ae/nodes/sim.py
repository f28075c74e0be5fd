# SPDX-License-Identifier: Apache-2.0
"""The node `sim`: the learnt body as an arm that follows the same command as the real one.

muscle_length_command → sim/joint_states, sim/muscle_states, sim/markers; with as_robot:=true it
takes the robot's place: joint_states, muscle_states, robot_description, sim/markers. Pushed by
sim/external_wrench, held by sim/fixed_joint_states. A command holds until the next one; before
the first, muscles are at T_bias. muscle_tension_command is not followed, and modules stay at 25 °C.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from visualization_msgs.msg import MarkerArray

from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.messages import array_message, read_array, read_joints, read_wrench
from musculoskeletal_ae.nodes.markers import arm_markers
from musculoskeletal_ae.nodes.qos import LATCHED, RELIABLE
from musculoskeletal_ae.nodes.shell import OK, WARN, Shell
from musculoskeletal_ae.robot.drawing import draw_arm
from musculoskeletal_ae.simulation.simulation import Simulation

MARKER_RATE = 10.0  # [Hz] of the markers for RViz
TEMPERATURE = 25.0  # [°C]
# After a pause (a debugger, a jump of /clock) the arm goes on instead of catching up.
LONGEST_STEP = 0.1  # [s]


class Sim(Shell):
    """Node shell of the simulation."""

    def __init__(self, **options: Any) -> None:
        """Declare topics; options are those of Node."""
        super().__init__('sim', **options)
        self.preset: str = self.parameter('preset')
        as_robot = self.parameter('as_robot')
        prefix = '' if as_robot else 'sim/'
        self.arm: Simulation | None = None
        self.command: np.ndarray | None = None
        self.wrench = np.zeros(6)
        self.fixed = np.full(self.robot.joint_count, np.nan)
        self.joint_publisher = self.create_publisher(JointState, prefix + 'joint_states', RELIABLE)
        self.muscle_publisher = self.create_publisher(
            Float64MultiArray, prefix + 'muscle_states', RELIABLE
        )
        self.marker_publisher = self.create_publisher(MarkerArray, 'sim/markers', RELIABLE)
        if as_robot:
            description = self.create_publisher(String, 'robot_description', LATCHED)
            description.publish(String(data=self.robot.description.urdf))
        self.follow_checkpoints(self._use)
        self.listen(Float64MultiArray, 'muscle_length_command', self._follow, RELIABLE)
        self.listen(WrenchStamped, 'sim/external_wrench', self._push, RELIABLE)
        self.listen(JointState, 'sim/fixed_joint_states', self._fix, RELIABLE)
        self.ticked = self.get_clock().now()
        self.create_timer(1.0 / self.rate, self._tick)
        self.create_timer(1.0 / MARKER_RATE, self._publish_markers)

    # -- messages -------------------------------------------------------------------------------

    def _use(self, mae: Mae) -> None:
        if self.arm is None:
            arm = Simulation(self.robot, mae, self.preset)
            arm.settle()
            self.arm = arm
        else:
            self.arm.use(mae)

    def _follow(self, message: Float64MultiArray) -> None:
        self.command = read_array(message, 1, self.robot.muscle_count)

    def _push(self, message: WrenchStamped) -> None:
        self.wrench = read_wrench(message, self.robot.root_link)

    def _fix(self, message: JointState) -> None:
        fixed = np.full(self.robot.joint_count, np.nan)
        if message.name or message.position:
            joints = self.robot.joints
            for name, (angle, _) in read_joints(message, joints, foreign_allowed=False).items():
                fixed[joints.index(name)] = angle
        self.fixed = fixed

    # -- time -----------------------------------------------------------------------------------

    def _tick(self) -> None:
        now = self.get_clock().now()
        elapsed = min((now - self.ticked).nanoseconds * 1e-9, LONGEST_STEP)
        self.ticked = now
        if self.arm is None or elapsed <= 0.0:
            return
        if self.command is not None:
            self.arm.command = self.command[None]
        self.arm.wrench, self.arm.fixed = self.wrench[None], self.fixed[None]
        state = self.arm.step(elapsed)
        joints = JointState(name=self.robot.joints, position=state.theta[0].tolist())
        joints.header.stamp = now.to_msg()
        self.joint_publisher.publish(joints)
        temperature = np.full(self.robot.muscle_count, TEMPERATURE)
        rows = np.stack([state.length[0], state.tension[0], temperature])
        self.muscle_publisher.publish(array_message(rows, 'quantity', 'muscle'))

    def _publish_markers(self) -> None:
        if self.arm is None or self.marker_publisher.get_subscription_count() == 0:
            return
        drawing = draw_arm(self.robot, self.arm.state.theta[0], self.arm.state.tension[0])
        stamp = self.get_clock().now().to_msg()
        self.marker_publisher.publish(arm_markers(drawing, self.robot.root_link, stamp))

    def clock_jumped_back(self) -> None:
        """Count time from here; the arm stays as it is."""
        self.ticked = self.get_clock().now()

    def state(self) -> tuple[bytes, str, dict[str, str]]:
        """Return what /diagnostics shows."""
        if self.arm is None or self.mae is None:
            return WARN, 'waiting for a checkpoint', {}
        values = {'checkpoint version': str(self.mae.version)}
        held = [self.robot.joints[i] for i in np.flatnonzero(np.isfinite(self.fixed))]
        if held:
            values['forced joints'] = ', '.join(held)
        if self.wrench.any():
            values['external wrench'] = f'{np.round(self.wrench, 3).tolist()} N, N·m'
        limits = self.arm.limits()
        if limits:
            return WARN, f'at the limit: {", ".join(limits)}', values
        return OK, 'resting at T_bias' if self.command is None else 'following commands', values
