# SPDX-License-Identifier: Apache-2.0
"""Synthetic data: what the geometric model says of random postures and tensions.

    (θ, T, l) = (θ_r, T_r, f_geo(θ_r) − L_e(f_geo,abs(θ_r), T_r))

(paper, section "Initial Training".)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.mae.units import scale_vector
from musculoskeletal_ae.robot.robot import Robot

# Share of samples, in preset default, with tensions beyond what is planned.
OVERLOAD_SHARE = 0.2
# Reach of θ beyond each joint limit in preset default, as a share of the range: a network is least
# accurate at the edge of what it saw, and arms do rest at their limits.
POSTURE_MARGIN = 0.05
# Between twins, in units of the spread of θ: small against the bends of a route, and large enough
# that float32 resolves the difference.
TWIN_DISTANCE = 0.1


def geometric_samples(
    robot: Robot,
    count: int,
    rng: np.random.Generator,
    highest_tension: Array | float,
    margin: float = 0.0,
) -> Array:
    """Return scaled (θ, T, l) of random states, shape (count, D+2M).

    Args:
        robot: The nominal body.
        count: Number of samples.
        rng: Source of randomness.
        highest_tension: T_r is uniform in [0, this] [N]; a scalar or shape (count, 1).
        margin: Reach of θ_r beyond each joint limit, as a share of the range.
    """
    theta = robot.random_postures(count, rng, margin)
    tension = rng.uniform(0.0, 1.0, (count, robot.muscle_count)) * highest_tension
    length = robot.muscle_lengths(theta, tension)
    values = np.concatenate([theta, tension, length], axis=1)
    scaled: Array = values * scale_vector(robot.joint_count, robot.muscle_count)
    return scaled


def overload_samples(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    """Return samples mostly within tension.limit, some beyond it, up to tension.max.

    A payload pulls muscles beyond the limit; an estimator that has seen a few such states degrades
    gently there.
    """
    limit, most = robot.tension.limit, robot.tension.max
    overloaded = rng.uniform(size=(count, 1)) < OVERLOAD_SHARE
    highest = np.where(overloaded, rng.uniform(limit, most, (count, 1)), limit)
    return geometric_samples(robot, count, rng, highest, POSTURE_MARGIN)


def with_twins(
    drawn: Array,
    std: Array,
    joints: int,
    muscle_lengths: Callable[[Array, Array], Array],
    rng: np.random.Generator,
) -> Array:
    """Return each sample with a neighbour in posture: same T, θ off by TWIN_DISTANCE.

    Args:
        drawn: Scaled (θ, T, l), shape (N, D+2M).
        std: Spread of the data, shape (D+2M,); directions are uniform in units of it.
        joints: D.
        muscle_lengths: The body's l [m] of (θ [rad], T [N]).
        rng: Source of randomness.

    Returns:
        Samples and neighbours, shape (N, 2, D+2M).
    """
    muscles = (drawn.shape[1] - joints) // 2
    direction = rng.normal(size=(len(drawn), joints))
    direction *= TWIN_DISTANCE / np.linalg.norm(direction, axis=1, keepdims=True)
    scale = scale_vector(joints, muscles)
    theta, tension = np.split(drawn[:, : joints + muscles], [joints], axis=1)
    theta = theta + direction * std[:joints]
    length = muscle_lengths(theta / scale[:joints], tension / scale[joints : joints + muscles])
    twin = np.concatenate([theta, tension, length * scale[-muscles:]], axis=1)
    return np.stack([drawn, twin], axis=1)


def shuffled(samples: Array, batch: int, rng: np.random.Generator) -> Iterator[Array]:
    """Yield mini-batches of shuffled samples, epoch after epoch, without end."""
    while True:
        order = rng.permutation(len(samples))
        for i in range(0, max(len(order) - batch, 0) + 1, batch):
            yield samples[order[i : i + batch]]
