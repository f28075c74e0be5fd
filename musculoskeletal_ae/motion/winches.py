# SPDX-License-Identifier: Apache-2.0
"""Measures the lag of the muscle modules behind their length commands."""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Setup
from musculoskeletal_ae.motion.activities import msc_compensation

#: measure the lag only at muscles that move faster than this [m/s], because noise hides it in slow
#: ones
WINDING = 0.03
#: weight of the initial guess λ = 0 in the fit [m²/s²]; a muscle that moves at speed v adds v²
LAGS = 2.0e-3
LARGEST_LAG = 0.1  # clip the measured lag to this [s]
#: compute speeds from lengths that are at least this far apart in time, so that noise is small [s]
SPAN = 0.0095


class Winches:
    """Measures the lag λ [s] of the modules while the arm moves.

        l − l_target − (T − T_bias)/K_stiff = −λ dl/dt

    Here l is the measured length, T the measured tension and l_target the length command. The
    equation holds for muscles of which muscle stiffness control demands more tension than T_bias,
    and always for position-controlled modules, whose K_stiff is ∞. λ is fitted by least squares to
    all muscles for which the equation holds and whose speed exceeds WINDING, except isolated ones.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._products, self._squares = 0.0, LAGS
        self._since = self._last = 0.0
        self._delay = 0.0  # delay of the last muscle_states message on its way here [s]
        self._length: Array | None = None
        self._speed: Array = np.zeros(
            setup.robot.muscle_count
        )  # speed of each muscle, dl/dt [m/s], (M,)

    @property
    def lag(self) -> float:
        """Measured lag λ by which the modules follow their commands [s]; 0 before any motion."""
        return min(max(self._products / self._squares, 0.0), LARGEST_LAG)

    @property
    def lead(self) -> Array:
        """Length by which each module that winds in lags behind its command [m], (M,)."""
        return self.lag * np.maximum(-self._speed, 0.0)

    def step(
        self, length: Array, tension: Array, command: Array, dt: float, delay: float = 0.0
    ) -> None:
        """Update the lag λ and the speeds of the muscles.

        Args:
            length: Muscle lengths l [m], (M,).
            tension: Tensions T [N], (M,).
            command: Length command at the time of l and T [m], (M,).
            dt: Time since the previous call [s].
            delay: How late the message with l and T is (`Arrival.delay`) [s].
        """
        # Messages that have waited arrive together, so a speed needs the times of sending.
        dt, self._delay = max(dt + self._delay - delay, 0.0), delay
        # `length` is the controller's median of three messages. It therefore belongs to the time of
        # the previous call, and each `dt` is added to the time between two lengths one call later.
        self._since, self._last = self._since + self._last, dt
        if self._length is not None and self._since < SPAN:
            return
        before, since = self._length, self._since
        self._length, self._since = length, 0.0
        if before is None:
            return
        self._speed = speed = (length - before) / since
        lacking = length - command + msc_compensation(self._setup.robot, tension)
        is_usable = (np.abs(speed) > WINDING) & self._setup.robot.used
        is_usable &= self._setup.robot.actuation.is_pulling(length, command)
        self._products -= float(lacking[is_usable] @ speed[is_usable])
        self._squares += float(speed[is_usable] @ speed[is_usable])

    def forget(self) -> None:
        """Forget the last measured lengths after a pause; λ remains known."""
        self._length, self._since = None, 0.0
        self._speed = np.zeros_like(self._speed)
