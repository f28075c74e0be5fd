# SPDX-License-Identifier: Apache-2.0
"""The tool `render`: one picture of a running arm as a PNG, no display needed."""

from __future__ import annotations

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


def _lines(message: MarkerArray) -> list[Line]:
    """Return the line strips of a marker array."""
    return [
        Line(
            marker.ns,
            np.array([[p.x, p.y, p.z] for p in marker.points]),
            marker.scale.x,
            (marker.color.r, marker.color.g, marker.color.b),
        )
        for marker in message.markers
        if marker.type == Marker.LINE_STRIP and marker.action == Marker.ADD and marker.points
    ]


def _render(options: Namespace, arguments: list[str]) -> int:
    start_ros(arguments)
    node = Node('render')
    received: list[MarkerArray] = []
    node.create_subscription(MarkerArray, options.topic, received.append, SENSOR)
    Spinner(node).spin_until(lambda: received, options.timeout)
    lines = _lines(received[0]) if received else []
    if not lines:
        raise MusculoskeletalError(
            f'no markers on {options.topic} within {options.timeout:g} s; is the node running, '
            'and in this namespace (--ros-args -r __ns:=/NAME)?'
        )
    save_picture(lines, options.out)
    print(options.out)
    return 0


def _parse(arguments: list[str]) -> Namespace:
    parser = Parser('render', 'Writes a picture of a running arm; needs no display.', ROS_HELP)
    parser.add_out('FILE.png', default=Path('arm.png'), read=picture)
    parser.add_argument('--topic', default='hardware_emulator/markers', help='MarkerArray to draw')
    parser.add_argument(
        '--timeout', type=positive, default=10.0, metavar='S', help='how long to wait [s]'
    )
    return parser.parse_args(arguments)


main = partial(run_tool, 'render', _parse, _render)
