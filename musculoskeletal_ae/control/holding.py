# SPDX-License-Identifier: Apache-2.0
"""Checks that an arm which holds a posture is where it was asked to be.

    e = max_j |θ_target − θ_estimated|_j
    the arm is away from its target:  e > AWAY, or e > e_least + CARRIED, for LASTING

e is computed from the end of a motion on, and e_least is its smallest value since then. The check
is off while the arm moves, and while a user demands a torque in addition to gravity compensation,
because the arm then need not rest at its target.

Friction leaves healthy arms at a distance that is smaller than AWAY, see
doc/explanation/control_and_safety.md. Friction never moves an arm away from where it has rested. A
payload, a contact, weak or lost muscles, or a base that is mounted otherwise than in `robot.urdf`
can do so.
"""

from __future__ import annotations

import math

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion import holdable_paths
from musculoskeletal_ae.robot.robot import Robot

#: report a joint that rests further than this away from its target [rad]; tendon friction alone
#: leaves healthy arms nearer
AWAY = 0.5
#: report a joint whose distance from its target has grown by more than this while the arm rests
#: [rad]; updates of the network change the estimate of a healthy resting arm by up to 0.19 rad
CARRIED = 0.25
LASTING = 5.0  # report a joint only once it has been away for this time [s]
#: causes that a report lists unless the muscles evidently lack torque in this posture
POSSIBLE_CAUSES = (
    'possible causes: a payload or contact, tendon friction, a muscle that pulls less than its '
    'sensor reads, or a base that is mounted otherwise than in robot.urdf'
)


class HoldingCheck:
    """Compares the estimated posture of a resting arm with its target.

    Attributes:
        distance: θ_target − θ_estimated [rad], (D,), while the arm rests at the end of a motion;
            None otherwise.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.distance: Array | None = None
        self._target: Array | None = None  # the last target [rad], (D,)
        self._away_time = 0.0  # time for which the arm has been away from its target [s]
        self._least = math.inf  # smallest distance since the end of the motion [rad]

    def step(self, target: Array | None, theta: Array | None, dt: float) -> None:
        """Compare target and estimate, θ [rad] (D,) each, dt [s] after the last call.

        Without one of them, there is no distance, and the arm is not away from its target.
        """
        before, self._target = self._target, target
        self.distance = None if target is None or theta is None else target - theta
        is_new = target is None or before is None or not np.array_equal(target, before)
        if is_new or self.distance is None:
            self._least = math.inf
        if self.distance is not None:
            self._least = min(self._least, self.largest)
        is_away = self.largest > min(AWAY, self._least + CARRIED)
        self._away_time = self._away_time + dt if is_away else 0.0

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
    if missing := holdable_paths.lacking(robot, mae, theta):
        without = f'without {robot.names(robot.isolated)}, ' if robot.isolated else ''
        lift = '; lift the arm by hand' if robot.isolated else ''
        cause = f'{without}in this posture, the muscles lack {missing}{lift}'
    return f'{text}; {cause}'
