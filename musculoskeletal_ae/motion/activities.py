# SPDX-License-Identifier: Apache-2.0
"""The common interface of all activities of the arm: what each one reads and commands."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
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


class Inputs(NamedTuple):
    """What an activity may read at one control step; the controller provides every value."""

    mae: Mae
    sample: MuscleSample  # the newest muscle states
    #: present tension T of each muscle, 0 for isolated ones; with a missing or faulty sensor, an
    #: assumed value [N], (M,)
    motor_tension: Array
    bone_tension: Array  # the same at the bone-side end, after tendon friction [N], (M,)
    theta: Array  # the estimated posture [rad], (D,)
    length: Array  # last length command, or a command that keeps the present tensions [m], (M,)
    tension: Array  # last tension command, or a command that keeps the present tensions [N], (M,)
    limit: Array  # highest tension that may be planned [N], (M,)
    target: Array | None  # the requested posture [rad], (D,); None if there is none
    effort: Array  # requested torque in addition to gravity compensation [N·m], (D,)
    dt: float  # time since the last command [s]


class ActivityControl(ABC):
    """Commands the arm during one activity.

    After each step, the controller reads the properties below. Their defaults are those of an
    activity that needs nothing else from the controller.
    """

    @abstractmethod
    def enter(self, inputs: Inputs, /) -> None:
        """Begin the activity, or restart it after a pause, from the present tensions."""

    @abstractmethod
    def step(self, inputs: Inputs, /) -> Command | None:
        """Advance by one control step; return the desired command, or None to keep the last one."""

    @abstractmethod
    def leave(self) -> None:
        """Leave the activity, because another activity or a stop follows."""

    @property
    def has_arrived(self) -> bool:
        """Whether the requested motion has ended. If so, the arm should rest at its target."""
        return False

    @property
    def missing_torque(self) -> Array | None:
        """Torque [N·m], (D,), that the muscles cannot exert at the target; None if unknown."""
        return None


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
    """Return a command that keeps the present tensions; `kind` is `LENGTH` or `TENSION`.

    An isolated muscle, whose reading may be wrong, is commanded to exert T_bias.
    """
    present = np.maximum(sample.motor_tension, robot.tension.bias)
    tension = np.where(robot.used, present, robot.tension.bias)
    if kind == TENSION:
        return Command(TENSION, tension)
    return Command(LENGTH, sample.length + msc_compensation(robot, tension))
