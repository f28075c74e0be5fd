# SPDX-License-Identifier: Apache-2.0
"""Measures joint damping, and the external torque that is wrongly estimated without contact.

    σ_j² ← σ_j² + (dt / t) (τ_j² − σ_j²)
    d_j  = max(0, d_0,j − E[θ̇_j τ'_j] / (E[θ̇_j²] + SLOW²)),   τ'_j = τ_j + (d_0,j − d_j,used) θ̇_j

τ_j is the estimated external torque of joint j of the healthy moving arm, and σ_j its root mean
square. If the joint is damped more than the estimate assumed (d_j,used), τ_j opposes the velocity
θ̇_j. d_j is the damping that explains this best, and d_0,j that of the robot description. The means
E are formed like σ_j². t is the time of motion so far, limited to MEMORY.

`estimation/contact.py` divides the external torque by σ to decide whether there is contact. The
damping becomes part of the network's `elasticity`, so that contact detection and motion plans
consider it.
"""

from dataclasses import replace

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import LEAST_MOTION
from musculoskeletal_ae.robot.robot import Robot

MEMORY = 180.0  # average the squared torque over this much time in motion (time constant) [s]
MOVING = 0.05  # measure only while the norm of the joint velocities exceeds this [rad/s]
#: clip external torques to this multiple of σ before they enter the average, because larger ones
#: indicate contact
OUTLIER = 5.0
#: keep the damping of the description until the joint has moved faster than about this [rad/s]
SLOW = 0.02
LEAST_SPREAD = 1e-3  # store at least this σ in the network [N·m], because torques are divided by it


class HealthyTorque:
    """Measures the damping of the joints, and the external torque σ that remains unexplained.

    The average covers the last minutes of motion, even if the network changed meanwhile.
    """

    def __init__(self, robot: Robot) -> None:
        self._stated = robot.kinematics.elasticity
        nothing = np.zeros(robot.joint_count)
        #: means of τ², θ̇² and θ̇ τ', each (D,)
        self._means = np.array([nothing, nothing, nothing])
        self._time = 0.0

    @property
    def damping(self) -> Array:
        """Damping of each joint [N·m·s/rad], (D,)."""
        _, square, product = self._means
        damping: Array = np.maximum(self._stated.damping - product / (square + SLOW**2), 0.0)
        return damping

    def put_into(self, mae: Mae) -> Mae:
        """Put the measured damping and residual torque σ into a copy of a network; return the copy.

        A network that contains no σ is returned unchanged. Before the first measurement, the values
        of the network are adopted instead, and later measurements are averaged with them. Damping
        needs as much motion as the detection of contact (`TouchStatistics.calibrated`).
        """
        if (known := mae.touch) is None:
            return mae
        springs = mae.elasticity or self._stated
        if self._time == 0.0:
            square = np.full_like(known.spread, SLOW**2)
            product = -2.0 * square * (springs.damping - self._stated.damping)
            self._means, self._time = np.array([known.spread**2, square, product]), known.time
            return mae
        spread = np.maximum(np.sqrt(self._means[0]), LEAST_SPREAD)
        touch = replace(known, spread=spread, time=self._time)
        if not touch.calibrated:
            return replace(mae, touch=touch)
        return replace(mae, touch=touch, elasticity=replace(springs, damping=self.damping))

    def step(self, torque: Array, velocity: Array, damping: Array, dt: float) -> None:
        """Update damping and residual torque with a message of the healthy arm, if the arm moves.

        Args:
            torque: Estimated external torques at the joints [N·m], (D,).
            velocity: Joint velocities [rad/s], (D,).
            damping: Damping of the joints that this estimate assumed [N·m·s/rad], (D,).
            dt: Time since the previous message [s].
        """
        if np.linalg.norm(velocity) < MOVING:
            return
        clipped = torque
        if self._time > LEAST_MOTION:
            bound = OUTLIER * np.sqrt(self._means[0])
            clipped = np.clip(torque, -bound, bound)
        opposed = velocity * (clipped + (self._stated.damping - damping) * velocity)
        self._time = min(self._time + dt, MEMORY)
        # A torque of exactly 0 means that the joint is at its stop, where τ_ext is unknown; keep
        # its σ and its damping.
        change = np.array([clipped**2, velocity**2, opposed]) - self._means
        self._means = self._means + dt / self._time * np.where(torque == 0.0, 0.0, change)
