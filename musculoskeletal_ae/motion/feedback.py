# SPDX-License-Identifier: Apache-2.0
"""Feedback: corrects the estimated posture error, and at rest reduces needless tension.

`MotionFeedback` works while the arm moves and settles, `RestFeedback` afterwards.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.command import Pull
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import least_tension

#: plan again if a tension limit has changed by more than this [N], and a planned tension is nearer
#: to the limit than this
REPLAN = 5.0
CORRECTION = 0.3  # correct no joint by more than this [rad], because the estimate may be wrong
#: treat smaller posture errors as 0 [rad]: they are about as large as the error of the estimate,
#: and an arm with friction would otherwise never come to rest
DEADBAND = 0.03
#: compute which tension is needless at intervals of at least this [s]
RELIEF_INTERVAL = 0.1
#: gain k_p of the feedback in motion: shift of the desired posture per posture error
PROPORTIONAL = 0.7
INTEGRAL = 4.0  # gain k_i of the feedback in motion, which removes lasting posture errors [1/s]
#: count the arm as resting once the feedback in motion has been off for this time [s]
SETTLING = 0.5


def depends_on_limit(tension: Array, before: Array, limit: Array) -> bool:
    """Return whether a changed tension limit requires a new plan.

    The limit of a warm muscle falls continuously. Only tensions near their limit depend on it, and
    an unnecessary new plan would discard the corrections of the feedback.

    Args:
        tension: Planned tensions T [N], (M,).
        before: Limit at the time of planning [N], (M,).
        limit: Present limit [N], (M,).
    """
    depends = tension > np.minimum(before, limit) - REPLAN
    return bool(np.count_nonzero(depends & (np.abs(limit - before) > REPLAN)))


class RestFeedback:
    """Slowly corrects the posture and reduces needless tension while the arm rests.

        dc/dt = gain (θ_target − θ_estimated),   |c| ≤ CORRECTION
        dr/dt = gain (T − T*)/K_stiff,           |r| ≤ R             where T > T*
              = gain min(T_end − T*, 0)/K_stiff                      elsewhere
        (T and T_end are clipped to T_bias … T_limit; R is `Actuation.largest_relief`)
        T*    = argmin ‖T*‖²   subject to   Gᵀ T* = Gᵀ T_end,   T_bias ≤ T* ≤ T_limit
        l_target = ①(θ_target, T_planned) + G c + l_comp(T_planned) + r

    T is the measured motor-side tension, T_end the bone-side tension, and T_planned the tension of
    the plan. ①(θ, T) is the network's prediction of the muscle lengths, G their derivative ∂l/∂θ.

    Correction c: because of friction and network errors, the arm comes to rest beside its target.
    The estimated posture shows most of this error (arXiv 2405.11808). Errors below DEADBAND count
    as 0.

    Relief r: friction and network errors also make antagonistic muscles pull against each other,
    because a length error causes a tension error of K_stiff times the length error. T* exerts the
    same joint torque as T_end, so that the relief moves no joint. If a tendon has more tension than
    T* at the motor, it is paid out. If it has less than T* at the bone, it is wound in. A tendon
    between these two cases remains as it is, because friction supports the arm there.

    Position-controlled modules do not hold T_bias. For them, K_stiff is the stiffness of the
    series elastic element, and T may be below T_bias. Their R is larger, so that slack tendons can
    be wound in.

    Attributes:
        correction: c [rad], (D,).
        relief: r [m], (M,).
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.reset()
        self.moving()

    def use(self, robot: Robot) -> None:
        """Use another robot description.

        `robot` must already describe isolated muscles as muscles without tension.
        """
        self._robot = robot

    def reset(self) -> None:
        """Reset the corrections c and r to zero."""
        self.correction: Array = np.zeros(self._robot.joint_count)
        self.relief: Array = np.zeros(self._robot.muscle_count)

    def moving(self) -> None:
        """Record that the arm moves, which interrupts the integration until it has settled."""
        self._rested = self._unsolved = 0.0

    def step(
        self, error: Array, jacobian: Array, pull: Pull, limit: Array, gain: float, dt: float
    ) -> bool:
        """Integrate the errors over dt [s] if the arm rests; return whether this was done.

        Args:
            error: Posture error θ_target − θ_estimated [rad], (D,).
            jacobian: Muscle Jacobian G at the target [m/rad], (M, D).
            pull: Tensions of the muscles.
            limit: Highest tension that may be planned [N], (M,).
            gain: Integral gain [1/s]; 0 for no feedback.
            dt: Time since the last call [s].
        """
        self._rested += dt
        if self._rested <= SETTLING or gain == 0.0:
            return False
        beyond = np.where(np.abs(error) < DEADBAND, 0.0, error)
        correction = self.correction + gain * dt * beyond
        self.correction = np.clip(correction, -CORRECTION, CORRECTION)
        self._unsolved += dt
        if self._unsolved >= RELIEF_INTERVAL and self._robot.tension_source.is_known:
            actuation, bias = self._robot.actuation, self._robot.tension.bias
            lowest, largest = actuation.kept_tension, actuation.largest_relief
            share = gain * self._unsolved / actuation.tension_per_length(pull.motor)
            self._unsolved = 0.0
            bone = np.clip(pull.bone, lowest, limit)
            least = least_tension(jacobian, -jacobian.T @ bone, bias, limit).tension
            motor = np.clip(pull.motor, lowest, limit)
            needless = np.where(motor > least, motor - least, np.minimum(bone - least, 0.0))
            self.relief = np.clip(self.relief + share * needless, -largest, largest)
        return True

    def shift(self, jacobian: Array) -> Array:
        """Return the correction of the lengths, G c + r [m], (M,).

        Args:
            jacobian: Muscle Jacobian G at the target [m/rad], (M, D).
        """
        return jacobian @ self.correction + self.relief


class MotionFeedback:
    """Corrects the estimated posture error e while the arm moves along a trajectory and settles.

    The desired posture is shifted by k_p e + c, with dc/dt = k_i e and the gains k_p and k_i. The
    integral c is stored in the rest feedback (`RestFeedback.correction`) and therefore persists
    from one motion to the next. While the limiter holds a muscle back, no entry of c grows, so that
    c does not wind up.
    """

    def __init__(self, rest: RestFeedback) -> None:
        self._rest = rest
        #: present shift of the desired posture [rad], (D,)
        self._shift: Array = np.zeros_like(rest.correction)

    def step(self, error: Array, is_held_back: bool, dt: float) -> Array:
        """Return the angles [rad], (D,), by which to shift the desired posture.

        Args:
            error: Posture error, desired − estimated θ [rad], (D,).
            is_held_back: Whether the limiter holds a muscle back (`Follower._is_held_back`).
            dt: Time since the last call [s].
        """
        rest = self._rest
        change = INTEGRAL * dt * error
        if is_held_back:
            change = np.where(change * rest.correction >= 0.0, 0.0, change)
        rest.correction = np.clip(rest.correction + change, -CORRECTION, CORRECTION)
        rest.moving()
        # Bound the shift as well, so that a suddenly wrong estimate cannot move the arm far.
        shift = rest.correction + PROPORTIONAL * error
        self._shift = np.clip(shift, -CORRECTION, CORRECTION)
        return self._shift

    def continue_at_rest(self) -> None:
        """Use the present shift as the correction from which the rest feedback continues."""
        self._rest.correction = self._shift
