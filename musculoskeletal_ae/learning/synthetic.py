# SPDX-License-Identifier: Apache-2.0
"""Synthetic samples of a calibrated body: what the network is trained on beside real ones."""

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.learning.body import CalibratedBody
from musculoskeletal_ae.mae.default_training import highest_tensions
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.robot.robot import Robot

#: share with most muscles near T_bias, as muscle stiffness control holds them
HELD_SHARE = 0.5
# The arm reaches its limits, and friction or a push carries it a little beyond.
MARGIN = 0.02


class TrainingData(NamedTuple):
    """N samples in scaled units, shape (N, D+2M) each."""

    entered: Array  # with scattered lengths
    true: Array  # what the network is to restore


UNSURE = 0.25  # share of the friction that the direction of sliding, as lengths tell it, misses


def synthetic_samples(
    body: CalibratedBody,
    noise: Array,
    count: int,
    rng: np.random.Generator,
) -> TrainingData:
    """Draw `count` samples of a body whose lengths scatter by `noise` [m] (M,) beside friction.

        (θ, T, l) = (θ_r, T_r, l(θ_r, T_r; s = 0)),   seen as (θ_r, T_r, l(θ_r, T_r; u s_r) + ε)

    T_r is at the elastic units. An estimator knows that but for the share u (UNSURE) of friction,
    so that the network sees lengths with this and the sensors' scatter and is asked for those
    without: ② then learns to weigh muscles by how far their lengths can be trusted, as weighted
    least squares do.
    """
    robot = body.robot
    shape = count, robot.muscle_count
    theta = robot.random_postures(count, rng, MARGIN)
    tension = held_tensions(robot, count, rng)
    # Mostly at either end of [−1, 1], where sliding leaves it.
    direction = np.sin(0.5 * np.pi * rng.uniform(-1.0, 1.0, shape))
    length, scattered = body.lengths(theta, tension, np.zeros(shape), UNSURE * direction)
    scattered = scattered + noise * rng.standard_normal(shape)
    true, entered = State(theta, tension, length), State(theta, tension, scattered)
    return TrainingData(entered.scaled(), true.scaled())


def held_tensions(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    """Draw T [N] (count, M): anywhere up to the highest, or mostly near T_bias."""
    shape, highest = (count, robot.muscle_count), highest_tensions(robot, count, rng)
    anywhere = rng.uniform(0.0, 1.0, shape) * highest
    lowest = robot.tension.bias * rng.uniform(0.7, 1.0, shape)
    held = lowest + rng.uniform(0.0, 1.0, shape) ** 3 * (highest - lowest)
    return np.where(rng.uniform(size=(count, 1)) < HELD_SHARE, held, anywhere)
