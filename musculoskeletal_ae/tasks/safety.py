# SPDX-License-Identifier: Apache-2.0
"""What every length command passes before it leaves: safe stop, rate limit, saturation, check.

Order: model → rate limit → saturate → finite check last. A stop latches: the last command is held
for `hold_time`, then the muscles are paid out at the rate limit until MSC holds only T_bias.

A tension limit is a length limit, since MSC pulls with T_bias + K (l − l_target):

    l_target ≥ l − (T_limit − T_bias)/K_stiff

and the limit of a muscle whose module runs hot falls smoothly from tension.max to T_bias.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from musculoskeletal_ae.robot.robot import Robot

Array = NDArray[np.float64]

# Width of the band below the highest temperature in which a muscle's tension limit falls.
COOLING_BAND = 15.0  # [°C]


def thermal_limit(robot: Robot, temperature: Array, highest: float) -> Array:
    """Return each muscle's tension limit [N] (M,) for module temperatures [°C] (M,).

    A smooth step from tension.max, at COOLING_BAND below `highest`, to T_bias at `highest`.
    """
    share = np.clip((highest - temperature) / COOLING_BAND, 0.0, 1.0)
    smooth = share * share * (3.0 - 2.0 * share)
    limit: Array = robot.tension.bias + smooth * (robot.tension.max - robot.tension.bias)
    return limit


class SafetyFilter:
    """Latched stop and limits of the commanded lengths.

    Attributes:
        cause: Why the arm was stopped, or ''.
        command: Last command that left [m], shape (M,), or None.
    """

    def __init__(self, robot: Robot, rate_limit: float = 0.1, hold_time: float = 0.5) -> None:
        """Guard `robot`.

        Args:
            robot: For the tension range and K_stiff.
            rate_limit: Fastest change of a commanded length [m/s].
            hold_time: How long a stop holds the last command before paying out [s].
        """
        self._robot = robot
        self.rate_limit, self.hold_time = rate_limit, hold_time
        self.cause = ''
        self.command: Array | None = None
        self._held = 0.0

    def stop(self, cause: str) -> None:
        """Latch a stop; the first cause is kept."""
        if not self.cause:
            self.cause, self._held = cause, 0.0

    def reset(self) -> None:
        """Clear the stop."""
        self.cause = ''

    def step(self, wished: Array | None, length: Array, limit: Array, dt: float) -> Array | None:
        """Return the command that may leave [m] (M,), or None if nothing was ever commanded.

        Args:
            wished: What control wants [m], shape (M,); None to keep the last command.
            length: Measured lengths [m], shape (M,), the last ones that came.
            limit: Tension limit of each muscle [N], shape (M,).
            dt: Time since the step before [s].
        """
        if self.cause:
            return self._pay_out(length, dt)
        before = self.command
        if wished is None:
            wished = before
        if wished is None:
            return None
        if before is not None:
            change = self.rate_limit * dt
            wished = before + np.clip(wished - before, -change, change)
        shortest = length - (limit - self._robot.tension.bias) / self._robot.stiffness
        wished = np.maximum(wished, shortest)
        if not np.isfinite(wished).all():
            self.stop('the computed command is not finite')
            return self.command
        self.command = wished
        return wished.copy()

    def _pay_out(self, length: Array, dt: float) -> Array | None:
        if self.command is None:
            return None
        self._held += dt
        if self._held > self.hold_time:
            # Beyond the measured length MSC pulls with T_bias only; further out changes nothing.
            out = np.minimum(self.command + self.rate_limit * dt, np.maximum(length, self.command))
            self.command = out
        return self.command.copy()
