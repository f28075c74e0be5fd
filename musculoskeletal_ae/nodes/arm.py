# SPDX-License-Identifier: Apache-2.0
"""An arm on the graph, simulated or emulated: its states, its description, its markers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.nodes.markers import Markers
from musculoskeletal_ae.nodes.messages import LATCHED, RELIABLE, array_message, joint_message
from musculoskeletal_ae.nodes.shell import Shell
from musculoskeletal_ae.robot.drawing import Line
from musculoskeletal_ae.validity import read_wrench

# After a pause (a debugger, a jump of /clock) an arm goes on instead of catching up.
LONGEST_STEP = 0.1  # [s]


class Arm(Shell):
    """A node that stands for an arm."""

    def __init__(self, name: str, **options: Any) -> None:
        """Advertise NAME/markers; options are those of Node."""
        super().__init__(name, **options)
        self._arm = name
        Markers(self, name, self.lines)

    def follow_wrench(self, follow: Callable[[Array], object]) -> None:
        """Give `follow` what comes on NAME/external_wrench, (6,) [N, N·m] in root link axes."""
        topic, frame = f'{self._arm}/external_wrench', self.root_frame
        self.listen(WrenchStamped, topic, lambda m: follow(read_wrench(m, frame)), RELIABLE)

    def advertise(self, prefix: str, joint_sensors: bool, description: bool) -> None:
        """Advertise the states below a prefix; the description is the robot's own to publish."""
        self._joints = None
        if joint_sensors:
            self._joints = self.create_publisher(JointState, f'{prefix}joint_states', RELIABLE)
        self._muscles = self.create_publisher(Float64MultiArray, f'{prefix}muscle_states', RELIABLE)
        if description:
            publisher = self.create_publisher(String, 'robot_description', LATCHED)
            publisher.publish(String(data=self.robot.description.urdf))

    def publish_state(
        self, theta: Array, length: Array, tension: Array, temperature: Array
    ) -> None:
        """Publish θ [rad] (D,), l [m], T [N] and temperatures [°C] (M,), as of now."""
        if self._joints is not None:
            stamp = self.get_clock().now().to_msg()
            self._joints.publish(joint_message(self.robot.joints, theta, stamp))
        rows = np.stack([length, tension, temperature])
        self._muscles.publish(array_message(rows, 'quantity', 'muscle'))

    def lines(self) -> list[Line]:
        """Return the arm as lines; none where there is nothing to draw yet."""
        raise NotImplementedError
