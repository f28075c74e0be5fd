# SPDX-License-Identifier: Apache-2.0
"""Where the geometric model comes to rest under a command, solved as equations.

    T = T_bias + max(0, K_stiff (l(θ, T) − l_target)),   g(θ) − JᵀF + Gᵀ T = τ_stop

The emulated arm without friction settles in the same place; unlike it, this can hold joints fast.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.mechanics import STOP_STIFFNESS
from musculoskeletal_ae.robot.robot import Robot

TENSION_UNIT = 100.0  # [N] per unknown, so that all are of one size


class Rest(NamedTuple):
    """θ [rad] (D,), T [N] (M,), and the largest residual of the equations."""

    theta: Array
    tension: Array
    residual: float


def nominal_rest(
    robot: Robot,
    command: Array,
    theta: Array,
    tension: Array,
    wrench: Array,
    fixed: Array,
) -> Rest:
    """Return the rest reached from (θ, T).

    Args:
        robot: The geometric model.
        command: l_target [m], shape (M,).
        theta: Where to start [rad], shape (D,).
        tension: Where to start [N], shape (M,).
        wrench: On the end effector, axes of the root link, shape (6,).
        fixed: Angles of joints held fast [rad], shape (D,); nan for a free joint.
    """
    from scipy.optimize import least_squares

    free = np.isnan(fixed)
    posture = np.where(free, theta, fixed)
    bias, most = robot.tension.bias, robot.tension.max
    kin = robot.kinematics

    def unpack(unknown: Array) -> tuple[Array, Array]:
        full = posture.copy()
        full[free] = unknown[: free.sum()]
        return full, TENSION_UNIT * unknown[free.sum() :]

    def residual(unknown: Array) -> Array:
        angles, pull = unpack(unknown)
        wound = robot.stiffness * (robot.muscle_lengths(angles, pull) - command)
        msc = pull - np.clip(bias + wound, bias, most)
        torque = kin.holding_torque(angles) - kin.end_effector_jacobian(angles).T @ wrench
        torque = torque + robot.routes.muscle_jacobian(angles).T @ pull
        beyond = angles - np.clip(angles, robot.lower, robot.upper)
        torque = torque + STOP_STIFFNESS * beyond
        return np.concatenate([torque[free], msc / TENSION_UNIT])

    start = np.concatenate([posture[free], tension / TENSION_UNIT])
    solved = least_squares(residual, start, x_scale='jac', max_nfev=500)
    return Rest(*unpack(solved.x), float(np.abs(solved.fun).max()))
