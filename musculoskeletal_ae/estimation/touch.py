# SPDX-License-Identifier: Apache-2.0
"""What pushes the arm from outside: joint torques, the hand's force, and whether that is contact.

    τ_ext = M(θ) θ̈ + h(θ, θ̇) + Gᵀ T_end,   T_end = T e^{−μ s}
    F     = argmin Σ_j ((JᵀF − τ_ext)_j / σ_j)² + ‖F‖²/F₀²,   the hand's torque taken as zero
    d     = √(Σ_j (τ_ext,j / σ_j)²),   contact: d > CONTACT in IN_A_ROW messages running

θ and Gᵀ T_end pass the same low pass of second order, whose states are θ, θ̇ and θ̈; so what is left
is the momentum observer's residual (De Luca 2005), without differences of noise. μ is how much of
the tension each wire loses on its way, as the learner found it, s which way it slid last: without
that, friction hides a push of 10 N. σ is what a healthy moving arm leaves (`TouchStatistics`). F₀
keeps a force small that the joints do not feel, as along a stretched arm. At its stop a joint says
nothing of torques away from it, which are the stop's own; one towards it is at least what is felt.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.friction import FrictionDirection
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.residuals import LEAST_MOTION
from musculoskeletal_ae.robot.robot import Robot

#: [1/s] of the low pass, whose damping is a half: critically damped it is a third slower to rise
BANDWIDTH = 25.0
LARGEST_USUAL = 20.0  # F₀ [N]
SMALL = np.eye(3) / LARGEST_USUAL**2
#: [rad], or times RACK [m], from a joint limit: what the estimate may be off by
AT_STOP = 0.06
TURNED = 0.02  # [rad], or times RACK [m], by which joints turn until G is taken anew
#: d of five healthy arms that explored for ten minutes each reached 8.6
CONTACT, IN_A_ROW = 10.0, 2


class Touch(NamedTuple):
    """What one message says of the outside."""

    torque: Array  # τ_ext [N·m], (D,); 0 where a stop bears the joint
    #: F on the end effector's origin, axes of the root link [N], (3,), made where it is asked for
    force: Callable[[], Array]
    distance: float  # d; NaN without statistics
    contact: bool


class ExternalTorque:
    """Steps the observer; a network is needed first."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._middle = 0.5 * (robot.lower + robot.upper)
        self._reach = 0.5 * (robot.upper - robot.lower) - AT_STOP * robot.kinematics.radian
        self._near = TURNED * robot.kinematics.radian
        self.reset()

    def use(self, mae: Mae) -> None:
        """Take a network, and what it says of friction and of a healthy arm's residual."""
        self._mae, touch = mae, mae.touch
        self.calibrated = touch is not None and touch.calibrated
        self._turned = np.full(self._robot.joint_count, np.inf)  # where G was taken
        self._weight = np.ones(self._robot.joint_count)
        if touch is not None and self.calibrated:
            self._weight = 1.0 / touch.spread**2

    def reset(self) -> None:
        """Forget the past, as after a jump of the clock."""
        self._value: Array | None = None
        self.velocity: Array = np.zeros(self._robot.joint_count)  # θ̇ [rad/s], (D,)
        self._beyond = 0

    def step(self, theta: Array, end_tension: Array, dt: float) -> Touch:
        """Take estimated θ [rad] (D,) and T_end [N] (M,), dt [s] after those before."""
        kinematics, joints = self._robot.kinematics, len(theta)
        near = np.abs(theta - self._turned) <= self._near
        if np.count_nonzero(near) < joints:  # not a number, too
            self._jacobian, self._turned = self._mae.muscle_jacobian(theta, end_tension), theta
        now: Array = np.concatenate((theta, end_tension @ self._jacobian))
        if self._value is None:
            self._value, self._rate = now, np.zeros_like(now)
        # Implicit Euler: stable however late a message is.
        share = BANDWIDTH * dt
        less = 1.0 / (1.0 + share + share**2)
        rate = less * self._rate + less * BANDWIDTH * share * (now - self._value)
        acceleration = (rate - self._rate)[:joints] / max(dt, 1e-6)
        self._value, self._rate = self._value + dt * rate, rate
        smooth, self.velocity = self._value[:joints], rate[:joints]
        torque = kinematics.inverse_dynamics(smooth, self.velocity, acceleration)
        torque += self._value[joints:]
        out = smooth - self._middle
        free = (np.abs(out) < self._reach) | (torque * out > 0.0)
        torque *= free
        if not math.isfinite(torque @ torque):
            self.reset()
            return Touch(np.zeros(joints), lambda: np.zeros(3), math.nan, False)
        distance = math.sqrt(self._weight @ (torque * torque)) if self.calibrated else math.nan
        self._beyond = self._beyond + 1 if distance > CONTACT else 0
        force = partial(self._force, smooth, torque, self._weight * free)
        return Touch(torque, force, distance, self._beyond >= IN_A_ROW)

    def _force(self, theta: Array, torque: Array, weight: Array) -> Array:
        jacobian = self._robot.kinematics.end_effector_jacobian(theta)[:3]
        weighted = jacobian * weight
        force: Array = np.linalg.inv(weighted @ jacobian.T + SMALL) @ (weighted @ torque)
        return force


# -- what a healthy arm leaves --------------------------------------------------------------------

MEMORY = 180.0  # [s] of motion whose torques count
MOVING = 0.05  # [rad/s], or times RACK [m/s], of all joints together, below which an arm rests
#: spreads beyond which a torque counts as if it were there: somebody touched the arm
OUTLIER = 5.0
LEAST_SPREAD = 1e-3  # [N·m]


class HealthyTorque:
    """The external torque that a healthy arm in motion seems to have, of the last minutes."""

    def __init__(self, robot: Robot) -> None:
        """Start with nothing; a network is needed first."""
        self._observer, self._direction = ExternalTorque(robot), FrictionDirection()
        self._radian = robot.kinematics.radian
        self.start()

    def start(self) -> None:
        """Begin anew, as for another arm."""
        self._square, self._time = np.zeros_like(self._radian), 0.0

    def use(self, mae: Mae) -> Mae:
        """Go on with a network; return it with what is known of the arm, if it has a body."""
        if (touch := mae.touch) is None:
            self._mae = mae
        else:
            if self._time == 0.0:
                self._square, self._time = touch.spread**2, touch.time
            spread = np.maximum(np.sqrt(self._square), LEAST_SPREAD)
            self._mae = replace(mae, touch=replace(touch, spread=spread, time=self._time))
        self._observer.use(self._mae)
        return self._mae

    def reset(self) -> None:
        """Forget the past, as after a jump of the clock."""
        self._observer.reset()
        self._direction.reset()

    def step(self, tension: Array, length: Array, dt: float) -> None:
        """Take T [N] and l [m] (M,) of a healthy arm, dt [s] after those before."""
        end = self._direction.end_tension(self._mae.friction, tension, length)
        theta = self._mae.estimate(end, length).theta
        torque = self._observer.step(theta, end, dt).torque
        if np.linalg.norm(self._observer.velocity / self._radian) < MOVING:
            return
        square = torque**2
        if self._time > LEAST_MOTION:
            square = np.minimum(square, OUTLIER**2 * self._square)
        self._time = min(self._time + dt, MEMORY)
        change = np.where(torque == 0.0, 0.0, square - self._square)  # those at a stop say nothing
        self._square = self._square + dt / self._time * change
