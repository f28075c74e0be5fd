# SPDX-License-Identifier: Apache-2.0
"""Dreaming: synthetic samples of the corrected body, for the network to learn from.

    (θ, T, l) = (θ_r, T_r, l(θ_r, T_r; s = 0)),   seen as (θ_r, T_r, l(θ_r, T_r; s_r) + ε)

The wire's last sliding s_r is not known to an estimator, so that the network sees lengths with the
friction's and the sensors' scatter and is asked for those without: ② then learns to weigh muscles
by how far their lengths can be trusted, as weighted least squares would.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.body import CorrectedBody
from musculoskeletal_ae.mae.training import OVERLOAD_SHARE
from musculoskeletal_ae.mae.units import scale_vector

#: share of dreams with most muscles near T_bias, as muscle stiffness control holds them
HELD_SHARE = 0.5
# The arm reaches its limits, and friction or a push carries it a little beyond.
MARGIN = 0.02


class Dream(NamedTuple):
    """N samples in scaled units, shape (N, D+2M) each.

    Attributes:
        seen: With scattered lengths.
        true: What the network is to restore.
    """

    seen: Array
    true: Array


def dream(body: CorrectedBody, noise: Array, count: int, rng: np.random.Generator) -> Dream:
    """Draw samples of a body.

    Args:
        body: The corrected body.
        noise: Standard deviation of each muscle's length beside friction [m], shape (M,).
        count: N.
        rng: Source of randomness.
    """
    robot = body.robot
    shape = count, robot.muscle_count
    reach = robot.upper - robot.lower
    low, high = robot.lower - MARGIN * reach, robot.upper + MARGIN * reach
    theta = rng.uniform(low, high, (count, robot.joint_count))
    tension = _tensions(body, count, rng)
    # Mostly at either end of [−1, 1], where sliding leaves it.
    sliding = np.sin(0.5 * np.pi * rng.uniform(-1.0, 1.0, shape))
    length, scattered = body.lengths(theta, tension, np.zeros(shape), sliding)
    scattered = scattered + noise * rng.standard_normal(shape)
    scale = scale_vector(robot.joint_count, robot.muscle_count)
    return Dream(
        np.concatenate([theta, tension, scattered], axis=1) * scale,
        np.concatenate([theta, tension, length], axis=1) * scale,
    )


def _tensions(body: CorrectedBody, count: int, rng: np.random.Generator) -> Array:
    tension = body.robot.tension
    shape = count, body.robot.muscle_count
    overloaded = rng.uniform(size=(count, 1)) < OVERLOAD_SHARE
    highest = np.where(
        overloaded, rng.uniform(tension.limit, tension.max, (count, 1)), tension.limit
    )
    anywhere = rng.uniform(0.0, 1.0, shape) * highest
    lowest = tension.bias * rng.uniform(0.7, 1.0, shape)
    held = lowest + rng.uniform(0.0, 1.0, shape) ** 3 * (highest - lowest)
    return np.where(rng.uniform(size=(count, 1)) < HELD_SHARE, held, anywhere)
