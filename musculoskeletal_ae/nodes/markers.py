# SPDX-License-Identifier: Apache-2.0
"""Bones and muscles as RViz and Foxglove draw them, in the root link's frame."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.drawing import Drawing

BONE_WIDTH, MUSCLE_WIDTH = 0.02, 0.006  # [m]
BONE_COLOUR = (0.85, 0.85, 0.8)


def arm_markers(drawing: Drawing, frame: str, stamp: Time) -> MarkerArray:
    """Return one line strip per bone and per muscle."""
    markers = [
        _line('bones', i, line, BONE_WIDTH, BONE_COLOUR, frame, stamp)
        for i, line in enumerate(drawing.bones)
    ]
    markers += [
        _line('muscles', i, line, MUSCLE_WIDTH, tuple(colour), frame, stamp)
        for i, (line, colour) in enumerate(zip(drawing.muscles, drawing.colours, strict=True))
    ]
    return MarkerArray(markers=markers)


def _line(
    space: str,
    index: int,
    points: Array,
    width: float,
    colour: tuple[float, ...],
    frame: str,
    stamp: Time,
) -> Marker:
    red, green, blue = (float(c) for c in colour)
    marker = Marker(ns=space, id=index, type=Marker.LINE_STRIP, action=Marker.ADD)
    marker.header.frame_id = frame
    marker.header.stamp = stamp
    marker.pose.orientation.w = 1.0
    marker.scale.x = width
    marker.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
    marker.points = [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in points]
    return marker
