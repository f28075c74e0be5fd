# SPDX-License-Identifier: Apache-2.0
"""A slow integral of the estimated error while the arm rests.

    dc/dt = gain (θ_target − θ_estimated),   |c| ≤ CORRECTION
    l_target = ①(θ_target + c, T) + l_comp(T)

Friction and errors of the body image leave the arm beside its target; the estimate sees most of
that (LINEAGE, hysteresis feedback). T stays, since the torque to exert is the target's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.mae.mae import Mae

Array = NDArray[np.float64]

CORRECTION = 0.3  # [rad] at most
DEADBAND = 0.01  # [rad] of estimated error that is left alone, so that the arm comes to rest
SETTLING = 0.5  # [s] after a movement until the arm is taken for resting


class RestFeedback:
    """The correction of one target.

    Attributes:
        correction: c [rad], shape (D,).
    """

    def __init__(self, joints: int) -> None:
        """Start without a correction."""
        self.correction: Array = np.zeros(joints)
        self._rested = 0.0

    def reset(self) -> None:
        """Forget the correction: a new target."""
        self.correction = np.zeros_like(self.correction)

    def moving(self) -> None:
        """Freeze the correction until the arm has settled again."""
        self._rested = 0.0

    def step(self, error: Array, gain: float, dt: float) -> bool:
        """Integrate θ_target − θ_estimated [rad] (D,) if the arm rests; return whether it does."""
        self._rested += dt
        if self._rested <= SETTLING or gain == 0.0:
            return False
        beyond = np.where(np.abs(error) < DEADBAND, 0.0, error)
        self.correction = np.clip(self.correction + gain * dt * beyond, -CORRECTION, CORRECTION)
        return True

    def shift(self, mae: Mae, theta: Array, tension: Array) -> Array:
        """Return what the correction adds to the lengths at (θ_target, T) [m], shape (M,)."""
        shifted: Array = mae.lengths(theta + self.correction, tension)
        return shifted - mae.lengths(theta, tension)
