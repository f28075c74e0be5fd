# SPDX-License-Identifier: Apache-2.0
"""Finds tendons whose length jumps while the arm moves smoothly.

If muscles.yaml states on which `side` a tendon passes an object, the tendon can slip over the end
of that object. As in MuJoCo, the tendon then changes sides suddenly, and its length jumps by
centimetres. No network can represent such a jump.
"""

from collections.abc import Callable

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
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


def jumps(lengths: Callable[[Array], Array], lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return the largest jump of each length [m], (M,), and where it occurs: θ [rad], (M, D).

    Args:
        lengths: Function of θ [rad] (N, D) that returns M lengths [m], (N, M).
        lower: Lower joint limits [rad], (D,).
        upper: Upper joint limits [rad], (D,).
    """
    bends, theta = _second_differences(lengths, lower, upper)
    return bends.max(axis=0), theta[bends.argmax(axis=0)]


def _second_differences(
    lengths: Callable[[Array], Array], lower: Array, upper: Array
) -> tuple[Array, Array]:
    """Return absolute second differences of lengths along random lines in joint space.

    They are small where a length is smooth, and large where it jumps.

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
    return jumps(lengths, robot.lower, robot.upper)[0] > JUMP


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


def jumping_muscles(robot: Robot) -> list[tuple[int, float, Array]]:
    """Find the muscles whose length jumps somewhere within the joint limits.

    Returns:
        For each of them, the index, the largest jump [m], and the posture of this jump [rad], (D,).
    """
    if robot.routes.objects is None:
        return []
    largest, where = jumps(robot.routes.absolute_lengths, robot.lower, robot.upper)
    return [(m, largest[m], where[m]) for m in np.flatnonzero(largest > JUMP).tolist()]


def jump_warning(robot: Robot) -> str:
    """Return a warning that names the muscles whose lengths jump, or '' if there are none."""
    each = [f'{robot.muscles[m]} ({1e3 * size:.0f} mm)' for m, size, _ in jumping_muscles(robot)]
    if not each:
        return ''
    problem = (
        'no network can represent lengths that jump where a tendon slips over a wrapped object'
    )
    return f'{problem}: {", ".join(each)}; `check_robot` prints where they jump'


def jump_choices(robot: Robot) -> list[str]:
    """Return lines for the user that say where muscle lengths jump, and which remedies there are.

    For each muscle whose length jumps, one line states the joint angles. A second line suggests
    limits of a joint that exclude the jump, if there are any. The last line lists all remedies.
    Without jumps, the list is empty.
    """
    if robot.routes.objects is None:
        return []
    bends, theta = _second_differences(robot.routes.absolute_lengths, robot.lower, robot.upper)
    lines, jumping_names = [], []
    for m in np.flatnonzero(bends.max(axis=0) > JUMP).tolist():
        there = theta[bends[:, m] > JUMP]
        crossed = np.flatnonzero(robot.routes.crossed[m])
        place = ', '.join(
            f'{robot.joints[j]} from '
            f'{robot.units[j].range_text(there[:, j].min(), there[:, j].max())}'
            for j in crossed
        )
        size, name = 1e3 * bends[:, m].max(), robot.muscles[m]
        jumping_names.append(name)
        lines.append(
            f'length jump: the length of muscle {name} jumps by up to {size:.0f} mm for {place}'
        )
        if limit := _limit_without_jumps(robot, there, crossed):
            lines.append(f'    limiting {limit} excludes this jump')
    if lines:
        together = ','.join(jumping_names)
        lines.append(
            'no network can represent lengths that jump. Limit a joint (in the source, or in '
            f'robot.urdf), leave the muscles out (--without {together}), or accept that estimates '
            'are wrong near the postures of a jump and that nodes may reject the network'
        )
    return lines


def _limit_without_jumps(robot: Robot, there: Array, crossed: Ints) -> str:
    """Limit one joint so that no length jumps; return its new limits as a suggestion.

    Of all joints, the one is chosen that keeps the largest share of its range.

    Args:
        robot: The geometric model.
        there: Postures of the jumps [rad], (N, D).
        crossed: Indices of the joints that may be limited.

    Returns:
        A text with the name of the joint and its new limits; '' if each joint would keep less than
        30 % of its range.
    """
    best, text = LEAST_RANGE, ''
    for j in crossed:
        low, high = robot.lower[j], robot.upper[j]
        margin = RANGE_MARGIN * (high - low)
        least, most = there[:, j].min() - margin, there[:, j].max() + margin
        for kept in ((low, least), (most, high)):
            share = (kept[1] - kept[0]) / (high - low)
            if share > best:
                best = share
                text = f'{robot.joints[j]} to the range {robot.units[j].range_text(*kept)}'
    return text
