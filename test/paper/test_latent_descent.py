# SPDX-License-Identifier: Apache-2.0
import numpy as np

from musculoskeletal_ae.paper.latent_descent import Loss, Term, descend
from musculoskeletal_ae.robot.robot import Robot

RNG = np.random.default_rng(0)
TERMS = (
    Term(1.0, RNG.normal(size=(2, 7)), RNG.normal(size=2)),
    Term(0.3, RNG.normal(size=(1, 7)), RNG.normal(size=1)),
    Term(2.0, RNG.normal(size=(5, 7)), RNG.normal(size=5)),
)
LOSS = Loss(TERMS)


def test_the_loss_is_the_weighted_sum_of_plain_norms():
    y = RNG.normal(size=(4, 7))
    expected = sum(w * np.linalg.norm(y @ a.T - b, axis=1) for w, a, b in TERMS)
    np.testing.assert_allclose(LOSS(y), expected)


def test_the_gradient_is_the_difference_quotient():
    y, step = RNG.normal(size=7), 1e-6
    quotient = [(LOSS(y + d) - LOSS(y - d)) / (2 * step) for d in step * np.eye(7)]
    np.testing.assert_allclose(LOSS.gradient(y), quotient, rtol=1e-6)


def test_a_step_is_the_best_of_n_and_the_loss_never_rises(trained):
    mae, robot = trained['paper'], Robot.load('arm26')
    values = robot.joint_count + 2 * robot.muscle_count
    terms = [Term(1.0, np.eye(values), RNG.normal(size=values))]
    z = RNG.normal(size=robot.joint_count + robot.muscle_count)
    sizes, losses = [], [Loss(terms)(mae.decode_scaled(z))]
    for _ in range(20):
        moved = descend(mae, z, terms, 0.5, 10, 1)
        sizes.append(np.linalg.norm(moved - z))
        losses.append(Loss(terms)(mae.decode_scaled(moved)))
        z = moved
    assert (np.diff(losses) <= 0.0).all() and losses[-1] < losses[0]
    parts = np.array(sizes) / 0.05
    np.testing.assert_allclose(parts, parts.round(), atol=1e-6)
    assert parts.max() < 10.0


def test_a_norm_that_is_zero_has_no_gradient_and_no_nan():
    term = Term(1.0, np.eye(3), np.ones(3))
    np.testing.assert_array_equal(Loss([term]).gradient(np.ones(3)), np.zeros(3))
