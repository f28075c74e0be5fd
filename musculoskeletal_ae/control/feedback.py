# SPDX-License-Identifier: Apache-2.0
"""Two slow integrals while the arm rests: of the estimated error, and of needless tension.

    dc/dt = gain (θ_target − θ_estimated),   |c| ≤ CORRECTION
    dr/dt = gain (T − T*)/K_stiff,           |r| ≤ RELIEF
    T*    = argmin ‖T*‖²   subject to   Gᵀ T* = Gᵀ T,   T_bias ≤ T* ≤ T_limit
    l_target = ①(θ_target + c, T_planned) + l_comp(T_planned) + r

Friction and errors of the body image leave the arm beside its target; the estimate sees most of
that (LINEAGE, hysteresis feedback). They also leave muscles that pull against each other, because a
tension commanded as a length is off by K_stiff times what l is off. T* exerts the torque that T
does, so that the relief of one moves no joint, and the other need not know of it.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension

CORRECTION = 0.3  # [rad] at most
#: [m] at most: about what a length can be off by, so that friction is not put to holding the arm
RELIEF = 0.004
#: of estimated error that is left alone [rad]: about the estimate's own, after which an arm with
#: friction would creep for ever
DEADBAND = 0.03
SETTLING = 0.5  # [s] after a movement until the arm is taken for resting


class RestFeedback:
    """The corrections c [rad] (D,) and r [m] (M,) of one target, `correction` and `relief`."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.reset()
        self.moving()

    def reset(self) -> None:
        """Forget the corrections: a new target."""
        self.correction: Array = np.zeros(self._robot.joint_count)
        self.relief: Array = np.zeros(self._robot.muscle_count)

    def moving(self) -> None:
        """Freeze the corrections until the arm has settled again."""
        self._rested = 0.0

    def step(
        self, error: Array, jacobian: Array, tension: Array, limit: Array, gain: float, dt: float
    ) -> bool:
        """Integrate over dt [s] if the arm rests; return whether it does.

        Of θ_target − θ_estimated [rad] (D,), G at the target (M, D), and T measured and the highest
        planned [N] (M,); a gain [1/s] of 0 is no feedback.
        """
        self._rested += dt
        if self._rested <= SETTLING or gain == 0.0:
            return False
        beyond = np.where(np.abs(error) < DEADBAND, 0.0, error)
        self.correction = np.clip(self.correction + gain * dt * beyond, -CORRECTION, CORRECTION)
        bias = self._robot.tension.bias
        pulled = np.clip(tension, bias, limit)
        least = least_tension(jacobian, -jacobian.T @ pulled, bias, limit).tension
        relieved = self.relief + gain * dt * (pulled - least) / self._robot.stiffness
        self.relief = np.clip(relieved, -RELIEF, RELIEF)
        return True

    def shift(self, mae: Mae, theta: Array, tension: Array) -> Array:
        """Return what the corrections add to the lengths at (θ_target, T) [m], shape (M,)."""
        shifted = mae.lengths(theta + self.correction, tension)
        return shifted - mae.lengths(theta, tension) + self.relief
