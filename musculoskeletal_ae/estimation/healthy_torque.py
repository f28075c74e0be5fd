# SPDX-License-Identifier: Apache-2.0
"""Measures the external torque that is wrongly estimated for a healthy moving arm without contact.

    σ_j² ← σ_j² + (dt / t) (τ_ext,j² − σ_j²)

τ_ext,j is the estimated external torque of joint j, and σ_j its root mean square. t is the time of
motion so far, limited to MEMORY. `estimation/contact.py` divides the external torque by σ to decide
whether there is contact.
"""

from dataclasses import replace

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import LEAST_MOTION

MEMORY = 180.0  # average the squared torque over this much time in motion (time constant) [s]
MOVING = 0.05  # measure only while the norm of the joint velocities exceeds this [rad/s]
#: clip external torques to this multiple of σ before they enter the average, because larger ones
#: indicate contact
OUTLIER = 5.0
LEAST_SPREAD = 1e-3  # store at least this σ in the network [N·m], because torques are divided by it


class HealthyTorque:
    """Measures the external torque σ that is wrongly estimated for a healthy moving arm.

    The average covers the last minutes of motion, even if the network changed meanwhile.
    """

    def __init__(self, joint_count: int) -> None:
        self._square, self._time = np.zeros(joint_count), 0.0

    def put_into(self, mae: Mae) -> Mae:
        """Put the measured residual torque σ into a copy of a network, and return the copy.

        A network that contains no σ is returned unchanged. Before the first measurement, the σ of
        the network is adopted instead, and later measurements are averaged with it.
        """
        if (known := mae.touch) is None:
            return mae
        if self._time == 0.0:
            self._square, self._time = known.spread**2, known.time
            return mae
        spread = np.maximum(np.sqrt(self._square), LEAST_SPREAD)
        return replace(mae, touch=replace(known, spread=spread, time=self._time))

    def step(self, torque: Array, velocity: Array, dt: float) -> None:
        """Update the residual torque σ with a message of the healthy arm, if the arm moves.

        Args:
            torque: Estimated external torques at the joints [N·m], (D,).
            velocity: Joint velocities [rad/s], (D,).
            dt: Time since the previous message [s].
        """
        if np.linalg.norm(velocity) < MOVING:
            return
        square = torque**2
        if self._time > LEAST_MOTION:
            square = np.minimum(square, OUTLIER**2 * self._square)
        self._time = min(self._time + dt, MEMORY)
        # A torque of exactly 0 means that the joint is at its stop, where τ_ext is unknown; keep
        # its σ.
        change = np.where(torque == 0.0, 0.0, square - self._square)
        self._square = self._square + dt / self._time * change
