# SPDX-License-Identifier: Apache-2.0
"""How far the muscle modules lag behind what muscle stiffness control demands."""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.command import msc_compensation
from musculoskeletal_ae.robot.robot import Robot

WINDING = 0.03  # [m/s] from which a winch tells its lag
LAGS = 2.0e-3  # [m²/s²] of winding that the first guess of λ, none, counts for
LARGEST_LAG, SPAN = 0.1, 0.0095  # [s]; over which l tells how fast it winds, above its noise


class Winches:
    """Measures the lag λ [s] of the modules while the arm moves.

        l − l_target − (T − T_bias)/K_stiff = −λ dl/dt     wherever MSC demands more than T_bias

    by least squares over all muscles that wind fast enough to tell.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._products, self._squares = 0.0, LAGS
        self._since = self._last = 0.0
        self._length: Array | None = None

    def use(self, robot: Robot) -> None:
        """Look at the muscles that this robot uses."""
        self._robot = robot

    @property
    def lag(self) -> float:
        """λ as far as it is known [s]."""
        return min(max(self._products / self._squares, 0.0), LARGEST_LAG)

    def step(self, length: Array, tension: Array, command: Array, dt: float) -> None:
        """Take l [m], T [N] (M,), `dt` [s] after the ones before, and what was commanded then."""
        # Medians of three messages tell how it was one message ago.
        self._since, self._last = self._since + self._last, dt
        if self._length is not None and self._since < SPAN:
            return
        before, since = self._length, self._since
        self._length, self._since = length, 0.0
        if before is None:
            return
        speed = (length - before) / since
        lacking = length - command + msc_compensation(self._robot, tension)
        telling = (np.abs(speed) > WINDING) & (length > command) & self._robot.used
        self._products -= float(lacking[telling] @ speed[telling])
        self._squares += float(speed[telling] @ speed[telling])

    def forget(self) -> None:
        """Begin anew after a pause; λ stays."""
        self._length, self._since = None, 0.0
