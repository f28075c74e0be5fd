# SPDX-License-Identifier: Apache-2.0
"""How parameters are described to `ros2 param describe`."""

from __future__ import annotations

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from musculoskeletal_ae.presets import PRESETS, preset_named


def text(description: str, read_only: bool = False) -> ParameterDescriptor:
    """Describe a parameter that has no range."""
    return ParameterDescriptor(description=description, read_only=read_only)


def whole(description: str) -> ParameterDescriptor:
    """Describe a whole number of at least 0 that is read once, such as a seed."""
    span = IntegerRange(from_value=0, to_value=2**63 - 1)
    return ParameterDescriptor(description=description, integer_range=[span], read_only=True)


def declare_preset(node: Node, meaning: str) -> str:
    """Declare `preset`, read once, and return it.

    Raises:
        MusculoskeletalError: If there is no such preset.
    """
    descriptor = text(f'{meaning}; one of: {", ".join(PRESETS)}', read_only=True)
    preset = str(node.declare_parameter('preset', 'default', descriptor).value)
    return preset_named(preset).name


def number(
    description: str, low: float, high: float, read_only: bool = False
) -> ParameterDescriptor:
    """Describe a number within [low, high]; rclpy refuses what lies outside, NaN included."""
    span = FloatingPointRange(from_value=low, to_value=high)
    return ParameterDescriptor(
        description=description, floating_point_range=[span], read_only=read_only
    )
