# SPDX-License-Identifier: Apache-2.0
"""Muscle lengths that bring the arm to a posture with given tensions, and their smooth ramp.

    l_comp(T)  = −(T − T_bias)/K_stiff
    geometric:   l_target = f_geo(θ) − L_e(f_geo,abs(θ), T_bias)
    first:       l_target = ①(θ_target, T_const) + l_comp(T_const)

(paper, section "Control", eq. move-first). MSC holds T = T_bias + max(0, K_stiff (l − l_target)),
so l_comp is how far the command must lie below the length for the muscle to carry T there.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot


def msc_compensation(robot: Robot, tension: Array) -> Array:
    """Return l_comp(T) [m], shape (..., M); zero at T_bias, negative above it."""
    compensation: Array = -(tension - robot.tension.bias) / robot.stiffness
    return compensation


def geometric_command(robot: Robot, theta: Array) -> Array:
    """Return l_target [m] (..., M) of `geometric` for θ_target [rad] (..., D)."""
    bias = np.full((*theta.shape[:-1], robot.muscle_count), robot.tension.bias)
    return robot.muscle_lengths(theta, bias)


def first_command(robot: Robot, mae: Mae, theta: Array, tension: Array) -> Array:
    """Return l_target [m] (..., M) of `first` for θ_target [rad] (..., D), T_const [N] (..., M)."""
    return mae.lengths(theta, tension) + msc_compensation(robot, tension)


def ramp(start: Array, goal: Array, elapsed: float, duration: float) -> Array:
    """Return the command `elapsed` seconds into a straight ramp of `duration` seconds."""
    share = 1.0 if duration <= 0.0 else min(1.0, max(0.0, elapsed / duration))
    command: Array = start + share * (goal - start)
    return command
