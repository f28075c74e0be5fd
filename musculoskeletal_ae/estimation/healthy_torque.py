# SPDX-License-Identifier: Apache-2.0
"""Measures joint damping, and the external torque that is wrongly estimated without contact.

    σ_j² ← σ_j² + (dt / t_j) (τ_j² − σ_j²)
    d_j  = max(0, d_0,j − E[θ̇_j³ τ'_j] / (E[θ̇_j⁴] + SLOW⁴)),   τ'_j = τ_j + (d_0,j − d_j,used) θ̇_j

τ_j is the estimated external torque of joint j of the healthy moving arm, and σ_j its root mean
square. If the joint is damped more than the estimate assumed (d_j,used), τ_j opposes the velocity
θ̇_j. d_j is the damping that explains this best, and d_0,j that of the robot description. The weight
θ̇_j² makes d_j right for fast motion: d_j also stands for friction that does not grow with the
velocity. The means E are formed like σ_j². t_j is the time of motion in which τ_j was known, and at
most MEMORY.

`estimation/contact.py` divides the external torque by σ, which gives the evidence for contact d.
The largest d of each PERIOD is a peak of this period. The peaks of the last periods without contact
determine how large d has to be to indicate contact (`rare_peak`).

The estimator writes the measured damping into the network (`Mae.elasticity`), from which contact
detection and motion plans take it.
"""

import math
from collections import deque
from dataclasses import replace

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import LEAST_MOTION, rare_peak
from musculoskeletal_ae.robot.robot import Robot

MEMORY = 180.0  # average the squared torque over this much time in motion (time constant) [s]
MOVING = 0.05  # measure only while the norm of the joint velocities exceeds this [rad/s]
#: clip external torques to this multiple of σ before they enter the average, because larger ones
#: indicate contact
OUTLIER = 5.0
#: clip external torques to this multiple of σ before they change the damping, and leave out those
#: beyond OUTLIER: a push along or against the motion of a joint looks like damping. While the
#: damping is wrong, clipped torques still change it in the right direction.
PUSHED = 1.5
#: keep the damping of the description until the joint has moved faster than about this [rad/s]
SLOW = 0.1
#: average an adopted damping as if it had been measured at about this velocity [rad/s]
USUAL = 0.3
PERIOD = 10.0  # find the largest evidence for contact in periods with this much motion [s]
REMEMBERED = 30  # determine the threshold from the peaks of this many periods
#: Periods with contact are left out. If this many in a row had contact, the arm has changed, and
#: the threshold is too low: use their peaks.
MOST_LEFT_OUT = 30
LEAST_SPREAD = 1e-3  # store at least this σ in the network [N·m], because torques are divided by it


