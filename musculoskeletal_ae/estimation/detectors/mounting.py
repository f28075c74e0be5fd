# SPDX-License-Identifier: Apache-2.0
"""Checks from tensions whether gravity acts in the direction that `robot.urdf` states.

The torques of weight, springs, motion and muscles are in balance. The weight's torque is linear in
the vector of gravity, so the balance of the joints in several postures shows its direction u:

    r_j(u, m) = (Y(θ) u ‖g‖)_j + m (Y_hand(θ) u ‖g‖)_j − (Y(θ) g − τ_ext)_j
    S(u, m)   = Σ_postures Σ_j ½ (ν + 1) ln(1 + (r_j / σ_j)² / ν),   σ_j = NOISE Σ_m |G_mj| T_m
    evidence  = min S(u, m) over u within UPRIGHT of g  −  min S(u, m) over all u

Y(θ) u is the torque that holds the weight of the arm where gravity is u, and Y_hand(θ) u the torque
that holds 1 kg in the hand. g is the gravity of `robot.urdf`, and τ_ext the external torque that
the contact estimator computes with g (`estimation/contact.py`). u runs over directions on a sphere,
and m over masses of a payload. Because the best m is chosen for each u, a payload does not look
like another direction of gravity. S is the negative logarithm of a Student likelihood, because
friction and pushes cause large residuals now and then.

S is summed over the newest n postures, for each n, and the largest evidence of all n counts. A base
that is turned while the arm works is thus detected as soon as a base that was wrong from the
beginning. Earlier postures are discarded once the newest ones show the direction of `robot.urdf`.

A posture is used only if it differs from the last one that was used. An arm that stands still, with
the same friction all the time, therefore adds no evidence. At the stop of a joint, the muscles need
not hold the weight: a residual is used there only if the stop would have to pull.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.conditions import Condition, ConditionKind
from musculoskeletal_ae.estimation.contact import Contact
from musculoskeletal_ae.estimation.finding import Detector, Observation
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot

DIRECTIONS = 162  # compare this many directions u of gravity, which are about 16° apart
#: compare these masses m of a payload, as shares of the mass of the moving links
PAYLOADS = 0.0, 0.3, 0.6, 1.2
UPRIGHT = 25.0  # treat a direction within this angle as that of `robot.urdf` [°]
#: try these torque errors σ_j, as shares of the muscles' summed absolute torques at joint j, and
#: use the one that explains the postures best
NOISE = 0.08, 0.16, 0.32
LEAST_NOISE = 0.1  # assume at least this torque error σ_j [N·m]
#: ν: degrees of freedom of Student's distribution of the torque errors; with few, single large
#: errors due to friction or pushes decide little
FREEDOM = 4.0
MOVED = 0.2  # use another posture only after a joint has moved by this much [rad]
#: use at most one posture in this time [s], because noise makes the estimated posture jump
SPACING = 0.5
AT_STOP = 0.12  # assume that a joint may rest against its stop this close to its limit [rad]
MEMORY = 100  # judge the direction of gravity by at most this many of the newest postures
ENOUGH = 30  # judge the direction of gravity by at least this many postures
#: Report that gravity acts in another direction once the evidence exceeds this. In 150 s of healthy
#: exploration after 180 s of learning, it was 0 on two individuals of the emulator model `kin`, at
#: most 15 on three of `foreign`, and 92 on a fourth, whose body was learned badly
#: (notes/late_mishaps.md).
CERTAIN = 120.0
#: end the report, and discard earlier postures, when the newest ENOUGH postures show the direction
#: of `robot.urdf` with this evidence
CLEARED = 8.0


class Tilt(NamedTuple):
    """A direction of gravity that differs from the one that `robot.urdf` states.

    Attributes:
        angle: Angle between the two directions [°].
        direction: Direction of gravity in the frame of the root link, a unit vector, (3,).
    """

    angle: float
    direction: Array

    @property
    def text(self) -> str:
        """Direction of gravity that the tensions show, as a text for users."""
        x, y, z = self.direction
        return (
            f'the tensions show that gravity acts along ({x:.1f}, {y:.1f}, {z:.1f}) in the '
            f'axes of the root link, about {self.angle:.0f}° away from the direction in robot.urdf'
        )


def directions(down: Array) -> Array:
    """Return unit vectors in all directions, (DIRECTIONS + 1, 3), the first one along `down`."""
    place = np.arange(DIRECTIONS) + 0.5
    polar = np.arccos(1.0 - 2.0 * place / DIRECTIONS)
    turn = np.pi * (1.0 + np.sqrt(5.0)) * place
    sphere = np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)
    return np.vstack([down / np.linalg.norm(down), np.transpose(sphere)])


class MountingCheck(Detector):
    """Warns if gravity acts in another direction than `robot.urdf` states.

    `use` must be called before `step_healthy`.

    Attributes:
        tilt: The direction of gravity, if it certainly differs from the one of `robot.urdf`; else
            None.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot, kinematics = robot, robot.kinematics
        self._model = pin.Model(kinematics.model)
        self._data = self._model.createData()
        self._gravity: Array = kinematics.model.gravity.linear.copy()
        self._strength = float(np.linalg.norm(self._gravity))
        self._directions = directions(self._gravity)
        cosine = self._directions @ self._directions[0]
        self._angles = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        moving = sum(float(inertia.mass) for inertia in self._model.inertias[1:])
        self._payloads = moving * np.array(PAYLOADS)
        self.accept()

    def use(self, mae: Mae) -> None:
        """Use another network; nothing is checked if its anomaly detector is not calibrated."""
        self._mae = mae

    def accept(self) -> None:
        """Accept the present mounting, because a user says so: discard all evidence."""
        self.tilt: Tilt | None = None
        self._counted_at = np.full(self._robot.joint_count, np.inf)  # last posture that was used
        self._since = SPACING  # time since the last posture that was used [s]
        #: terms of S for each posture, newest first, (noise levels, payloads, directions)
        self._costs: deque[Array] = deque(maxlen=MEMORY)

    def step_healthy(self, observation: Observation, load: Contact | None) -> None:
        """Update the evidence with one message, unless the tensions are unknown."""
        if load is None:
            return
        theta, torque = observation.estimate.state.theta, load.torque
        self._since += observation.dt
        moved = np.abs(theta - self._counted_at)
        has_moved = self._since >= SPACING - 1e-9 and moved.max() > MOVED
        if not self._mae.is_calibrated or not has_moved or not np.isfinite(torque).all():
            return
        self._counted_at, self._since = theta, 0.0
        tension = observation.sample.bone_tension.copy()
        tension[list(self._mae.isolated)] = 0.0
        pull = tension @ np.abs(self._mae.muscle_jacobian(theta, tension))
        noise = np.maximum(pull, LEAST_NOISE)
        of_arm, of_hand = self._regressors(theta)
        weight = of_arm @ self._gravity - torque  # torque that the muscles hold
        u = self._strength * self._directions.T
        held = (of_arm + self._payloads[:, None, None] * of_hand) @ u  # (payloads, D, directions)
        residual = (held - weight[:, None]) / noise[:, None]
        at_stop = self._at_stop(theta)
        residual[:, at_stop[0]] = np.minimum(residual[:, at_stop[0]], 0.0)
        residual[:, at_stop[1]] = np.maximum(residual[:, at_stop[1]], 0.0)
        residual[:, torque == 0.0] = 0.0
        joints = np.count_nonzero(torque)
        cost = np.array([self._cost(residual / share) + joints * np.log(share) for share in NOISE])
        self._costs.appendleft(cost)
        if len(self._costs) >= ENOUGH:
            self._judge()

    def conditions(self) -> Iterator[Condition]:
        """Yield the condition that gravity certainly acts in another direction."""
        if self.tilt is not None:
            yield ConditionKind.OTHER_MOUNTING.condition(self.tilt.text)

    @staticmethod
    def _cost(residual: Array) -> Array:
        cost: Array = 0.5 * (FREEDOM + 1.0) * np.log1p(residual**2 / FREEDOM).sum(axis=1)
        return cost

    def _judge(self) -> None:
        # Sum the newest n postures for each n, and take the best noise level and payload.
        best = np.cumsum(self._costs, axis=0)[ENOUGH - 1 :].min(axis=(1, 2))
        is_upright = self._angles <= UPRIGHT
        upright, other = best[:, is_upright].min(axis=1), best[:, ~is_upright].min(axis=1)
        # logarithm of the likelihood ratio between the best direction and the best upright one
        evidence = upright - other
        if evidence[0] < -CLEARED:
            while len(self._costs) > ENOUGH:
                self._costs.pop()
            self.tilt = None
            return
        row = int(evidence.argmax())
        if evidence[row] > (CERTAIN if self.tilt is None else 0.0):
            place = int(best[row].argmin())
            self.tilt = Tilt(float(self._angles[place]), self._directions[place])

    def _at_stop(self, theta: Array) -> tuple[Bools, Bools]:
        """Return which joints are near their lower limit, (D,), and which near the upper, (D,)."""
        robot = self._robot
        return theta < robot.lower + AT_STOP, theta > robot.upper - AT_STOP

    def _regressors(self, theta: Array) -> tuple[Array, Array]:
        """Return two matrices by which gravity [m/s²] is multiplied to get torques [N·m], (D, 3).

        The first yields the torques that hold the arm, the second those for 1 kg in the hand.
        """
        kinematics, model = self._robot.kinematics, self._model
        angles, columns = kinematics.tree.angles(theta), []
        for unit in np.eye(3):
            model.gravity.linear = unit
            torque = np.array(pin.computeGeneralizedGravity(model, self._data, angles))
            columns.append(kinematics.tree.of_theta(torque, theta))
        of_hand = -kinematics.end_effector_jacobian(theta)[:3].T
        return np.column_stack(columns), of_hand
