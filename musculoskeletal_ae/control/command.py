# SPDX-License-Identifier: Apache-2.0
"""Commands to the muscle modules, and the tensions of the muscles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot import actuation
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

LENGTH, TENSION = actuation.LENGTH, actuation.TENSION


class Command(NamedTuple):
    """A command to the muscle modules.

    Attributes:
        kind: `LENGTH` or `TENSION`.
        value: Target length [m] or target tension [N] of each muscle, (M,).
    """

    kind: str
    value: Array


class Pull(NamedTuple):
    """Present tensions [N] of the muscles at both ends of the tendon, (M,) each.

    Isolated muscles have tension 0.
    """

    motor: Array  # motor-side tension T; with a missing or faulty sensor, an assumed value
    bone: Array  # bone-side tension T_end, after tendon friction


def msc_compensation(robot: Robot, tension: Array) -> Array:
    """Return the difference l_target − l with which muscle stiffness control exerts a tension.

        l_comp(T) = −(T − T_bias) / K_stiff              (paper, §III-E, eq. 6)

    Args:
        robot: Provides T_bias and K_stiff of the muscle modules.
        tension: The tension T [N], (..., M).

    Returns:
        The difference l_comp [m], (..., M); zero at T_bias, negative above it. Zero for modules
        that follow positions, since their K_stiff is infinite.
    """
    return -(tension - robot.tension.bias) / robot.stiffness


def unchanging(robot: Robot, kind: str, sample: MuscleSample) -> Command:
    """Return a command that keeps the present tensions; `kind` is `LENGTH` or `TENSION`."""
    tension = np.maximum(sample.motor_tension, robot.tension.bias)
    if kind == TENSION:
        return Command(TENSION, tension)
    length = robot.actuation.unchanging_length(sample.length, sample.motor_tension)
    return Command(LENGTH, length)
