# SPDX-License-Identifier: Apache-2.0
"""Emulated arms driven through a list of commands, and what their sensors said."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.exploration import Exploration
from musculoskeletal_ae.control.methods import first_command
from musculoskeletal_ae.control.posture import RAMP_SHARE, Step
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.mae.mae import Mae

SAMPLE_TIME = 0.01  # [s], 100 Hz as the modules report
#: random streams of the exploration (plus the individual's seed), and of the held-out motion
EXPLORATION_STREAM, HELD_OUT_STREAM = 100, 9000

#: told the arm and the time [s] before every step; may put weights into its hand or cut muscles
Script = Callable[[EmulatedArm, float], None]


class Recording(NamedTuple):
    """N samples of one arm at 100 Hz."""

    theta: Array  # true joint angles [rad], (N, D)
    theta_sensor: Array  # what the joint sensors read [rad], (N, D)
    length: Array  # measured [m], (N, M)
    tension: Array  # measured [N], (N, M)
    command: Array  # l_target [m], (N, M)

    def part(self, rows: slice) -> Recording:
        """Return some of the samples."""
        return Recording(*(column[rows] for column in self))


class Motion(NamedTuple):
    """N steps of an arm or of its simulator."""

    theta: Array  # [rad], (N, D)
    tension: Array  # [N], (N, M)


def record(
    arm: EmulatedArm,
    mae: Mae,
    stream: int | Iterable[Step],
    duration: float,
    script: Script | None = None,
) -> Recording:
    """Drive an arm through the exploration's three steps, as one fixed list of commands.

    Each command is `first`'s. `second` needs the tension of the moment, which a fixed list cannot
    know: the least tension that holds the posture on the geometric model stands in for it.

    Args:
        arm: Is moved on from the state it is in.
        mae: Computes the commands.
        stream: Random seed of the postures, or the steps themselves.
        duration: How long [s], rounded up to whole steps of the exploration.
        script: What happens to the arm on the way.
    """
    planned, rows = 0.0, list[tuple[Array, ...]]()
    # The first ramp starts where the arm is, so that it does not jump.
    command = arm.sense().length
    for step in Exploration(arm.robot, stream) if isinstance(stream, int) else stream:
        if planned >= duration - 1e-9:
            break
        start, goal = command, first_command(arm.robot, mae, step.theta, step.tension)
        planned += step.duration
        for tick in range(round(step.duration / SAMPLE_TIME)):
            if script:
                script(arm, SAMPLE_TIME * len(rows))
            share = min(1.0, (tick + 1) * SAMPLE_TIME / (RAMP_SHARE * step.duration))
            command = start + share * (goal - start)
            arm.command_length(command)
            arm.step(SAMPLE_TIME)
            read = arm.sense()
            rows.append((arm.theta, read.theta, read.length, read.tension, command))
    return Recording(*columns(rows))


def columns(rows: Iterable[tuple[Any, ...]]) -> tuple[Any, ...]:
    """Return rows of equal length as one array for each column."""
    return tuple(np.array(column) for column in zip(*rows, strict=True))


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
    part = recording.part(np.s_[::stride])
    return mean_error(mae.estimate(part.tension, part.length).theta, part.theta)
