# SPDX-License-Identifier: Apache-2.0
"""The tool `render`: one picture of a running arm as a PNG, no display needed."""

from argparse import Namespace
from functools import partial
from pathlib import Path

import numpy as np
from rclpy.node import Node
from visualization_msgs.msg import Marker, MarkerArray

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.nodes.messages import SENSOR
from musculoskeletal_ae.nodes.running import ROS_HELP, Spinner, run_tool, start_ros
from musculoskeletal_ae.options import Parser, picture, positive
from musculoskeletal_ae.robot.drawing import Line, save_picture


def _line(strip: Marker) -> Line:
    """Return a line strip of a marker array."""
    points, colour = np.array([[p.x, p.y, p.z] for p in strip.points]), strip.color
    return Line(strip.ns, points, strip.scale.x, (colour.r, colour.g, colour.b))


def _render(options: Namespace, arguments: list[str]) -> int:
    start_ros(arguments)
    node = Node('render')
    received: list[MarkerArray] = []
    node.create_subscription(MarkerArray, options.topic, received.append, SENSOR)
    Spinner(node).spin_until(lambda: received, options.timeout)
    kind = Marker.LINE_STRIP, Marker.ADD
    markers = received[0].markers if received else []
    lines = [_line(m) for m in markers if (m.type, m.action) == kind and m.points]
    if not lines:
        told = f'no markers on {options.topic} within {options.timeout:g} s; is the node running'
        raise MusculoskeletalError(f'{told}, and in this namespace (--ros-args -r __ns:=/NAME)?')
    save_picture(lines, options.out)
    print(options.out)
    return 0


def _parse(arguments: list[str]) -> Namespace:
    parser = Parser('render', 'Writes a picture of a running arm; needs no display.', ROS_HELP)
    parser.add_out('FILE.png', default=Path('arm.png'), read=picture)
    add = parser.add_argument
    add('--topic', default='hardware_emulator/markers', help='MarkerArray to draw')
    add('--timeout', type=positive, default=10.0, metavar='S', help='how long to wait [s]')
    return parser.parse_args(arguments)


main = partial(run_tool, 'render', _parse, _render)
