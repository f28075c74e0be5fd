# SPDX-License-Identifier: Apache-2.0
"""Whether the columns of recorded muscle lengths are the muscles they are taken for.

Arrays carry no names. But the true body is like the nominal one, so muscle i must follow

    l̂_j = f_geo(θ) − L_e(f_geo,abs(θ), T)

best for j = i, up to a constant offset.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from musculoskeletal_ae.bags.streams import Pairs
from musculoskeletal_ae.robot.robot import Robot

# Another muscle must explain a column this much better before its place is doubted: bodies differ
# from their model by some of it, and neighbouring muscles are alike.
_DOUBT = 2.5
_LEAST_MOTION = 0.005  # [m] spread below which a muscle has not moved enough to be told
_MOST_SAMPLES = 2000


def misplaced_muscles(pairs: Pairs, robot: Robot) -> list[tuple[str, str]]:
    """Return (muscle of the column, muscle that it behaves like) where these differ.

    Args:
        pairs: From a recording.
        robot: Whose order of muscles is expected.
    """
    chosen = np.linspace(0, len(pairs.time) - 1, min(len(pairs.time), _MOST_SAMPLES)).astype(int)
    if len(chosen) < 2:
        return []
    theta = pairs.theta[chosen].clip(robot.lower, robot.upper)
    length, tension = pairs.length[chosen], pairs.tension[chosen]
    moved = length.std(axis=0) > _LEAST_MOTION
    errors = np.empty((robot.muscle_count, robot.muscle_count))
    for i in range(robot.muscle_count):
        # The tension of the column stretches whichever muscle it is.
        alike = np.repeat(tension[:, i : i + 1], robot.muscle_count, axis=1)
        errors[i] = (length[:, i : i + 1] - robot.muscle_lengths(theta, alike)).std(axis=0)
    _, best = linear_sum_assignment(errors)
    return [
        (robot.muscles[i], robot.muscles[j])
        for i, j in enumerate(best)
        if moved[i] and errors[i, i] > _DOUBT * errors[i, j]
    ]
