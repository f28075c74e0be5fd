# SPDX-License-Identifier: Apache-2.0
"""The tool `render`: one picture of the running arm as a PNG, no display needed.

render [--out arm.png] [--topic hardware_emulator/markers] [--timeout 10] [--ros-args …]
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np
import rclpy
from rclpy.utilities import remove_ros_args
from visualization_msgs.msg import Marker, MarkerArray

from musculoskeletal_ae.nodes.qos import SENSOR
from musculoskeletal_ae.robot.picture import Line, save_picture


def _lines(message: MarkerArray) -> list[Line]:
    """Return the line strips of a marker array."""
    return [
        Line(
            np.array([[p.x, p.y, p.z] for p in marker.points]),
            marker.scale.x,
            (marker.color.r, marker.color.g, marker.color.b),
        )
        for marker in message.markers
        if marker.type == Marker.LINE_STRIP and marker.action == Marker.ADD and marker.points
    ]


def main() -> None:
    """Wait for one marker array and draw it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--out', default='arm.png', help='PNG to write (default: %(default)s)')
    parser.add_argument(
        '--topic', default='hardware_emulator/markers', help='MarkerArray (default: %(default)s)'
    )
    parser.add_argument('--timeout', type=float, default=10.0, help='[s] (default: %(default)s)')
    arguments = parser.parse_args(remove_ros_args(sys.argv)[1:])
    rclpy.init()
    node = rclpy.create_node('render')
    received: list[MarkerArray] = []
    node.create_subscription(MarkerArray, arguments.topic, received.append, SENSOR)
    deadline = time.monotonic() + arguments.timeout
    try:
        while not received and time.monotonic() < deadline:
            rclpy.spin_once(node, timeout_sec=0.1)
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    lines = _lines(received[0]) if received else []
    if not lines:
        print(
            f'error: no markers on {arguments.topic} within {arguments.timeout:g} s; is the node '
            'running, and in this namespace (--ros-args -r __ns:=/NAME)?',
            file=sys.stderr,
        )
        sys.exit(1)
    try:
        save_picture(lines, arguments.out)
    except OSError as error:
        print(f'error: {arguments.out}: {error}', file=sys.stderr)
        sys.exit(1)
    print(arguments.out)
