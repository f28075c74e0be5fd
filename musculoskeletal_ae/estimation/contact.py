# SPDX-License-Identifier: Apache-2.0
"""Estimates the external load of the arm: joint torques, the force at the hand, and contact.

    τ_ext = M(θ) θ̈ + h(θ, θ̇) + Gᵀ T_end,   T_end = T e^{−μ s}
    F     = argmin Σ_j ((JᵀF − τ_ext)_j / σ_j)² + ‖F‖²/F₀²,   without a moment at the hand
    d     = √(Σ_j (τ_ext,j / σ_j)²),   contact: d > d_max in two consecutive messages

τ_ext is the external torque at the joints, F the force at the hand, and d the evidence for contact.
M is the inertia matrix, G the muscle Jacobian ∂l/∂θ, and J the Jacobian of the hand. h contains the
torques due to velocity and weight, and those of the joints' springs and dampers. The bone-side
tension T_end follows from the measured tension T, tendon friction μ, and the direction s in which a
tendon slid last (`signals/friction.py`). σ is the residual torque of the healthy moving arm, and
d_max is the threshold that d exceeds without contact about once in 10 h; both are measured
(`estimation/healthy_torque.py`). The term with F₀ limits components of F that produce no joint
torque, such as the component along a stretched arm.

θ and Gᵀ T_end pass through the same second-order low-pass filter, which also yields θ̇ and θ̈. The
result is the residual of the momentum observer (De Luca 2005), without numerical differentiation
of noise. Tendon friction has to be known: unknown friction hides a contact force of 10 N.

At a joint limit, the unknown torque of the stop is added to τ_ext. The τ_ext of a joint within
AT_STOP of its limits therefore counts as 0.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import rare_peak
from musculoskeletal_ae.robot.robot import Robot

#: filter joint angles and torques with this bandwidth ω [1/s] and a damping ratio of 0.5; critical
#: damping would make the filter a third slower
BANDWIDTH = 25.0
LARGEST_USUAL = 20.0  # F₀: expect no larger force than this at the hand in normal use [N]
#: regularise the estimated force F with ‖F‖²/F₀² [1/N²], so that components that produce no joint
#: torque stay small
REGULARISATION = np.eye(3) / LARGEST_USUAL**2
#: assume that a joint may rest against its stop within this distance from its limit [rad], which is
#: roughly the error of an estimated angle
AT_STOP = 0.06
#: evaluate the muscle Jacobian G again once a joint has moved by this much [rad], not at every
#: message, because G changes slowly
TURNED = 0.02
IN_A_ROW = 2  # report contact once d exceeds its threshold in this many consecutive messages


class Contact(NamedTuple):
    """External load estimated from one message.

    Attributes:
        torque: External torques at the joints [N·m], (D,); 0 for joints near a stop, whose torque
            is unknown.
        force: Function that computes the force [N], (3,), which acts on the origin of the end
            effector, in the axes of the root link. It is a function because few callers need the
            force.
        distance: Root sum square of the torques, each divided by its standard deviation on the
            healthy arm; NaN if this deviation is not calibrated, or if a reading is not finite.
        is_contact: Whether `distance` has exceeded its threshold in two consecutive messages
            (IN_A_ROW).
    """

    torque: Array
    force: Callable[[], Array]
    distance: float
    is_contact: bool


class LowPass:
    """A second-order low-pass filter that also returns the derivatives of its output.

        ÿ = ω (ω (u − y) − ẏ)

    u is the input, y the output, and ω the bandwidth [1/s].
    """

    def __init__(self, bandwidth: float) -> None:
        self._bandwidth = bandwidth
        self._value: Array | None = None
        self._rate: Array = np.zeros(0)

    def reset(self) -> None:
        """Reset the filter. It starts from the value of the next input, with derivatives of 0."""
        self._value = None

    def step(self, value: Array, dt: float) -> tuple[Array, Array, Array]:
        """Filter an input that arrives dt [s] after the previous one.

        The equation is integrated by the implicit Euler method, which is stable at any dt.

        Returns:
            The output y, its first derivative ẏ and its second derivative ÿ, each of the shape of
            `value`.
        """
        if self._value is None:
            self._value, self._rate = value, np.zeros_like(value)
        share = self._bandwidth * dt
        damping = 1.0 / (1.0 + share + share**2)
        rate = damping * self._rate + damping * self._bandwidth * share * (value - self._value)
        acceleration = (rate - self._rate) / max(dt, 1e-6)
        self._value, self._rate = self._value + dt * rate, rate
        return self._value, rate, acceleration


class ContactEstimator:
    """Estimates the external load message by message. `use` must be called before `step`.

    Attributes:
        velocity: Filtered joint velocities θ̇ [rad/s], (D,).
        damping: Damping of the joints in the network [N·m·s/rad], (D,).
        is_calibrated: Whether the network contains the residual torque σ, without which there is no
            evidence for contact.
        threshold: Report contact if the evidence d exceeds this (d_max). It is ∞ until the arm has
            moved enough. Owners that measure the healthy torque themselves update it.
        count: Number of contacts detected so far.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._middle = 0.5 * (robot.lower + robot.upper)
        self._reach = 0.5 * (robot.upper - robot.lower) - AT_STOP
        self._filter = LowPass(BANDWIDTH)
        self.threshold = math.inf
        self.is_calibrated = False
        self.count = 0
        self.reset()

    def use(self, mae: Mae) -> None:
        """Use another network, and its joint springs, dampers and residual torque σ (`mae.touch`).

        Without calibrated statistics, external torques are estimated, but no contact is reported.
        """
        joint_count, healthy = self._robot.joint_count, mae.touch
        self._robot = self._robot.with_elasticity(mae.elasticity)
        self.damping = self._robot.kinematics.elasticity.damping
        self._mae = mae
        self._evaluated_at = np.full(joint_count, np.inf)  # θ at which G was evaluated last
        self._weight = np.ones(joint_count)  # 1/σ², (D,); 1 without a calibrated σ
        self.threshold = math.inf
        self.is_calibrated = healthy is not None and healthy.calibrated
        if healthy is not None and self.is_calibrated:
            self._weight = 1.0 / healthy.spread**2
            self.threshold = rare_peak(healthy.peaks)

    def reset(self) -> None:
        """Reset the filter, for example after a jump of the clock."""
        self._filter.reset()
        self.velocity: Array = np.zeros(self._robot.joint_count)
        self._beyond = 0  # how many consecutive messages had d above its threshold

    def step(self, theta: Array, end_tension: Array, dt: float) -> Contact:
        """Step the filter by one message, and return the external load.

        Args:
            theta: Joint angles [rad], (D,).
            end_tension: Bone-side tensions [N], (M,).
            dt: Time since the previous message [s].
        """
        kinematics, joint_count = self._robot.kinematics, len(theta)
        near = np.abs(theta - self._evaluated_at) <= TURNED
        if np.count_nonzero(near) < joint_count:  # also true if θ is NaN
            self._jacobian = self._mae.muscle_jacobian(theta, end_tension)
            self._evaluated_at = theta
        moments = end_tension @ self._jacobian  # Gᵀ T_end
        smooth, rate, acceleration = self._filter.step(np.concatenate((theta, moments)), dt)
        position, self.velocity = smooth[:joint_count], rate[:joint_count]
        torque = kinematics.inverse_dynamics(position, self.velocity, acceleration[:joint_count])
        torque += smooth[joint_count:]
        is_free = np.abs(position - self._middle) < self._reach
        torque *= is_free
        if not math.isfinite(torque @ torque):
            self.reset()
            return Contact(np.zeros(joint_count), lambda: np.zeros(3), math.nan, False)
        distance = math.nan
        if self.is_calibrated:
            distance = math.sqrt(self._weight @ (torque * torque))
        self._beyond = self._beyond + 1 if distance > self.threshold else 0
        self.count += self._beyond == IN_A_ROW
        force = partial(self._force, position, torque, self._weight * is_free)
        return Contact(torque, force, distance, self._beyond >= IN_A_ROW)

    def _force(self, theta: Array, torque: Array, weight: Array) -> Array:
        jacobian = self._robot.kinematics.end_effector_jacobian(theta)[:3]
        weighted = jacobian * weight
        normal = weighted @ jacobian.T + REGULARISATION
        force: Array = np.linalg.inv(normal) @ (weighted @ torque)
        return force
