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
from musculoskeletal_ae.estimation.contact import ContactEstimator
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import LEAST_MOTION
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.friction import FrictionDirection

MEMORY = 180.0  # largest time constant of the average; only time in motion counts [s]
MOVING = 0.05  # norm of the joint velocities above which an arm moves [rad/s]
#: multiple of σ to which torques are clipped, because larger torques indicate contact
OUTLIER = 5.0
LEAST_SPREAD = 1e-3  # smallest σ [N·m]


class HealthyTorque:
    """Measures the external torque σ that is wrongly estimated for a healthy moving arm.

    The average covers the last minutes of motion. `use` must be called before `step`.
    """

    def __init__(self, robot: Robot) -> None:
        self._contact, self._direction = ContactEstimator(robot), FrictionDirection()
        self._joint_count = robot.joint_count
        self.start()

    def start(self) -> None:
        """Restart the measurement, for example for another arm."""
        self._square, self._time = np.zeros(self._joint_count), 0.0

    def use(self, mae: Mae) -> Mae:
        """Use another network, and return a copy that contains the residual torque σ measured here.

        A network that contains no σ is returned unchanged. Until the arm has moved, the copy has
        the σ of the network itself.
        """
        if (known := mae.touch) is None:
            self._mae = mae
        else:
            if self._time == 0.0:
                self._square, self._time = known.spread**2, known.time
            spread = np.maximum(np.sqrt(self._square), LEAST_SPREAD)
            self._mae = replace(mae, touch=replace(known, spread=spread, time=self._time))
        self._contact.use(self._mae)
        return self._mae

    def reset(self) -> None:
        """Restart the filters, for example after a jump of the clock, but not the measurement."""
        self._contact.reset()
        self._direction.reset()

    def step(self, tension: Array, length: Array, dt: float) -> None:
        """Update the residual torque σ with a message, if the arm moves.

        Args:
            tension: Tensions as read [N], (M,).
            length: Muscle lengths [m], (M,).
            dt: Time since the previous message [s].
        """
        end = self._direction.end_tension(self._mae.transmission, tension, length)
        theta = self._mae.estimate(end, length).theta
        torque = self._contact.step(theta, end, dt).torque
        if np.linalg.norm(self._contact.velocity) < MOVING:
            return
        square = torque**2
        if self._time > LEAST_MOTION:
            square = np.minimum(square, OUTLIER**2 * self._square)
        self._time = min(self._time + dt, MEMORY)
        # A torque of exactly 0 means that the joint is at its stop, where τ_ext is not known.
        change = np.where(torque == 0.0, 0.0, square - self._square)
        self._square = self._square + dt / self._time * change
