# SPDX-License-Identifier: Apache-2.0
"""Reduced limits for joints that the muscles can hold in only a part of the range.

The muscles of such a joint pull it in one direction, and a spring pulls it in the other. If the
joint turns so far that a tendon crosses its axis, the muscle pulls in the direction of the spring,
too. The joint then snaps to its stop, and nothing can bring it back: without reduced limits, an
emulated arm ends there in its first second.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.design.checks import TOLERATED_SHARE, Setting, counted_arm, measure
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.tension import holding_tension

POSTURES = 600  # check the muscles in this many random postures
FIRST = 100  # reduce no range if none of this many postures can be held
PARTS = 20  # divide the range of a joint into this many equal parts
#: keep a part of the range if its share of held postures is at least this share of the best part's
KEPT_SHARE = 0.5


def held_ranges(robot: Robot) -> list[tuple[str, float, float]]:
    """Return joints that need narrower limits: name, lower and upper limit [rad or m]."""
    sprung = robot.kinematics.elasticity.is_sprung
    if not sprung.any():
        return []
    theta = robot.random_postures(POSTURES, np.random.default_rng(2))
    if not _one_sided(-robot.routes.muscle_jacobian(theta))[sprung].any():
        return []
    # The second derivatives of many muscles take half a minute, so look for a held posture first.
    if not any(_can_hold(robot, at) for at in theta[:FIRST]):
        return []
    check = measure(Setting.of(robot, theta))
    # An unstable posture cannot be held either: near the joint's axis, a tendon pulls itself past
    # it.
    held = check.held & (check.stiffness > 0.0)
    if not held.any():
        return []
    ranges = list[tuple[str, float, float]]()
    for j in np.flatnonzero(sprung & _one_sided(check.moment_arms)).tolist():
        low, high = robot.lower[j], robot.upper[j]
        part = np.clip((PARTS * (theta[:, j] - low) / (high - low)).astype(int), 0, PARTS - 1)
        count = np.bincount(part, minlength=PARTS)
        share = np.bincount(part, held, minlength=PARTS) / np.maximum(count, 1)
        first = last = int(share.argmax())
        is_kept = share >= KEPT_SHARE * share.max()
        while first > 0 and is_kept[first - 1]:
            first -= 1
        while last < PARTS - 1 and is_kept[last + 1]:
            last += 1
        if first == 0 and last == PARTS - 1:
            continue
        radian = robot.units.radian[j]
        ends = [radian * (low + edge / PARTS * (high - low)) for edge in (first, last + 1)]
        least, most = (float(f'{end:.4g}') for end in ends)
        ranges.append((robot.joints[j], least, most))
    return ranges


def _one_sided(arms: Array) -> Bools:
    """Return whether the muscles pull each joint in one direction only, in too many postures.

    Args:
        arms: Moment arms in N postures [m], (N, M, D).
    """
    least = counted_arm(arms)
    is_two_sided = (arms.max(axis=1) > least) & (arms.min(axis=1) < -least)
    result: Bools = np.mean(~is_two_sided, axis=0) > TOLERATED_SHARE
    return result


def _can_hold(robot: Robot, theta: Array) -> bool:
    """Return whether the muscles can hold a posture θ [rad], (D,)."""
    try:
        holding_tension(robot, theta)
    except InfeasibleError:
        return False
    return True
