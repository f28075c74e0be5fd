# SPDX-License-Identifier: Apache-2.0
"""Measures how the arm moves at present, so that a motion can start from there.

The velocity is the derivative of the estimated posture, smoothed with the time constant SMOOTHING:

    dv/dt = (dθ/dt − v) / SMOOTHING
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.motion.trajectory import Setpoint

SMOOTHING = 0.1  # smooth the velocity with this time constant [s]
#: treat a joint as resting if it moves more slowly than this [rad/s]; the noise of estimates looks
#: like a motion of up to 0.05 rad/s
RESTING = 0.1
LONGEST = 0.5  # begin anew if two estimates are further apart than this [s]


class PresentMotion:
    """Measures the velocity of the joints from successive estimates."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Forget the estimates so far, because the next one may differ for other reasons."""
        self._last: tuple[float, Array] | None = None
        self._velocity: Array | float = 0.0

    def step(self, theta: Array, now: float) -> None:
        """Use an estimated posture θ [rad], (D,), that was received at `now` [s]."""
        if self._last is not None and now - self._last[0] > LONGEST:
            self.forget()
        if self._last is not None and (dt := now - self._last[0]) > 0.0:
            change = (theta - self._last[1]) / dt - self._velocity
            self._velocity = self._velocity + dt / (dt + SMOOTHING) * change
        self._last = now, theta

    def at(self, theta: Array) -> Setpoint:
        """Return the setpoint of an arm at θ [rad], (D,), that moves as measured."""
        velocity = np.broadcast_to(self._velocity, theta.shape)
        moving = np.where(np.abs(velocity) > RESTING, velocity, 0.0)
        return Setpoint(theta, moving, np.zeros_like(theta))
