# SPDX-License-Identifier: Apache-2.0
"""Commands to the muscle modules, and how the muscles pull."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_stream import MuscleSample

LENGTH, TENSION = 'length', 'tension'


class Command(NamedTuple):
    """What the muscle modules are to follow.

    Attributes:
        kind: `LENGTH` or `TENSION`.
        value: l_target [m] or T_target [N], (M,).
    """

    kind: str
    value: Array


class Pull(NamedTuple):
    """How the muscles pull [N], (M,) each."""

    motor: Array  # T, as measured at the motors
    bone: Array  # T_end, what tendon friction leaves of it


def msc_compensation(robot: Robot, tension: Array) -> Array:
    """Return how far l_target lies below l for muscle stiffness control to carry a tension.

        l_comp(T) = −(T − T_bias) / K_stiff              (paper, §III-E, eq. 6)

    Args:
        robot: The body.
        tension: T [N], (..., M).

    Returns:
        l_comp [m], (..., M); zero at T_bias, negative above it.
    """
    return -(tension - robot.tension.bias) / robot.stiffness


def unchanging(robot: Robot, kind: str, sample: MuscleSample) -> Command:
    """Return the command of a kind under which the muscles go on to pull as they do now."""
    tension = np.maximum(sample.motor_tension, robot.tension.bias)
    if kind == TENSION:
        return Command(TENSION, tension)
    return Command(LENGTH, sample.length + msc_compensation(robot, tension))
