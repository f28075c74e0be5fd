# SPDX-License-Identifier: Apache-2.0
"""Checks that an arm which holds a posture is where it should be, and holds what it should hold.

    e = max_j |θ_target − θ_estimated|_j
    the arm is away from its target:  e > AWAY, or e > e_least + CARRIED, for LASTING

    τ   = average of τ_ext over AVERAGING,   τ_0 = average of τ over FOLLOWING
    d   = min ‖(τ − τ_0 − m τ_hand) / σ‖ over m ≥ −m_0
    the load of the resting arm has changed:  d > CHANGED

e is computed from the end of a motion on, and e_least is its smallest value since then. The check
is off while the arm moves, and while a user demands a torque in addition to gravity compensation,
because the arm then need not rest at its target.

Friction leaves healthy arms at a distance that is smaller than AWAY, see
doc/explanation/control_and_safety.md. Friction never moves an arm away from where it has rested. A
payload, a contact, weak or lost muscles, or a base that is mounted otherwise than in `robot.urdf`
can do so.

Feedback often keeps the arm at its target despite such a load. The external torque τ_ext then shows
the load (`estimation/contact.py`); σ is the residual torque of the healthy moving arm. Errors of
the learned body cause a lasting τ_ext, which differs from posture to posture and is up to 4 σ on
healthy arms of emulator model `foreign`. They change little while the arm rests, and slowly:
feedback relieves tension, and the network learns. Therefore τ is compared with τ_0, which begins
with τ after REFERENCE and then follows it slowly, except while the load has changed. With another
network, τ_0 begins anew, and τ − τ_0 continues from its last value.

An arm may pick up a payload, or put it down. τ_hand is the torque of 1 kg in the hand, m_0 the mass
that explains the most of τ_0, and m the mass that explains the most of the change. In a single
posture, a base that is turned causes the same torques as a force on the hand, so both are possible
causes.
"""

from __future__ import annotations

import math

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.estimation.contact import ContactEstimator
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion import reach
from musculoskeletal_ae.robot.robot import Robot

#: report a joint that rests further than this away from its target [rad]; tendon friction alone
#: leaves healthy arms nearer
AWAY = 0.5
#: report a joint whose distance from its target has grown by more than this while the arm rests
#: [rad]; updates of the network change the estimate of a healthy resting arm by up to 0.19 rad
CARRIED = 0.25
LASTING = 5.0  # report a joint only once it has been away for this time [s]
AVERAGING = 1.0  # average the external torque of the resting arm with this time constant [s]
REFERENCE = 3.0  # begin the comparison after this time at rest [s], when the arm has settled
FOLLOWING = 30.0  # let the reference follow slow changes with this time constant [s]
#: Report a changed load if the external torque of the resting arm has changed by more than this,
#: in σ. On six individuals that had learned for 180 s (kin 1, 3, 4 and foreign 1, 2, 3), it changed
#: by at most 1.7 in eight rests each. A turned base changed it by 3.4 to 6.0 on those of kin,
#: 1 s after the turn.
CHANGED = 3.0
#: causes that a report lists unless the muscles evidently lack torque in this posture
POSSIBLE_CAUSES = (
    'possible causes: a payload or contact, tendon friction, a muscle that pulls less than its '
    'sensor reads, or a base that is mounted otherwise than in robot.urdf'
)
#: causes of a changed load that a report lists
LOAD_CAUSES = (
    'possible causes: a contact, a payload that is not in the first hand, a base that has been '
    'turned, or a muscle that pulls more or less than its sensor reads'
)


