# SPDX-License-Identifier: Apache-2.0
"""Judge by the joint angles whether the readings of muscles are exchanged.

If the readings and the commands of muscles are exchanged in the same way, the muscles obey the
control law, but their lengths change like those of another muscle. If only one of the two is
exchanged, winding in a muscle moves the readings of another one; the joint angles then tell whether
the readings or the commands are wrong. For N messages of a moving arm,

    e_jk = rms(l_j(t) − f_k(θ(t), T_j(t)) − c_jk)

is the misfit of the readings of column j to the geometric model f_k of muscle k, with a constant
c_jk for each segment of the recording. Two columns j and k are exchanged if this reduces
e_jj² + e_kk² to e_jk² + e_kj² by at least the factor BETTER².

In the motion test of 12 sound drivers (individuals 0–2 of arm26 and musashi_left_arm, both emulator
models), no exchange reduced the misfit by more than the factor 1.05.
"""

from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.joint_sensors import DEGREES, ORDER, SIGN, JointFault

#: Two columns are exchanged if this divides their misfit by at least this factor. Their order is
#: right if exchanging them multiplies it by at least this factor.
BETTER = 1.4
#: Exchanged muscles explain the lengths better than a fault of joint sensors if they reduce the
#: misfit to less than this fraction.
JOINTS_BETTER = 0.8
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
    square = _square_misfits(robot, theta, length, tension, segments)
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


def wrong_side(
    robot: Robot,
    theta: Array,
    length: Array,
    tension: Array,
    segments: Ints,
    winds: dict[int, int],
    joint_faults: list[JointFault],
) -> Literal['readings', 'commands'] | None:
    """Judge by the joint angles whether the readings or the commands of muscles are exchanged.

    Column k = winds[m] of the readings has responded to the command of muscle m. It belongs to
    muscle m if the readings are exchanged, and to muscle k if the commands are. The misfits of the
    two cases must differ by the factor BETTER.

    Args:
        robot: The geometric model.
        theta: Measured θ [rad], (N, D). Messages with NaN are not used.
        length: l [m], (N, M).
        tension: T [N], (N, M).
        segments: Number of the segment to which each message belongs, (N,).
        winds: The column that responded to each command, by muscle.
        joint_faults: Faults that would explain the lengths if the readings are right. Exchanged
            readings must explain them better.

    Returns:
        The exchanged side, or None if the joint angles do not tell it.
    """

    def misfit(theta: Array, owner: dict[int, int]) -> float:
        """Return the misfit [m] if column k belongs to muscle `owner[k]`."""
        square = _square_misfits(robot, theta, length, tension, segments)
        return float(np.sqrt(sum(square[k, m] for k, m in owner.items())))

    of_readings = misfit(theta, {k: m for m, k in winds.items()})
    of_commands = misfit(theta, own := {k: k for k in winds.values()})
    if BETTER * of_commands < of_readings:
        return 'commands'
    if BETTER * of_readings > of_commands:
        return None
    of_joints = misfit(corrected(theta, joint_faults), own)
    return 'readings' if of_readings < JOINTS_BETTER * of_joints else None


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
    rows = np.flatnonzero(np.isfinite(theta).all(axis=1))
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_SAMPLES)).astype(int)]
    theta, length, segments = theta[rows], length[rows], segments[rows]
    tension = robot.actuation.known_tension(tension[rows])
    groups = [np.flatnonzero(segments == each) for each in np.unique(segments)]
    square = np.empty((robot.muscle_count,) * 2)
    for j in range(robot.muscle_count):
        same = np.repeat(tension[:, [j]], robot.muscle_count, axis=1)
        error = length[:, [j]] - robot.muscle_lengths(theta, same)
        for rows in groups:
            error[rows] -= error[rows].mean(axis=0)
        square[j] = np.square(error).mean(axis=0)
    return square