class HealthyTorque:
    """Measures the damping of the joints, and the external torque σ that remains unexplained.

    The averages cover the last minutes of motion, even if the network changed meanwhile. Nothing is
    measured until a network knows the friction of the tendons, which would count as damping.

    Attributes:
        threshold: Evidence for contact d above which there is contact; ∞ until the arm has moved
            enough with a network that contains its residual torque σ.
    """

    def __init__(self, robot: Robot) -> None:
        self._stated = robot.kinematics.elasticity
        self._means = np.zeros((3, robot.joint_count))  # means of τ², θ̇⁴ and θ̇³ τ'
        self._time = np.zeros(robot.joint_count)  # t_j [s]
        self._is_measuring = False
        self._peaks = deque[float](maxlen=REMEMBERED)
        self._left_out = list[
            float
        ]()  # peaks of the periods with contact since the last one without
        self.threshold = math.inf
        self._moved, self._largest = 0.0, 0.0  # of this period: time in motion [s], and largest d

    def put_into(self, mae: Mae) -> Mae:
        """Put the measured damping and residual torque σ into a copy of a network; return the copy.

        A network that contains no σ is returned unchanged. Before the first measurement, the values
        of the network are adopted instead, and later measurements are averaged with them. Damping
        needs as much motion as σ (`TouchStatistics.calibrated`). Until a
        joint has moved so much away from its stops, it keeps its damping, and its σ is at least
        those of the other joints.
        """
        known = mae.touch
        self._is_measuring = known is not None
        if known is None:
            return mae
        springs = mae.elasticity or self._stated
        if not self._time.any():
            if known.time == 0.0:
                return mae
            fourth = np.full_like(known.spread, USUAL**4)
            product = (fourth + SLOW**4) * (self._stated.damping - springs.damping)
            self._means = np.array([known.spread**2, fourth, product])
            self._time = np.full_like(known.spread, known.time)
            self._peaks.extend(known.peaks)
            self.threshold = rare_peak(known.peaks)
            return mae
        spread = np.maximum(np.sqrt(self._means[0]), LEAST_SPREAD)
        touch = replace(
            known, spread=spread, time=float(self._time.max()), peaks=np.array(self._peaks)
        )
        if not touch.calibrated:
            return replace(mae, touch=touch)
        enough = self._time >= LEAST_MOTION
        spread = np.where(enough, spread, np.maximum(spread, spread[enough].max()))
        _, fourth, product = self._means
        measured = np.maximum(self._stated.damping - product / (fourth + SLOW**4), 0.0)
        damping = np.where(enough, measured, springs.damping)
        return replace(
            mae,
            touch=replace(touch, spread=spread),
            elasticity=replace(springs, damping=damping),
        )

    def step(
        self,
        torque: Array,
        velocity: Array,
        damping: Array,
        dt: float,
        evidence: float = math.nan,
    ) -> None:
        """Update damping and residual torque with the estimate from one message, if the arm moves.

        The arm has to be healthy.

        Args:
            torque: Estimated external torques at the joints [N·m], (D,).
            velocity: Joint velocities [rad/s], (D,).
            damping: Damping of the joints that this estimate assumed [N·m·s/rad], (D,).
            dt: Time since the previous message [s]. A mean over time does not change in a step of
                0 s, as between two messages with the same time on /clock.
            evidence: The evidence for contact d; NaN if it is not known.
        """
        is_moving = dt > 0.0 and np.linalg.norm(velocity) >= MOVING
        if not self._is_measuring or not is_moving:
            return
        self._step_peak(evidence, dt)
        spread = np.where(self._time > LEAST_MOTION, np.sqrt(self._means[0]), np.inf)
        square = np.minimum(torque**2, (OUTLIER * spread) ** 2)
        clipped = np.clip(torque, -PUSHED * spread, PUSHED * spread)
        opposed = velocity**3 * (clipped + (self._stated.damping - damping) * velocity)
        # A torque of exactly 0 means that the joint is near a stop, where τ_ext is unknown; keep
        # its σ and its damping.
        measured = torque != 0.0
        self._time = np.minimum(self._time + dt * measured, MEMORY)
        share = measured * dt / np.maximum(self._time, dt)
        of_damping = share * (np.abs(torque) <= OUTLIER * spread)
        change = np.array([square, velocity**4, opposed]) - self._means
        self._means = self._means + np.array([share, of_damping, of_damping]) * change

    def _step_peak(self, evidence: float, dt: float) -> None:
        """Update the largest evidence of this period; at its end, update the threshold."""
        if math.isnan(evidence):
            return
        self._moved, self._largest = self._moved + dt, max(self._largest, evidence)
        if self._moved < PERIOD:
            return
        peak, self._moved, self._largest = self._largest, 0.0, 0.0
        if peak > self.threshold:
            self._left_out.append(peak)
            if len(self._left_out) < MOST_LEFT_OUT:
                return
            self._peaks.extend(self._left_out)
        else:
            self._peaks.append(peak)
        self._left_out.clear()
        self.threshold = rare_peak(np.array(self._peaks))
