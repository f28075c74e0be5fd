# SPDX-License-Identifier: Apache-2.0
"""Driving an emulated arm through a list of commands and keeping what its sensors said."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.exploration import RAMP_SHARE, Exploration
from musculoskeletal_ae.control.methods import first_command
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

SAMPLE_TIME = 0.01  # [s], 100 Hz as the modules report


class Recording(NamedTuple):
    """N samples of one arm at 100 Hz.

    Attributes:
        theta: True joint angles [rad], (N, D).
        theta_sensor: What the joint sensors read [rad], (N, D).
        length: Measured [m], (N, M).
        tension: Measured [N], (N, M).
        command: l_target [m], (N, M).
    """

    theta: Array
    theta_sensor: Array
    length: Array
    tension: Array
    command: Array


class LengthGoal(NamedTuple):
    """A command to reach: l_target [m], shape (M,), and how long the step takes [s]."""

    length: Array
    duration: float


def motion(robot: Robot, mae: Mae, seed: int, duration: float) -> list[LengthGoal]:
    """Return one fixed list of length commands that follows the exploration's three steps.

    `second` needs the tension of the moment, which a fixed list cannot know: the least tension
    that holds the posture on the geometric model stands in for it, so that every command is
    `first`'s.
    """
    exploration, goals, planned = Exploration(robot, seed), [], 0.0
    while planned < duration - 1e-9:
        step = exploration.next_step()
        goals.append(LengthGoal(first_command(robot, mae, step.theta, step.tension), step.duration))
        planned += step.duration
    return goals


def record(
    arm: EmulatedArm,
    goals: Sequence[LengthGoal],
    progress: Callable[[float], None] | None = None,
) -> Recording:
    """Drive the arm through the goals, ramping to each and resting there.

    Args:
        arm: Is moved on from the state it is in.
        goals: Commands in order.
        progress: Called with the robot seconds that have passed since the last call.
    """
    rows: list[tuple[Array, ...]] = []
    # The first ramp starts where the arm is, so that it does not jump.
    command = arm.sense().length
    for goal in goals:
        start = command
        for tick in range(round(goal.duration / SAMPLE_TIME)):
            share = min(1.0, (tick + 1) * SAMPLE_TIME / (RAMP_SHARE * goal.duration))
            command = start + share * (goal.length - start)
            arm.command_length(command)
            arm.step(SAMPLE_TIME)
            read = arm.sense()
            rows.append((arm.theta, read.theta, read.length, read.tension, command))
        if progress:
            progress(goal.duration)
    return Recording(*(np.array(column) for column in zip(*rows, strict=True)))
