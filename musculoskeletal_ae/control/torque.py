# SPDX-License-Identifier: Apache-2.0
"""Joint torque by muscle tension: the method `tension`.

    τ = g(θ) + effort + K_p (θ_target − θ) − K_d dθ/dt
    T = least tension with −Gᵀ T = τ within [T_bias, T_limit], else the nearest

with G from the MAE at (θ, T) (paper, section "Control", third; Kawamura 2016). θ is the estimate,
smoothed. With both gains zero the arm's weight is carried and `effort` is exerted, nothing more:
such an arm floats and keeps no posture.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension

SMOOTHING = 0.05  # [s] time constant of the low pass on the estimate, which is as noisy as T and l


class TorqueControl:
    """Tensions for a torque, moment by moment."""

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self._robot, self.settings = robot, settings
        #: what the tensions of the last step do not deliver [N·m], (D,)
        self.missing_torque: Array = np.zeros(robot.joint_count)
        self.start_from(np.full(robot.muscle_count, robot.tension.bias))

    def start_from(self, tension: Array) -> None:
        """Continue from tensions [N] (M,), at the start, after a stop or another method."""
        self._command: Array = np.maximum(tension, self._robot.tension.bias)
        self._smooth: Array | None = None

    def step(
        self, mae: Mae, theta: Array, target: Array, effort: Array, limit: Array, dt: float
    ) -> Array:
        """Return the tensions to command [N], at most `limit` (M,), dt [s] after the last ones.

        θ is estimated, the target and it [rad] (D,); effort is torque beyond the weight [N·m] (D,).
        """
        chosen, robot = self.settings, self._robot
        before = theta if self._smooth is None else self._smooth
        self._smooth = smooth = before + dt / (dt + SMOOTHING) * (theta - before)
        velocity = (theta - smooth) / SMOOTHING
        torque = robot.kinematics.holding_torque(smooth) + effort
        torque = torque + chosen.position_gain * (target - smooth)
        torque = torque - chosen.velocity_gain * velocity
        jacobian = mae.muscle_jacobian(smooth, self._command)
        tension, self.missing_torque = least_tension(jacobian, torque, robot.tension.bias, limit)
        # All muscles change by the same share: between two tensions that hold the arm, it is held.
        change = tension - self._command
        fastest = robot.stiffness * chosen.rate_limit * dt
        share = float((fastest / np.maximum(fastest, np.maximum(np.abs(change), 1e-9))).min())
        self._command = self._command + change * share
        return self._command.copy()
