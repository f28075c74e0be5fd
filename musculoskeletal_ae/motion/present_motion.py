# SPDX-License-Identifier: Apache-2.0
"""Measures the present velocity of the joints, from which a new motion starts.

The velocity is the derivative of the estimated posture, smoothed with the time constant SMOOTHING:

    dv/dt = (dθ/dt − v) / SMOOTHING

The times are those at which the estimates were sent, because late messages may be received
together.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.motion.trajectory import STOPPING, Setpoint
from musculoskeletal_ae.robot.robot import Robot

SMOOTHING = 0.1  # smooth the velocity with this time constant [s]
#: treat a joint as resting if it moves more slowly than this [rad/s]; the noise of estimates with a
#: standard deviation of 1 mrad at 100 Hz looks like a motion of up to 0.05 rad/s
RESTING = 0.1
LONGEST = 0.5  # begin anew if two estimates are further apart than this [s]


class PresentMotion:
    """Measures the velocity of the joints from successive estimates."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Forget the estimates: the next one may differ although the arm has not moved."""
        self._last: tuple[float, Array] | None = None
        self._velocity: Array | float = 0.0

    def step(self, theta: Array, time: float) -> None:
        """Use an estimate θ [rad], (D,), of the posture at `time`, by the messages' clock [s]."""
        if self._last is not None:
            dt = time - self._last[0]
            if 0.0 < dt <= LONGEST:
                change = (theta - self._last[1]) / dt - self._velocity
                self._velocity = self._velocity + dt / (dt + SMOOTHING) * change
            else:
                self.forget()
        self._last = time, theta

    def setpoint(self, theta: Array, robot: Robot) -> Setpoint:
        """Return posture and velocity of the arm, without acceleration.

        Both are limited so that the arm can come to rest within the joint limits in the time
        STOPPING. The velocity of a resting joint is 0.

        Args:
            theta: The estimated posture θ [rad], (D,).
            robot: Provides the joint limits.
        """
        inside = np.clip(theta, robot.lower, robot.upper)
        ways = (robot.lower - inside, robot.upper - inside)
        velocity = np.clip(self._velocity, *(way / (0.5 * STOPPING) for way in ways))
        moving = np.where(np.abs(velocity) > RESTING, velocity, 0.0)
        return Setpoint(inside, moving, np.zeros_like(inside))
