# SPDX-License-Identifier: Apache-2.0
"""Synthetic training samples of the calibrated body, which complement the real samples."""

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.mae.default_training import highest_tensions
from musculoskeletal_ae.mae.units import State
from musculoskeletal_ae.robot.equilibrium_states import equilibrium_states, has_followers
from musculoskeletal_ae.robot.robot import Robot

#: draw this share of the samples with tensions as in an arm that holds a posture, most of them near
#: T_bias; without tension sensors, draw it with the assumed tensions instead
HELD_SHARE = 0.5
SEARCHED = 40  # search equilibria from this many random postures
#: let postures exceed the joint limits by this share of the range, because friction or contact can
#: move a joint slightly beyond a limit
MARGIN = 0.02


class TrainingData(NamedTuple):
    """N samples in scaled units; each array has the shape (N, D+2M)."""

    entered: Array  # network input, with noisy lengths
    true: Array  # target of the network's output


#: assume that this share of tendon friction stays unknown, although the direction in which a tendon
#: slid last is estimated
UNKNOWN_FRICTION = 0.25


def synthetic_samples(
    body: CalibratedBody,
    noise: Array,
    count: int,
    rng: np.random.Generator,
) -> TrainingData:
    """Draw random samples of a body with length noise and residual friction.

        target: (θ_est, T_r, l(θ_r, T_r; s = 0)),   input: (θ_r, T_r, l(θ_r, T_r; u s_r) + ε + e_g)

    θ_r are random postures, T_r random tensions at the elastic elements, and s_r random directions
    of sliding. From measured tensions, an estimator can compute T_r except for a share u of the
    friction (UNKNOWN_FRICTION). The lengths in the network's input contain this share of the
    friction and the noise ε, and those in its target do not. The network therefore learns to weight
    muscles by the accuracy of their lengths when it estimates θ from T and l, as in weighted least
    squares.

    e_g is drawn from the posterior of the remainder. Far from all real samples, the lengths of the
    body are little known, and might be equal to the known lengths of a different posture. With e_g,
    the network prefers the known posture when it estimates θ.

    θ_est is the mean of θ_r and of the posture regression at the input's T and l, weighted by the
    variances of body and regression (`posture_regression`). From T and l, the network therefore
    estimates the weighted mean of both; from θ and T, it computes the lengths of the body.

    Args:
        body: The calibrated body.
        noise: σ of ε for each muscle [m], (M,).
        count: Number of samples.
        rng: The random generator.
    """
    robot = body.robot
    shape = count, robot.muscle_count
    theta = robot.random_postures(count, rng, MARGIN)
    tension = held_tensions(robot, count, rng)
    if has_followers(robot):
        equilibria = count // 2
        found = equilibrium_states(body.as_robot(), equilibria, rng, SEARCHED)
        if found is not None:
            theta[:equilibria], tension[:equilibria] = found
    # Draw directions mostly near −1 and 1, where sliding leaves them most of the time.
    direction = np.sin(0.5 * np.pi * rng.uniform(-1.0, 1.0, shape))
    read = body.transmission.reading(tension, np.zeros(shape))
    length, scattered = body.lengths(theta, read, np.zeros(shape), UNKNOWN_FRICTION * direction)
    scattered = scattered + noise * rng.standard_normal(shape)
    scattered = scattered + body.remainder.drawn_error(theta, read, rng)
    estimate = body.estimated(theta, read, scattered)
    true, entered = State(estimate, tension, length), State(theta, tension, scattered)
    return TrainingData(entered.scaled(), true.scaled())


def held_tensions(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    """Draw random tensions [N] for `count` samples, (count, M).

    In a share HELD_SHARE of the samples, most tensions are near T_bias, as in an arm that holds a
    posture. Without tension sensors, the network's input is always `Actuation.assumed_tension`, so
    these samples have exactly these tensions. In all other samples, tensions are uniform from 0 to
    `highest_tensions`.
    """
    shape, highest = (count, robot.muscle_count), highest_tensions(robot, count, rng)
    anywhere = rng.uniform(0.0, 1.0, shape) * highest
    if robot.tension_source.is_known:
        lowest = robot.tension.bias * rng.uniform(0.7, 1.0, shape)
        held = lowest + rng.uniform(0.0, 1.0, shape) ** 3 * (highest - lowest)
    else:
        held = np.broadcast_to(robot.actuation.assumed_tension, shape)
    return np.where(rng.uniform(size=(count, 1)) < HELD_SHARE, held, anywhere)
