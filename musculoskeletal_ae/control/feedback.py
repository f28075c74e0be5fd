# SPDX-License-Identifier: Apache-2.0
"""What is corrected while the arm rests: the estimated error, and needless tension."""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.command import Pull
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension

REPLAN = 5.0  # [N] change of a tension limit that a plan depends on, for which it is made anew
CORRECTION = 0.3  # [rad] at most, or times RACK [m]
#: [m] at most: by how much lengths can be off, and what friction keeps of a tendon wound in
RELIEF = 0.01
#: [rad] of estimated error that is left alone, or times RACK [m]: about the error of the estimate
#: itself, after which an arm with friction would creep for ever
DEADBAND = 0.03
BETWEEN = 0.1  # [s] between two programmes of which tension is needless
SETTLING = 0.5  # [s] after a movement until the arm counts as resting


def depends_on_limit(tension: Array, before: Array, limit: Array) -> bool:
    """Return whether tensions planned within one limit would be others within another limit.

    The limit of a warm muscle falls all the time. Few muscles pull as much, and a new plan would
    lose what the feedback has found out at this rest.

    Args:
        tension: Planned T [N], (M,).
        before: The limit that it was planned with [N], (M,).
        limit: The limit now [N], (M,).
    """
    depends = tension > np.minimum(before, limit) - REPLAN
    return bool(np.count_nonzero(depends & (np.abs(limit - before) > REPLAN)))


class RestFeedback:
    """Two slow integrals while the arm rests: of the estimated error, and of needless tension.

        dc/dt = gain (θ_target − θ_estimated),   |c| ≤ CORRECTION
        dr/dt = gain (T − T*)/K_stiff,           |r| ≤ RELIEF        where T > T*
              = gain min(T_end − T*, 0)/K_stiff                      elsewhere
        (T and T_end no further than T_bias to T_limit)
        T*    = argmin ‖T*‖²   subject to   Gᵀ T* = Gᵀ T_end,   T_bias ≤ T* ≤ T_limit
        l_target = ①(θ_target, T_planned) + G c + l_comp(T_planned) + r

    Friction and errors of the network leave the arm beside its target; the estimate sees most of
    that (arXiv 2405.11808). They also leave muscles that pull against each other: a tension that is
    commanded as a length is off by K_stiff times the error of the length. T* exerts the torque of T
    without friction, so that the relief moves no joint. A tendon that was wound in is paid out
    until friction keeps nothing of its tension. One that was paid out stays so, because the arm
    hangs on it by friction already.

    Attributes:
        correction: c [rad], (D,).
        relief: r [m], (M,).
        largest: Bound of the correction [rad], (D,).
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._deadband: Array = DEADBAND * robot.kinematics.radian
        self.largest: Array = CORRECTION * robot.kinematics.radian
        self.reset()
        self.moving()

    def use(self, robot: Robot) -> None:
        """Correct by this robot, whose isolated muscles pull nothing."""
        self._robot = robot

    def reset(self) -> None:
        """Forget the corrections: a new target."""
        self.correction: Array = np.zeros(self._robot.joint_count)
        self.relief: Array = np.zeros(self._robot.muscle_count)

    def moving(self) -> None:
        """Freeze the corrections until the arm has settled again."""
        self._rested = self._unsolved = 0.0

    def step(
        self, error: Array, jacobian: Array, pull: Pull, limit: Array, gain: float, dt: float
    ) -> bool:
        """Integrate over dt [s] if the arm rests; return whether it does.

        Args:
            error: θ_target − θ_estimated [rad], (D,).
            jacobian: G at the target [m/rad], (M, D).
            pull: How the muscles pull.
            limit: The highest tension planned [N], (M,).
            gain: [1/s]; 0 is no feedback.
            dt: Time since the last call [s].
        """
        self._rested += dt
        if self._rested <= SETTLING or gain == 0.0:
            return False
        beyond = np.where(np.abs(error) < self._deadband, 0.0, error)
        correction = self.correction + gain * dt * beyond
        self.correction = np.clip(correction, -self.largest, self.largest)
        self._unsolved += dt
        if self._unsolved >= BETWEEN:
            bias = self._robot.tension.bias
            share = gain * self._unsolved / self._robot.stiffness
            self._unsolved = 0.0
            bone = np.clip(pull.bone, bias, limit)
            least = least_tension(jacobian, -jacobian.T @ bone, bias, limit).tension
            motor = np.clip(pull.motor, bias, limit)
            needless = np.where(motor > least, motor - least, np.minimum(bone - least, 0.0))
            self.relief = np.clip(self.relief + share * needless, -RELIEF, RELIEF)
        return True

    def shift(self, jacobian: Array) -> Array:
        """Return what the corrections add to the lengths [m] (M,), by G (M, D) at the target."""
        return jacobian @ self.correction + self.relief
