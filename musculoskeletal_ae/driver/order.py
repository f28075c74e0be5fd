# SPDX-License-Identifier: Apache-2.0
"""Find muscles whose readings and commands are both exchanged, by the joint angles.

Such muscles obey the control law, but their lengths change like those of another muscle. For N
messages of a moving arm,

    e_jk = rms(l_j(t) − f_k(θ(t), T_j(t)) − c_jk)

is the misfit of the readings of column j to the geometric model f_k of muscle k, with a constant
c_jk for each segment of the recording. Two columns j and k are exchanged if this reduces
e_jj² + e_kk² to e_jk² + e_kj² by at least the factor BETTER².

In the motion test of 12 sound drivers (individuals 0–2 of arm26 and musashi_left_arm, both emulator
models), no exchange reduced the misfit by more than the factor 1.05.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.joint_sensors import DEGREES, ORDER, SIGN, JointFault

#: Two columns are exchanged if this divides their misfit by at least this factor. Their order is
#: right if exchanging them multiplies it by at least this factor.
BETTER = 1.4
MOST_SAMPLES = 400  # largest number of messages that are used, evenly distributed


class Order(NamedTuple):
    """The order of muscles according to the joint angles."""

    #: muscle that each misplaced column of the readings belongs to, by column; empty if none is
    misplaced: dict[int, int]
    right: list[int]  # columns that certainly belong to their muscle
    misfit: float  # root of the summed squares of e in this order [m]


def judge_order(robot: Robot, theta: Array, length: Array, tension: Array, segments: Ints) -> Order:
    """Judge by the joint angles whether columns of the readings are exchanged.

    Args:
        robot: The geometric model.
        theta: Measured θ [rad], (N, D). Messages with NaN are not used.
        length: l [m], (N, M).
        tension: T [N], (N, M).
        segments: Number of the segment to which each message belongs, (N,).
    """
    rows = np.flatnonzero(np.isfinite(theta).all(axis=1))
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_SAMPLES)).astype(int)]
    tension = robot.actuation.known_tension(tension[rows])
    square = _square_misfits(robot, theta[rows], length[rows], tension, segments[rows])
    order, pairs = np.arange(len(square)), list(combinations(range(len(square)), 2))

    def misfits(a: int, b: int) -> tuple[float, float]:
        """Return the squares of the misfit of two columns, as they are and exchanged."""
        as_they_are = square[a, order[a]] + square[b, order[b]]
        return as_they_are, square[a, order[b]] + square[b, order[a]]

    def gain(pair: tuple[int, int]) -> float:
        as_they_are, exchanged = misfits(*pair)
        return as_they_are - exchanged if as_they_are > BETTER**2 * exchanged else 0.0

    # One exchange after the other, so that no more columns are blamed than necessary.
    for _ in range(len(square)):
        best = max(pairs, key=gain)
        if gain(best) <= 0.0:
            break
        order[list(best)] = order[list(reversed(best))]
    is_unclear = np.zeros(len(square), dtype=bool)
    for pair in pairs:
        as_they_are, exchanged = misfits(*pair)
        is_unclear[list(pair)] |= exchanged < BETTER**2 * as_they_are
    misplaced = {j: k for j, k in enumerate(order.tolist()) if j != k}
    right = [j for j in np.flatnonzero(~is_unclear).tolist() if j not in misplaced]
    return Order(misplaced, right, float(np.sqrt(square[np.arange(len(square)), order].sum())))


def corrected(theta: Array, faults: list[JointFault]) -> Array:
    """Return θ (N, D) as the joint sensors would publish it without these faults."""
    theta = theta.copy()
    for fault in faults:
        joints = list(fault.joints)
        if fault.kind == SIGN:
            theta[:, joints] *= -1.0
        elif fault.kind == ORDER:
            theta[:, joints] = theta[:, joints[::-1]]
        elif fault.kind == DEGREES:
            theta[:, joints] = np.radians(theta[:, joints])
    return theta


def _square_misfits(
    robot: Robot, theta: Array, length: Array, tension: Array, segments: Ints
) -> Array:
    """Return e² of the module docstring [m²], (M, M)."""
    groups = [np.flatnonzero(segments == each) for each in np.unique(segments)]
    square = np.empty((robot.muscle_count,) * 2)
    for j in range(robot.muscle_count):
        same = np.repeat(tension[:, [j]], robot.muscle_count, axis=1)
        error = length[:, [j]] - robot.muscle_lengths(theta, same)
        for rows in groups:
            error[rows] -= error[rows].mean(axis=0)
        square[j] = np.square(error).mean(axis=0)
    return square
