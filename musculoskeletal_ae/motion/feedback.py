# SPDX-License-Identifier: Apache-2.0
"""Feedback: corrects the estimated posture error, and at rest reduces needless tension.

The feedback has one law while the arm moves and settles, and another one afterwards. Both shift
the desired posture (`Shift`), which acts in two ways (`tension_plan.TensionPlan`):

    l = ①(θ + δ, T),   −Gᵀ T = τ + k u,   k = SUPPORT σ/CORRECTION

δ shifts the posture whose lengths are commanded. A muscle at T_bias cannot pull less when its
commanded length grows. If few muscles pull with more than T_bias, δ therefore hardly changes the
joint torque in some directions, and friction can hold the arm in any posture along them. For this
reason, the planned tensions produce a torque k u in the direction of the shift u, in addition to τ,
the torque of the plan. At the bound of a shift, k u is SUPPORT times σ, the residual torque of the
healthy moving arm (`estimation/healthy_torque.py`). σ contains the friction and the errors of the
learned body that the arm has shown. A network that does not know σ supports no shift.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Setup
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.activities import Inputs
from musculoskeletal_ae.robot.tension import least_tension

#: plan again if a tension limit has changed by more than this [N], and a planned tension is nearer
#: to the limit than this
REPLAN = 5.0
CORRECTION = 0.3  # correct no joint by more than this [rad], because the estimate may be wrong
#: let planned tensions support a shift of CORRECTION by this multiple of the residual torque of the
#: healthy arm; a larger one hardly helps, and costs tension (notes/friction_limits.md)
SUPPORT = 2.0
#: Treat posture errors as 0 that are smaller than this [rad], or than the standard deviation of the
#: estimate: they may be errors of the estimate, and an arm with friction would never come to rest.
DEADBAND = 0.03
#: compute which tension is needless at intervals of at least this [s]
RELIEF_INTERVAL = 0.1
#: gain k_p of the feedback in motion: shift of the desired posture per posture error
PROPORTIONAL = 0.7
INTEGRAL = 4.0  # gain k_i of the feedback in motion, which removes lasting posture errors [1/s]
#: count the arm as resting once the feedback in motion has been off for this time [s]
SETTLING = 0.5


class Shift(NamedTuple):
    """A shift of the desired posture by the feedback."""

    length: Array  # δ: by this, the posture is shifted whose lengths are commanded [rad], (D,)
    torque: Array  # u: the planned tensions support this shift [rad], (D,)


def largest_support(mae: Mae) -> Array | float:
    """Return the torque SUPPORT σ by which planned tensions support a shift of CORRECTION.

    Args:
        mae: The network, which contains the residual torque σ of the healthy arm.

    Returns:
        The torques [N·m], (D,); 0 if the residual torque is not known.
    """
    if mae.touch is None or not mae.touch.calibrated:
        return 0.0
    torque: Array = SUPPORT * mae.touch.spread
    return torque


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


def _dead_band(mae: Mae) -> Array | float:
    """Return the errors [rad], (D,), below which the posture of a joint is not corrected."""
    if mae.covariance is None:
        return DEADBAND
    dead_band: Array = np.maximum(DEADBAND, np.sqrt(np.diag(mae.covariance)))
    return dead_band


class Feedback:
    """Corrects the posture, and reduces needless tension while the arm rests.

    While the arm moves along a trajectory and settles (`in_motion`), the shift of the desired
    posture follows from the error e of the estimated posture:

        δ = u = k_p e + c,   dc/dt = k_i e,   |c| ≤ CORRECTION

    The integral c persists from one motion to the next. While the limiter holds a muscle back, no
    entry of c grows, so that c does not wind up.

    While the arm rests (`at_rest`), δ is c, which begins at the last shift of the motion:

        dc/dt = gain (θ_target − θ_estimated),   |c| ≤ CORRECTION
        du/dt = gain (c − u)                     where the support helps
              = −gain u                          elsewhere
        dr/dt = gain (T − T*)/K_stiff,           |r| ≤ R             where T > T*
              = gain min(T_end − T*, 0)/K_stiff                      elsewhere
        (T and T_end are clipped to T_bias … T_limit; R is `Actuation.largest_relief`)
        T*    = argmin ‖T*‖²   subject to   Gᵀ T* = Gᵀ T_end,   T_bias ≤ T* ≤ T_limit
        l_target = ①(θ_target + c, T_planned) + l_comp(T_planned) + r

    T is the measured motor-side tension, T_end the bone-side tension, and T_planned the tension of
    the plan, which supports the shift u. ①(θ, T) is the network's prediction of the muscle lengths,
    G their derivative ∂l/∂θ.

    Correction c: because of friction and network errors, the arm comes to rest beside its target.
    The estimated posture shows most of this error (arXiv 2405.11808). Errors of a joint count as 0
    below DEADBAND, and below the standard deviation of its estimate: pushing against friction
    because of a wrong estimate costs tension and moves the arm away from its target.

    Supported shift u: the support helps a joint whose error counts and whose correction c is below
    its bound. It is released once the joint has arrived, because friction then holds the joint. It
    is also released if not even the bound of c moves the joint, because then it only costs tension.

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
        supported: u [rad], (D,).
        relief: r [m], (M,).
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self.reset()
        #: times since the arm moved, and since T* was computed [s]
        self._rested = self._unsolved = 0.0

    def reset(self) -> None:
        """Reset c, u and r to zero."""
        self.correction: Array = np.zeros(self._setup.robot.joint_count)
        self.supported: Array = np.zeros(self._setup.robot.joint_count)
        self.relief: Array = np.zeros(self._setup.robot.muscle_count)

    @property
    def shift(self) -> Shift:
        """The present shift of the held posture."""
        return Shift(self.correction, self.supported)

    def in_motion(self, error: Array, is_held_back: bool, dt: float) -> Shift:
        """Return the shift of the desired posture while the arm moves and settles.

        Args:
            error: Posture error, desired − estimated θ [rad], (D,).
            is_held_back: Whether the limiter holds a muscle back (`Follower._is_held_back`).
            dt: Time since the last call [s].
        """
        change = INTEGRAL * dt * error
        if is_held_back:
            change = np.where(change * self.correction >= 0.0, 0.0, change)
        self.correction = np.clip(self.correction + change, -CORRECTION, CORRECTION)
        # Bound the shift as well, so that a suddenly wrong estimate cannot move the arm far.
        shift = self.correction + PROPORTIONAL * error
        self.supported = np.clip(shift, -CORRECTION, CORRECTION)
        self._rested = self._unsolved = 0.0
        return Shift(self.supported, self.supported)

    def come_to_rest(self) -> None:
        """Begin the feedback at rest with the shift that the desired posture had last in motion."""
        self.correction = self.supported

    def at_rest(self, error: Array, jacobian: Array, inputs: Inputs, gain: float) -> None:
        """Integrate the errors since the last step once the arm has settled.

        Args:
            error: Posture error θ_target − θ_estimated [rad], (D,).
            jacobian: Muscle Jacobian G at the target [m/rad], (M, D).
            inputs: The network, tensions, their limit, and the time since the last step.
            gain: Integral gain [1/s]; 0 for no feedback.
        """
        dt, limit = inputs.dt, inputs.limit
        self._rested += dt
        if self._rested <= SETTLING or gain == 0.0:
            return
        is_off = np.abs(error) >= _dead_band(inputs.mae)
        beyond = np.where(is_off, error, 0.0)
        correction = self.correction + gain * dt * beyond
        self.correction = np.clip(correction, -CORRECTION, CORRECTION)
        self._unsolved += dt
        if self._unsolved >= RELIEF_INTERVAL and self._setup.robot.tension_source.is_known:
            actuation, bias = self._setup.robot.actuation, self._setup.robot.tension.bias
            lowest, largest = actuation.kept_tension, actuation.largest_relief
            change = gain * self._unsolved
            share = change / actuation.tension_per_length(inputs.motor_tension)
            self._unsolved = 0.0
            helps = is_off & (np.abs(self.correction) < CORRECTION)
            goal = np.where(helps, self.correction, 0.0)
            self.supported = self.supported + change * (goal - self.supported)
            bone = np.clip(inputs.bone_tension, lowest, limit)
            least = least_tension(jacobian, -jacobian.T @ bone, bias, limit).tension
            motor = np.clip(inputs.motor_tension, lowest, limit)
            needless = np.where(motor > least, motor - least, np.minimum(bone - least, 0.0))
            self.relief = np.clip(self.relief + share * needless, -largest, largest)
