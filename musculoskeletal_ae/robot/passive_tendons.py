# SPDX-License-Identifier: Apache-2.0
"""Passive tendons: tendons without a muscle that pull joints back like rubber bands.

A passive tendon has the length x(θ) and the spring constant k. It exerts no force while its length
is within [x_low, x_high]:

    τ = −f ∂x/∂θ,    f = k (x − x_high) above,  k (x − x_low) below,  0 within

Its length is a polynomial of the angles of its joints:

    x(θ) = Σ_r c_r Π_j (θ_j − θ̄_j)^p_rj

For a tendon that only pulls, x_low is 0 or less than any length of the tendon.
`JointElasticity` adds these torques to those of the springs at the joints.
`passive_tendon_torque` computes them in compiled code.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints


class Passive(NamedTuple):
    """T passive tendons of D joints as arrays, for compiled code."""

    centre: Array  # joint angles θ̄ from which the polynomials count [rad], (D,)
    power: Ints  # powers p of all R terms, (R, D)
    coefficient: Array  # factor c of each term [m/rad^p], (R,)
    first: Ints  # index of the first term of each tendon, then R, (T+1,)
    law: Array  # spring constant k [N/m], x_low and x_high [m] of each tendon, (T, 3)


@dataclass(frozen=True, eq=False)
class PassiveTendons:
    """T passive tendons of D joints, in the order of θ."""

    names: tuple[str, ...]
    arrays: Passive

    @classmethod
    def none(cls, joint_count: int) -> PassiveTendons:
        """Return the passive tendons of a robot that has none."""
        powers, first = np.zeros((0, joint_count), np.int64), np.zeros(1, np.int64)
        centre = np.zeros(joint_count)
        return cls((), Passive(centre, powers, np.zeros(0), first, np.zeros((0, 3))))

    def __bool__(self) -> bool:
        """Return whether there is any passive tendon."""
        return bool(self.names)

    @property
    def spanned(self) -> Bools:
        """The joints that each tendon can turn, (T, D)."""
        ends = self.arrays.first
        parts = [self.arrays.power[a:b].any(axis=0) for a, b in pairwise(ends)]
        return np.array(parts, dtype=bool).reshape(len(self.names), len(self.arrays.centre))

    @property
    def typical_stiffness(self) -> Array:
        """Stiffness that the tendons give to each joint at θ̄: Σ k (∂x_t/∂θ)² [N·m/rad], (D,)."""
        passive, stiffness = self.arrays, np.zeros(len(self.arrays.centre))
        for t, (a, b) in enumerate(pairwise(passive.first)):
            is_linear = passive.power[a:b].sum(axis=1) == 1
            slope = passive.coefficient[a:b][is_linear] @ passive.power[a:b][is_linear]
            stiffness += passive.law[t, 0] * slope**2
        return stiffness

    def hold(self, theta: Array) -> tuple[Array, Array]:
        """Return torques that hold the joints, and their derivatives.

        Args:
            theta: Joint angles θ [rad], (..., D).

        Returns:
            Torques [N·m], (..., D), and their derivatives with respect to θ [N·m/rad],
            (..., D, D).
        """
        theta = np.asarray(theta, dtype=float)
        rows = np.ascontiguousarray(theta.reshape(-1, theta.shape[-1]))
        torque, gradient = np.zeros(rows.shape), np.zeros((*rows.shape, rows.shape[1]))
        # Imported here, because help texts should not wait for the slow import of numba.
        from musculoskeletal_ae.robot.passive_tendon_torque import hold_postures

        hold_postures(self.arrays, rows, torque, gradient)
        return torque.reshape(theta.shape), gradient.reshape(*theta.shape, theta.shape[-1])

    def deviating(self, factor: Array, shift: Array) -> PassiveTendons:
        """Return tendons that deviate like the springs of their joints.

        Args:
            factor: Factor of the stiffness at each joint, (D,); a tendon uses the mean over its
                joints.
            shift: Displacement of the posture in which a tendon has the same length [rad], (D,).
        """
        spanned, law = self.spanned, self.arrays.law.copy()
        law[:, 0] *= (spanned @ factor) / np.maximum(spanned.sum(axis=1), 1)
        arrays = self.arrays._replace(law=law, centre=self.arrays.centre + shift)
        return replace(self, arrays=arrays)

    def scaled(self, radian: Array) -> PassiveTendons:
        """Return the same tendons for other units of the joint angles.

        `radian` (D,) is the value of one unit of the new angles in the present units.
        """
        own = self.arrays
        coefficient = own.coefficient * np.prod(radian**own.power, axis=1)
        arrays = own._replace(centre=own.centre / radian, coefficient=coefficient)
        return replace(self, arrays=arrays)

    def of_joints(self, joints: Ints) -> PassiveTendons:
        """Return the tendons for some joints (indices), while all other joints are held at 0."""
        own = self.arrays
        is_held = np.ones(len(own.centre), dtype=bool)
        is_held[joints] = False
        held = np.prod((-own.centre[is_held]) ** own.power[:, is_held], axis=1)
        power = np.ascontiguousarray(own.power[:, joints])
        arrays = own._replace(
            centre=own.centre[joints], power=power, coefficient=held * own.coefficient
        )
        return replace(self, arrays=arrays)
