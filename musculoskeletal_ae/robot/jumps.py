# SPDX-License-Identifier: Apache-2.0
"""Find tendons whose length jumps while the arm moves smoothly.

A tendon with a `side` can pass the end of the body that it wraps around. It then slips to the other
side at once, as in MuJoCo, and its length jumps by centimetres. No network restores such a length.
"""

from collections.abc import Callable

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.robot.robot import Robot

LINES, STEPS = 60, 400  # lines between random postures, and steps along each
JUMP = 0.001  # [m] second difference per step; that of smooth lengths is a hundred times smaller
LEAST_RANGE = 0.3  # share of a joint's range that a limit against jumps has to keep
RANGE_MARGIN = 0.03  # share of the range between such a limit and the jumps
REDRAWN = 50  # times that a jumping wire's points are drawn again for an individual, at most


def jumps(lengths: Callable[[Array], Array], lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return the largest jump of each length [m] (M,), and at which θ [rad] (M, D).

    `lengths` gives (N, M) of θ (N, D); they are followed between postures within the limits (D,).
    """
    bends, theta = _followed(lengths, lower, upper)
    return bends.max(axis=0), theta[bends.argmax(axis=0)]


def _followed(lengths: Callable[[Array], Array], lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return how much lengths bend within a step [m] (N, M), and at which θ [rad] (N, D)."""
    joints = len(lower)
    ends = np.random.default_rng(0).uniform(lower, upper, (2, LINES, 1, joints))
    theta = ends[0] + np.linspace(0.0, 1.0, STEPS)[:, None] * (ends[1] - ends[0])
    along = lengths(theta.reshape(-1, joints)).reshape(LINES, STEPS, -1)
    bends = np.abs(np.diff(along, 2, axis=1)).reshape(LINES * (STEPS - 2), -1)
    return bends, theta[:, 1:-1].reshape(-1, joints)


def jumping(lengths: Callable[[Array], Array], robot: Robot) -> Bools:
    """Return which of such lengths jump within a robot's limits, (M,)."""
    return jumps(lengths, robot.lower, robot.upper)[0] > JUMP


def jumping_muscles(robot: Robot) -> list[tuple[int, float, Array]]:
    """Return the muscles whose lengths jump, with the largest jump [m] of each and its θ (D,)."""
    if robot.routes.objects is None:
        return []
    largest, where = jumps(robot.routes.absolute_lengths, robot.lower, robot.upper)
    return [(m, largest[m], where[m]) for m in np.flatnonzero(largest > JUMP).tolist()]


def told_of_jumps(robot: Robot) -> str:
    """Say which muscles no network restores, and by how much they jump; '' if there are none."""
    each = [f'{robot.muscles[m]} ({1e3 * size:.0f} mm)' for m, size, _ in jumping_muscles(robot)]
    told = 'no network restores lengths that jump where a wire slips to the other side of what it '
    return f'{told}wraps round: {", ".join(each)}; see check_robot' if each else ''


def jump_choices(robot: Robot) -> list[str]:
    """Return lines that name jumping lengths, their postures, and what can be done about them."""
    if robot.routes.objects is None:
        return []
    bends, theta = _followed(robot.routes.absolute_lengths, robot.lower, robot.upper)
    lines, jumping_names = [], []
    for m in np.flatnonzero(bends.max(axis=0) > JUMP).tolist():
        there = theta[bends[:, m] > JUMP]
        crossed = np.flatnonzero(robot.routes.crossed[m])
        place = ', '.join(
            f'{robot.joints[j]} {there[:, j].min():.2f} to {there[:, j].max():.2f}' for j in crossed
        )
        size, name = 1e3 * bends[:, m].max(), robot.muscles[m]
        jumping_names.append(name)
        lines.append(f'jumps: muscle {name} by up to {size:.0f} mm, at {place}')
        if limit := _limit_without_jumps(robot, there, crossed):
            lines.append(f'    limiting {limit} avoids it')
    if lines:
        together = ','.join(jumping_names)
        lines.append(
            'no network restores lengths that jump. Limit a joint (in the source, or in '
            f'robot.urdf), leave the muscles out (--without {together}), or accept that estimates '
            'are wrong near these postures, and that nodes may refuse the network'
        )
    return lines


def _limit_without_jumps(robot: Robot, there: Array, crossed: Ints) -> str:
    """Return the limit of a joint that keeps most of its range without jumps at θ (N, D), or ''."""
    best, text = LEAST_RANGE, ''
    for j in crossed:
        low, high = robot.lower[j], robot.upper[j]
        margin = RANGE_MARGIN * (high - low)
        least, most = there[:, j].min() - margin, there[:, j].max() + margin
        for kept in ((low, least), (most, high)):
            share = (kept[1] - kept[0]) / (high - low)
            if share > best:
                best = share
                text = f'{robot.joints[j]} to [{kept[0]:.2f}, {kept[1]:.2f}] {robot.units[j].theta}'
    return text
