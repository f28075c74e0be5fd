# SPDX-License-Identifier: Apache-2.0
"""An arm for RViz and Foxglove: bones, muscles and their names as markers in the root link's frame.

Arms can be told apart by their bones: the hardware's are ivory and solid, those of the estimate
green, of the simulator violet, both translucent.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from itertools import count

from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from musculoskeletal_ae.nodes.qos import RELIABLE
from musculoskeletal_ae.nodes.shell import Shell
from musculoskeletal_ae.robot.drawing import BONE_COLOUR, Line

MARKER_RATE = 10.0  # [Hz]
NAME_HEIGHT = 0.018  # [m]
BONES = {'estimated': (0.0, 0.62, 0.45, 0.5), 'sim': (0.58, 0.40, 0.74, 0.5)}
SOLID = (*BONE_COLOUR, 1.0)


class Markers:
    """Publishes ARM/markers while somebody listens."""

    def __init__(self, node: Shell, arm: str, lines: Callable[[], list[Line]]) -> None:
        """Draw the lines of an arm, none where there is nothing to draw yet."""
        self._node, self._lines = node, lines
        self._bones = BONES.get(arm, SOLID)
        self._publisher = node.create_publisher(MarkerArray, f'{arm}/markers', RELIABLE)
        node.create_timer(1.0 / MARKER_RATE, self._publish)

    def _publish(self) -> None:
        if self._publisher.get_subscription_count() == 0 or not (lines := self._lines()):
            return
        numbers: defaultdict[str, count[int]] = defaultdict(count)
        message, names = MarkerArray(), iter(self._node.robot.muscles)
        for line in lines:
            marker = self._add(message, line.kind, next(numbers[line.kind]), Marker.LINE_STRIP)
            marker.scale.x = line.width
            *rgb, alpha = self._bones if line.kind == 'bones' else (*line.colour, self._bones[3])
            marker.color = ColorRGBA(r=rgb[0], g=rgb[1], b=rgb[2], a=alpha)
            marker.points = [Point(x=x, y=y, z=z) for x, y, z in line.points.tolist()]
            if line.kind == 'muscles':
                name = self._add(message, 'names', marker.id, Marker.TEXT_VIEW_FACING)
                name.text, name.scale.z, name.color = next(names), NAME_HEIGHT, marker.color
                at = line.points.mean(axis=0).tolist()
                name.pose.position.x, name.pose.position.y, name.pose.position.z = at
        self._publisher.publish(message)

    def _add(self, message: MarkerArray, kind: str, number: int, shape: int) -> Marker:
        marker = Marker(ns=kind, id=number, type=shape)
        marker.header.frame_id = self._node.root_frame
        marker.header.stamp = self._node.get_clock().now().to_msg()
        marker.pose.orientation.w = 1.0
        message.markers.append(marker)
        return marker
