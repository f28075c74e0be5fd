# SPDX-License-Identifier: Apache-2.0
"""Judge by the joint angles whether the readings or the commands of muscles are exchanged.

If only one of the two is exchanged, winding in a muscle moves the readings of another one. The
misfits of the readings (`signals/wiring.py`) then tell which side is wrong. If both are exchanged
in the same way, the muscles obey the control law, and only the order of the readings shows it.
"""

from functools import partial
from typing import Literal

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.joint_sensors import JointFault, corrected
from musculoskeletal_ae.signals.wiring import BETTER, WiringJudgement, judge, square_misfits

#: Blame exchanged muscles instead of joint sensors if the exchange reduces the misfit to less than
#: this fraction.
EXCHANGE_BETTER = 0.8


def judge_order(
    robot: Robot, theta: Array, length: Array, tension: Array, segments: Ints
) -> WiringJudgement:
    """Judge by the joint angles whether columns of the readings are exchanged.

    The signs of the lengths must be right. `wrong_side` describes the arguments.
    """
    tension = robot.actuation.known_tension(tension)
    return judge(robot.muscle_lengths, theta, length, tension, segments, signs=False)


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
        length: Muscle lengths l [m], (N, M).
        tension: Tensions T [N], (N, M).
        segments: Number of the segment to which each message belongs, (N,).
        winds: The column that responded to each command, by muscle.
        joint_faults: Faults that would explain the lengths if the readings are right. Exchanged
            readings must explain the lengths better.

    Returns:
        The exchanged side, or None if the joint angles do not tell it.
    """
    known = robot.actuation.known_tension(tension)
    misfits_of = partial(
        square_misfits, robot.muscle_lengths, length=length, tension=known, segments=segments
    )

    def misfit(theta: Array, owner: dict[int, int]) -> float:
        """Return the misfit [m] at θ [rad] (N, D) if column k belongs to muscle `owner[k]`."""
        (square,) = misfits_of(theta)
        return float(np.sqrt(sum(square[k, m] for k, m in owner.items())))

    of_readings = misfit(theta, {k: m for m, k in winds.items()})
    of_commands = misfit(theta, own := {k: k for k in winds.values()})
    if BETTER * of_commands < of_readings:
        return 'commands'
    if BETTER * of_readings > of_commands:
        return None
    of_joints = misfit(corrected(theta, joint_faults, robot.units), own)
    return 'readings' if of_readings < EXCHANGE_BETTER * of_joints else None
