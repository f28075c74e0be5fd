# SPDX-License-Identifier: Apache-2.0
"""Emulated arms driven through a list of commands, and what their sensors said."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.exploration import RAMP_SHARE, Exploration
from musculoskeletal_ae.control.methods import first_command
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

SAMPLE_TIME = 0.01  # [s], 100 Hz as the modules report
#: random streams of the exploration (plus the individual's seed), and of the held-out motion
EXPLORATION_STREAM, HELD_OUT_STREAM = 100, 9000

#: told the arm and the time [s] before every step; may put weights into its hand or cut muscles
Script = Callable[[EmulatedArm, float], None]


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


def motion(robot: Robot, mae: Mae, stream: int, duration: float) -> Iterator[tuple[Array, float]]:
    """Yield the exploration's three steps as one fixed list: l_target [m] (M,) and how long [s].

    `second` needs the tension of the moment, which a fixed list cannot know: the least tension
    that holds the posture on the geometric model stands in for it, so that every command is
    `first`'s.
    """
    planned = 0.0
    for step in Exploration(robot, stream):
        yield first_command(robot, mae, step.theta, step.tension), step.duration
        planned += step.duration
        if planned >= duration - 1e-9:
            return


def record(
    arm: EmulatedArm, mae: Mae, stream: int, duration: float, script: Script | None = None
) -> Recording:
    """Drive an arm through random postures, ramping to each and resting there.

    Args:
        arm: Is moved on from the state it is in.
        mae: Computes the commands; see `motion`.
        stream: Seed of the random postures.
        duration: How long [s], rounded up to whole steps of the exploration.
        script: What happens to the arm on the way.
    """
    rows: list[tuple[Array, ...]] = []
    # The first ramp starts where the arm is, so that it does not jump.
    command = arm.sense().length
    for goal, step_time in motion(arm.robot, mae, stream, duration):
        start = command
        for tick in range(round(step_time / SAMPLE_TIME)):
            if script:
                script(arm, SAMPLE_TIME * len(rows))
            share = min(1.0, (tick + 1) * SAMPLE_TIME / (RAMP_SHARE * step_time))
            command = start + share * (goal - start)
            arm.command_length(command)
            arm.step(SAMPLE_TIME)
            read = arm.sense()
            rows.append((arm.theta, read.theta, read.length, read.tension, command))
    return Recording(*(np.array(column) for column in zip(*rows, strict=True)))


def times(count: int) -> Array:
    """Return the times of so many rows of a recording [s]."""
    return np.asarray(SAMPLE_TIME * np.arange(count), dtype=np.float64)


def rows_between(start: float, end: float) -> slice:
    """Return the rows of a recording between two times [s]."""
    return slice(round(start / SAMPLE_TIME), round(end / SAMPLE_TIME))


def mean_error(estimate: Array, truth: Array) -> float:
    """Return the mean over samples of ‖θ_est − θ_true‖₂ [rad]."""
    return float(np.linalg.norm(estimate - truth, axis=1).mean())


def estimation_error(mae: Mae, recording: Recording, stride: int = 1) -> float:
    """Return the mean error of a network's estimate on every so many messages [rad]."""
    part = slice(None, None, stride)
    estimate = mae.estimate(recording.tension[part], recording.length[part]).theta
    return mean_error(estimate, recording.theta[part])


def frictionless(robot: Robot, seed: int) -> EmulatedArm:
    """Return an individual as it would be without friction in wires and joints."""
    individual = Individual(robot, seed)
    individual.cable_friction[:] = 0.0
    individual.joint_friction[:] = 0.0
    return EmulatedArm(robot, seed, individual)
