# SPDX-License-Identifier: Apache-2.0
"""The tool `render`: saves a picture of a running arm as a PNG file, without a display."""

from argparse import Namespace
from functools import partial
from pathlib import Path

import numpy as np
from rclpy.node import Node
from visualization_msgs.msg import Marker, MarkerArray

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.options import Parser, picture
from musculoskeletal_ae.robot.drawing import Line, save_picture
from musculoskeletal_ae.ros.message_building import SENSOR
from musculoskeletal_ae.ros_tools.ros_tool import ROS_HELP, Spinner, run_tool, start_ros

#: topics of markers: a picture shows the emulated arm if it is published, otherwise the estimate
BODY, ESTIMATE = 'hardware_emulator/markers', 'estimated/markers'
#: wait this long for the preferred topic after markers have arrived on another topic [s]
DISCOVERY_TIME = 2.0
PATIENCE = 10.0  # fail if no markers arrive within this time [s]


def _line(strip: Marker) -> Line:
    """Convert a line-strip marker to a line of a drawing."""
    points, colour = np.array([[p.x, p.y, p.z] for p in strip.points]), strip.color
    return Line(strip.ns, points, strip.scale.x, (colour.r, colour.g, colour.b))


def _render(options: Namespace, arguments: list[str]) -> int:
    start_ros(arguments)
    node = Node('render')
    topics = [options.topic] if options.topic else [BODY, ESTIMATE]
    drawn: dict[str, list[Line]] = {}
    for topic in topics:
        take = partial(_take, drawn, topic)
        node.create_subscription(MarkerArray, topic, take, SENSOR)
    first, spinner = node.resolve_topic_name(topics[0]), Spinner(node)
    spinner.spin_until(lambda: drawn, PATIENCE)
    # Wait longer for the preferred topic: its publisher may be discovered later, or send later.
    spinner.spin_until(lambda: topics[0] in drawn, DISCOVERY_TIME if drawn else 0.0)
    if drawn and node.count_publishers(first):
        spinner.spin_until(lambda: topics[0] in drawn, PATIENCE)
    if not drawn:
        problem = f'no markers on {" or ".join(topics)} within {PATIENCE:g} s'
        remedy = 'check that the arm runs, and state its namespace (--ros-args -r __ns:=/NAME)'
        raise MusculoskeletalError(f'{problem}; {remedy}')
    topic = topics[0] if topics[0] in drawn else topics[-1]
    save_picture(drawn[topic], options.out)
    print(f'{options.out}: {topic}')
    return 0


def _take(drawn: dict[str, list[Line]], topic: str, message: MarkerArray) -> None:
    kind = Marker.LINE_STRIP, Marker.ADD
    lines = [_line(m) for m in message.markers if (m.type, m.action) == kind and m.points]
    if lines:  # an estimator without a network publishes no lines
        drawn[topic] = lines


def _parse(arguments: list[str]) -> Namespace:
    parser = Parser('render', 'Writes a picture of a running arm; needs no display.', ROS_HELP)
    parser.add_out('FILE.png', default=Path('arm.png'), read=picture)
    text = f'topic of the markers to draw (default: {BODY} if published, else {ESTIMATE})'
    parser.add_argument('--topic', help=text)
    return parser.parse_args(arguments)


main = partial(run_tool, 'render', _parse, _render)
