# SPDX-License-Identifier: Apache-2.0
"""Checks that the load of a resting arm stays as it is.

    τ   = average of τ_ext over AVERAGING,   τ_0 = average of τ over FOLLOWING
    d   = min ‖(τ − τ_0 − m τ_hand) / σ‖ over m ≥ −m_0
    the load of the resting arm has changed:  d > CHANGED

Feedback often keeps an arm at its target although its base is turned, or something touches it. The
external torque τ_ext then shows this (`estimation/contact.py`). σ is the residual torque of the
healthy moving arm. Errors of the learned body cause a lasting τ_ext, which differs from posture to
posture and is up to 4 σ on healthy arms of emulator model `foreign`. It changes little while the
arm rests, and slowly: feedback relieves tension, and the network learns. Therefore τ is compared
with τ_0, which begins with τ after REFERENCE and then follows it slowly, except while the load has
changed. With another network, τ_0 begins anew, and τ − τ_0 continues from its last value.

An arm may pick up a payload, or put it down. τ_hand is the torque of 1 kg in the hand, m_0 the mass
that explains the most of τ_0, and m the mass that explains the most of the change. In a single
posture, a base that is turned causes the same torques as a force on the hand, so both are possible
causes.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.estimation.contact import ContactEstimator
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

AVERAGING = 1.0  # average the external torque of the resting arm with this time constant [s]
REFERENCE = 3.0  # begin the comparison after this time at rest [s], when the arm has settled
FOLLOWING = 30.0  # let the reference follow slow changes with this time constant [s]
#: Report a changed load if the external torque of the resting arm has changed by more than this,
#: in σ. On six individuals that had learned for 180 s (kin 1, 3, 4 and foreign 1, 2, 3), it changed
#: by at most 1.7 in eight rests each. A turned base changed it by 3.4 to 6.0 on those of kin, 1 s
#: after the turn.
CHANGED = 3.0
#: causes of a changed load that a report lists
POSSIBLE_CAUSES = (
    'possible causes: a contact, a payload that is not in the first hand, a base that has been '
    'turned, or a muscle that pulls more or less than its sensor reads'
)


class RestingLoad:
    """Compares the external torque of a resting arm with that of earlier in the same rest.

    Attributes:
        change: Change of the external torque in this rest that no payload explains, divided by σ,
            (D,); 0 while it is unknown.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._contact = ContactEstimator(robot)
        self._spread: Array | None = None  # σ [N·m], (D,); None if it is not known
        self._begin(None)

    def _begin(self, target: Array | None) -> None:
        """Begin a rest at another target, or a motion (None): the load may be another one."""
        joints = self._robot.joint_count
        self._contact.reset()
        self._target = target
        self._rested = 0.0  # time for which the arm has rested [s]
        self._torque: Array = np.zeros(joints)  # τ [N·m], (D,)
        self._reference: Array | None = None  # τ_0 [N·m], (D,); None early in a rest
        self._carried: Array = np.zeros(joints)  # τ − τ_0 when τ_0 begins [N·m], (D,)
        # whether each joint has been away from its stops during this rest, (D,)
        self._is_free: Bools = np.ones(joints, bool)
        self.change: Array = np.zeros(joints)

    def use(self, mae: Mae) -> None:
        """Use another network, and the residual torque σ that it contains."""
        self._contact.use(mae)
        self._spread = None
        if mae.touch is not None and mae.touch.calibrated:
            self._spread = mae.touch.spread
        # Another network computes other torques from the same load.
        carried, change = self._carried, self.change
        if self._reference is not None:
            carried = self._torque - self._reference
        self._begin(self._target)
        if self._spread is not None:
            self._carried, self.change = carried, change

    def step(
        self, target: Array | None, theta: Array | None, pull: Array | None, dt: float
    ) -> None:
        """Update the load of the arm.

        Args:
            target: Posture at which the arm should rest [rad], (D,); None if it need not rest.
            theta: Estimated posture [rad], (D,); None if it is unknown.
            pull: Bone-side tensions [N], (M,); None if they are unknown.
            dt: Time since the last call [s].
        """
        if target is None:
            if self._target is not None:
                self._begin(None)
            return
        if self._target is None or not np.array_equal(target, self._target):
            self._begin(target)
        if theta is not None and pull is not None and self._spread is not None:
            self._compare(theta, pull, dt, self._spread)

    def _compare(self, theta: Array, pull: Array, dt: float, spread: Array) -> None:
        self._rested += dt
        torque = self._contact.step(theta, pull, dt).torque
        self._is_free &= torque != 0.0  # a torque of 0 is that of a joint near a stop
        self._torque = self._torque + dt / (dt + AVERAGING) * (torque - self._torque)
        if self._reference is None:
            if self._rested > REFERENCE:
                self._reference = self._torque - self._carried
            return
        kinematics = self._robot.kinematics
        of_hand = kinematics.model.gravity.linear @ kinematics.end_effector_jacobian(theta)[:3]
        of_hand = self._is_free * of_hand / spread
        change = self._is_free * (self._torque - self._reference) / spread
        square = float(of_hand @ of_hand)
        if square > 0.0:
            before = max(float(of_hand @ (self._reference / spread)), 0.0)  # m_0, times `square`
            mass = max(float(of_hand @ change), -before) / square
            change = change - mass * of_hand
        self.change = change
        if not self.has_changed:
            step = dt / (dt + FOLLOWING)
            self._reference = self._reference + step * (self._torque - self._reference)

    @property
    def has_changed(self) -> bool:
        """Whether the load of the arm has changed while it rests."""
        return float(np.linalg.norm(self.change)) > CHANGED

    @property
    def text(self) -> str:
        """A text: the joint whose torque has changed most, by how much, and possible causes.

        The text is empty while σ is unknown.
        """
        if self._spread is None:
            return ''
        joint, robot = int(np.abs(self.change).argmax()), self._robot
        torque = robot.units[joint].torque_text(float((self.change * self._spread)[joint]))
        return f'{robot.joints[joint]} {torque}; {POSSIBLE_CAUSES}'