class HoldingCheck:
    """Compares the estimated posture of a resting arm with its target.

    Attributes:
        distance: θ_target − θ_estimated [rad], (D,), while the arm rests at the end of a motion;
            None otherwise.
        load: Change of the external torque in this rest that no payload explains, divided by σ,
            (D,); 0 while it is unknown.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._contact = ContactEstimator(robot)
        self._spread: Array | None = None  # σ [N·m], (D,); None if it is not known
        self._rested = 0.0  # time for which the arm has rested [s]
        self._target: Array | None = None  # posture at which the arm rests [rad], (D,)
        self._torque: Array = np.zeros(robot.joint_count)  # τ [N·m], (D,)
        self._reference: Array | None = None  # τ_0 [N·m], (D,); None early in a rest
        self._carried: Array = np.zeros(robot.joint_count)  # τ − τ_0 when τ_0 begins [N·m], (D,)
        # whether each joint has been away from its stops during this rest, (D,)
        self._is_free: Bools = np.ones(robot.joint_count, bool)
        self.load: Array = np.zeros(robot.joint_count)
        self.distance: Array | None = None
        self._away_time = 0.0  # time for which the arm has been away from its target [s]
        self._least = math.inf  # smallest distance since the end of the motion [rad]

    def use(self, mae: Mae) -> None:
        """Use another network, and the residual torque σ that it contains."""
        self._contact.use(mae)
        self._spread = None
        if mae.touch is not None and mae.touch.calibrated:
            self._spread = mae.touch.spread
        # Another network computes other torques from the same load.
        carried, load = self._carried, self.load
        if self._reference is not None:
            carried = self._torque - self._reference
        self._begin_rest(self._target)
        if self._spread is not None:
            self._carried, self.load = carried, load

    def step(
        self, target: Array | None, theta: Array | None, pull: Array | None, dt: float
    ) -> None:
        """Compare target and estimate, θ [rad] (D,) each, dt [s] after the last call.

        Without one of them, there is no distance, and the arm is not away from its target.

        Args:
            target: Posture at which the arm should rest; None if it need not rest.
            theta: Estimated posture; None if it is unknown.
            pull: Bone-side tensions [N], (M,); None if they are unknown.
            dt: Time since the last call [s].
        """
        before = self._target
        if target is None or before is None or not np.array_equal(target, before):
            self._begin_rest(target)
        if theta is not None and pull is not None and target is not None:
            self._step_load(theta, pull, dt)
        self.distance = None if target is None or theta is None else target - theta
        if self.distance is None:
            self._least = math.inf
        else:
            self._least = min(self._least, self.largest)
        is_away = self.largest > min(AWAY, self._least + CARRIED)
        self._away_time = self._away_time + dt if is_away else 0.0

    def _begin_rest(self, target: Array | None) -> None:
        """Begin a rest at another target, or a motion (None): the load may be another one."""
        self._contact.reset()
        self._target, self._rested, self._reference = target, 0.0, None
        self._torque = self.load = self._carried = np.zeros(self._robot.joint_count)
        self._is_free = np.ones(self._robot.joint_count, bool)

    def _step_load(self, theta: Array, pull: Array, dt: float) -> None:
        """Update the load of the arm that rests at θ [rad], (D,), with tensions [N], (M,)."""
        if self._spread is None:
            return
        self._rested += dt
        torque = self._contact.step(theta, pull, dt).torque
        self._is_free &= torque != 0.0  # 0: a stop may be the only cause
        self._torque = self._torque + dt / (dt + AVERAGING) * (torque - self._torque)
        if self._reference is None:
            if self._rested > REFERENCE:
                self._reference = self._torque - self._carried
            return
        kinematics, spread = self._robot.kinematics, self._spread
        of_hand = kinematics.model.gravity.linear @ kinematics.end_effector_jacobian(theta)[:3]
        of_hand = self._is_free * of_hand / spread
        change = self._is_free * (self._torque - self._reference) / spread
        square = float(of_hand @ of_hand)
        if square > 0.0:
            before = max(float(of_hand @ (self._reference / spread)), 0.0)  # m_0, times `square`
            mass = max(float(of_hand @ change), -before) / square
            change = change - mass * of_hand
        self.load = change
        if not self.has_other_load:
            step = dt / (dt + FOLLOWING)
            self._reference = self._reference + step * (self._torque - self._reference)

    @property
    def largest(self) -> float:
        """Largest distance of a joint from its target [rad]; NaN while `distance` is None."""
        if self.distance is None:
            return math.nan
        return float(np.abs(self.distance).max())

    @property
    def is_away(self) -> bool:
        """Whether a joint has rested too far from its target for the time LASTING."""
        return self._away_time > LASTING

    @property
    def has_other_load(self) -> bool:
        """Whether the load of the arm has changed while it rests."""
        return float(np.linalg.norm(self.load)) > CHANGED

    @property
    def load_text(self) -> str:
        """Change at the joint where it is largest, and its possible causes; '' while unknown."""
        if self._spread is None:
            return ''
        joint = int(np.abs(self.load).argmax())
        torque = float((self.load * self._spread)[joint])
        robot = self._robot
        text = f'{robot.joints[joint]} {robot.units[joint].torque_text(torque)}'
        return f'{text}; {LOAD_CAUSES}'

    @property
    def farthest(self) -> int | None:
        """Index of the joint with the largest distance; None while `distance` is None."""
        if self.distance is None:
            return None
        return int(np.abs(self.distance).argmax())

    @property
    def text(self) -> str:
        """The joint farthest from its target and its distance, such as 'elbow 0.62 rad'.

        The text is empty while `distance` is None.
        """
        joint = self.farthest
        if self.distance is None or joint is None:
            return ''
        distance = self._robot.units[joint].position_text(abs(self.distance[joint]))
        return f'{self._robot.joints[joint]} {distance}'


def away_text(check: HoldingCheck, robot: Robot, mae: Mae, theta: Array) -> str:
    """Return a sentence on an arm that is away from its target, with the causes that are evident.

    Args:
        check: The check of this arm.
        robot: The robot, without its isolated muscles.
        mae: The network.
        theta: The estimated posture [rad], (D,).
    """
    text = f'{check.text} away'
    cause = POSSIBLE_CAUSES
    if missing := reach.lacking(robot, mae, theta):
        without = f'without {robot.names(robot.isolated)}, ' if robot.isolated else ''
        lift = '; lift the arm by hand' if robot.isolated else ''
        cause = f'{without}in this posture, the muscles lack {missing}{lift}'
    return f'{text}; {cause}'
