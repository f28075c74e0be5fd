# SPDX-License-Identifier: Apache-2.0
"""Publishers of states and markers for emulated, simulated and estimated arms.

Markers show bones, muscles and names in RViz and Foxglove. The bones of the hardware are ivory and
opaque, the bones of the estimate green, and the bones of the simulator violet.
"""

from collections.abc import Callable

from geometry_msgs.msg import Point, WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import ColorRGBA, Float64MultiArray, String
from visualization_msgs.msg import Marker, MarkerArray

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.messages.arrival import LONGEST_STEP
from musculoskeletal_ae.messages.message_reading import read_wrench
from musculoskeletal_ae.nodes.shell import Shell
from musculoskeletal_ae.robot.drawing import BONE_COLOUR, Line
from musculoskeletal_ae.ros.message_building import (
    LATCHED,
    RELIABLE,
    add_joints,
    array_message,
    is_heard,
    motor_message,
    posture_message,
)
from musculoskeletal_ae.ros.second_publishers import COMMANDS, MOTOR_COMMAND
from musculoskeletal_ae.signals.motor_interface import STATES
from musculoskeletal_ae.signals.muscle_states import MuscleReadings

MARKER_RATE = 10.0  # publish markers at this rate [Hz]
NAME_HEIGHT = 0.018  # height of the letters with which the muscles' names are drawn [m]
#: colour of the bones of these arms: red, green, blue and opacity
BONE_COLOURS = {'estimated': (0.0, 0.62, 0.45, 0.5), 'sim': (0.58, 0.40, 0.74, 0.5)}
HARDWARE_COLOUR = (*BONE_COLOUR, 1.0)  # colour of the bones of all arms not in BONE_COLOURS
# After a pause (a debugger, a jump of /clock) the arm continues without simulating the missed time.
# Therefore one step covers at most LONGEST_STEP or MOST_PERIODS periods, whichever is longer.
MOST_PERIODS = 2.0


class Markers:
    """Publishes ARM/markers while the topic has a subscriber."""

    def __init__(self, node: Shell, arm: str, lines: Callable[[], list[Line]]) -> None:
        """Publish the markers of `arm` with the lines that `lines` returns, if it returns any."""
        self._node, self._lines = node, lines
        self._bones = BONE_COLOURS.get(arm, HARDWARE_COLOUR)
        self._publisher = node.create_publisher(MarkerArray, f'{arm}/markers', RELIABLE)
        node.create_timer(1.0 / MARKER_RATE, self._publish)

    def _publish(self) -> None:
        if not is_heard(self._publisher) or not (lines := self._lines()):
            return
        message = MarkerArray()
        for number, line in enumerate(lines):
            marker = self._add(message, line.kind, number, Marker.LINE_STRIP)
            marker.scale.x = line.width
            look = self._bones if line.kind == 'bones' else (*line.colour, self._bones[3])
            marker.color = ColorRGBA(**dict(zip('rgba', look)))
            marker.points = [Point(x=x, y=y, z=z) for x, y, z in line.points.tolist()]
            if line.name:
                name = self._add(message, 'names', number, Marker.TEXT_VIEW_FACING)
                name.text, name.scale.z, name.color = line.name, NAME_HEIGHT, marker.color
                name.pose.position = Point(**dict(zip('xyz', line.points.mean(axis=0).tolist())))
        self._publisher.publish(message)

    def _add(self, message: MarkerArray, kind: str, number: int, shape: int) -> Marker:
        marker = Marker(ns=kind, id=number, type=shape)
        marker.header.frame_id = self._node.root_frame
        marker.header.stamp = self._node.get_clock().now().to_msg()
        marker.pose.orientation.w = 1.0
        message.markers.append(marker)
        return marker


class ArmNode(Shell):
    """Base class of nodes that replace a real arm: they obey commands and publish the arm's state.

    All other nodes reject the messages of a topic that several nodes publish. These nodes obey
    commands even then, as real muscle modules would.
    """

    accepted_from_all = COMMANDS

    @property
    def longest_step(self) -> float:
        """Longest time that one step may cover [s]."""
        return max(LONGEST_STEP, MOST_PERIODS / self.rate)

    def follow_wrench(self, arm: str, follow: Callable[[Array], object]) -> None:
        """Call `follow` with each wrench from ARM/external_wrench.

        A wrench has the shape (6,): force [N] and torque [N·m] in the axes of the root link.
        """
        topic, frame = f'{arm}/external_wrench', self.root_frame
        self.listen(WrenchStamped, topic, lambda m: follow(read_wrench(m, frame)), RELIABLE)

    def follow_length_commands(self, follow: Callable[[Array], object]) -> None:
        """Call `follow` with each received length command l_target [m], (M,).

        On a ros2_control robot, the length commands are computed from the commands to the motors.
        """
        if not self.motors.command_topic:
            self.follow_muscles('muscle_length_command', follow)
            return
        take = self.motors.take_command(follow)
        self.listen(Float64MultiArray, MOTOR_COMMAND, take, RELIABLE)

    def advertise(self, prefix: str, joint_sensors: bool, description: bool) -> None:
        """Advertise the topics of the arm's state.

        Args:
            prefix: Prefix of the topic names, such as `sim/`. Motors of a ros2_control robot are
                published instead of `muscle_states` only if the prefix is empty.
            joint_sensors: Whether to publish `joint_states`.
            description: Whether to publish `robot_description`.
        """
        self._joints = None
        self.sources.watch(f'{prefix}joint_states', f'{prefix}muscle_states')
        if joint_sensors:
            self._joints = self.create_publisher(JointState, f'{prefix}joint_states', RELIABLE)
        # Motors and joints may share a topic, for example if joint_state_broadcaster is used.
        self._motors = self._muscles = None
        if not prefix and self.motors.is_ros2_control:
            topic = self.motors.state_topic
            shares = self._joints is not None and self._joints.topic_name == self.full_name(STATES)
            self._motors = (
                self._joints if shares else self.create_publisher(JointState, topic, RELIABLE)
            )
        else:
            topic = f'{prefix}muscle_states'
            self._muscles = self.create_publisher(Float64MultiArray, topic, RELIABLE)
        if description:
            publisher = self.create_publisher(String, 'robot_description', LATCHED)
            publisher.publish(String(data=self.robot.description.urdf))

    def publish_state(self, theta: Array, muscles: MuscleReadings) -> None:
        """Publish the state of the arm.

        Args:
            theta: Joint angles θ [rad], (D,).
            muscles: The readings of the muscle modules.
        """
        stamp, motors, joints = self.get_clock().now().to_msg(), self._motors, self._joints
        if motors is not None and is_heard(motors):
            message = motor_message(self.motors, muscles.length, muscles.tension, stamp)
            if motors is joints:
                add_joints(message, self.robot.units, theta)
            motors.publish(message)
        if joints is not None and joints is not motors and is_heard(joints):
            joints.publish(posture_message(self.robot.units, theta, stamp))
        if self._muscles is not None and is_heard(self._muscles):
            rows = muscles.to_message(self.robot.tension_source)
            self._muscles.publish(array_message(rows, 'quantity', 'muscle'))
