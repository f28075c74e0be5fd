# SPDX-License-Identifier: Apache-2.0
"""Finds tendons whose length jumps while the arm moves smoothly.

If muscles.yaml states on which `side` a tendon passes an object, the tendon can slip over the end
of that object. As in MuJoCo, the tendon then changes sides suddenly, and its length jumps by
centimetres. No network can represent such a jump.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.robot.robot import Robot

LINES = 60  # examine lengths along this many straight lines between random postures
STEPS = 400  # examine this many postures along each line
#: report a jump if the second difference of a length along a line exceeds this [m]; those of smooth
#: lengths are a hundred times smaller
JUMP = 0.001
LEAST_RANGE = 0.3  # suggest no joint limits that leave a smaller share of the joint's range
#: keep this distance between a suggested limit and the jumps, as a share of the range
RANGE_MARGIN = 0.03
#: draw the points of an emulated individual at most this often, to find ones without jumps
MOST_DRAWS = 50


class Jump(NamedTuple):
    """A muscle whose length jumps somewhere within the joint limits."""

    muscle: int  # index of the muscle
    size: float  # its largest jump [m]
    theta: Array  # postures of its jumps [rad], (N, D)


def second_differences(
    lengths: Callable[[Array], Array], lower: Array, upper: Array
) -> tuple[Array, Array]:
    """Return absolute second differences of lengths along random lines in joint space.

    They are small where a length is smooth, and large where it jumps.

    Args:
        lengths: Function of θ [rad] (N, D) that returns M lengths [m], (N, M).
        lower: Lower joint limits [rad], (D,).
        upper: Upper joint limits [rad], (D,).

    Returns:
        The differences [m], (N, M), and the posture in the middle of each [rad], (N, D).
    """
    joints = len(lower)
    ends = np.random.default_rng(0).uniform(lower, upper, (2, LINES, 1, joints))
    theta = ends[0] + np.linspace(0.0, 1.0, STEPS)[:, None] * (ends[1] - ends[0])
    along = lengths(theta.reshape(-1, joints)).reshape(LINES, STEPS, -1)
    bends = np.abs(np.diff(along, 2, axis=1)).reshape(LINES * (STEPS - 2), -1)
    return bends, theta[:, 1:-1].reshape(-1, joints)


def jumping(lengths: Callable[[Array], Array], robot: Robot) -> Bools:
    """Return which lengths jump somewhere within the joint limits, (M,).

    Args:
        lengths: Function of θ [rad] (N, D) that returns M lengths [m], (N, M).
        robot: The geometric model, for its joint limits.
    """
    jumps: Bools = second_differences(lengths, robot.lower, robot.upper)[0].max(axis=0) > JUMP
    return jumps


def newly_jumping(
    lengths: Callable[[Array], Array], nominal: Callable[[Array], Array], robot: Robot
) -> Bools:
    """Return which lengths jump although those of the nominal body do not, (M,).

    Args:
        lengths: Function of θ [rad] (N, D) that returns M lengths [m], (N, M).
        nominal: The same function of the nominal body.
        robot: The geometric model, for its joint limits.
    """
    jump = jumping(lengths, robot)
    # Usually no length jumps; then do not examine the nominal body.
    return jump & ~jumping(nominal, robot) if jump.any() else jump


def jumping_muscles(robot: Robot) -> list[Jump]:
    """Find the muscles whose length jumps somewhere within the joint limits."""
    if robot.routes.objects is None:
        return []
    bends, theta = second_differences(robot.routes.absolute_lengths, robot.lower, robot.upper)
    largest = bends.max(axis=0)
    return [
        Jump(m, largest[m], theta[bends[:, m] > JUMP])
        for m in np.flatnonzero(largest > JUMP).tolist()
    ]


def jump_warning(robot: Robot) -> str:
    """Return a warning that names the muscles whose lengths jump, or '' if there are none."""
    each = [f'{robot.muscles[m]} ({1e3 * size:.0f} mm)' for m, size, _ in jumping_muscles(robot)]
    if not each:
        return ''
    problem = (
        'no network can represent lengths that jump where a tendon slips over a wrapped object'
    )
    return f'{problem}: {", ".join(each)}; `check_robot` prints where they jump'


def limit_without_jumps(robot: Robot, jump: Jump) -> str:
    """Limit one joint so that a length does not jump; return its new limits as a suggestion.

    Of all joints that the muscle crosses, the one is chosen that keeps the largest share of its
    range.

    Returns:
        A text with the name of the joint and its new limits; '' if each joint would keep less than
        30 % of its range.
    """
    best, text = LEAST_RANGE, ''
    for j in np.flatnonzero(robot.routes.crossed[jump.muscle]):
        low, high = robot.lower[j], robot.upper[j]
        margin = RANGE_MARGIN * (high - low)
        least, most = jump.theta[:, j].min() - margin, jump.theta[:, j].max() + margin
        for kept in ((low, least), (most, high)):
            share = (kept[1] - kept[0]) / (high - low)
            if share > best:
                best = share
                text = f'{robot.joints[j]} to the range {robot.units[j].range_text(*kept)}'
    return text
