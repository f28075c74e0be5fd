# SPDX-License-Identifier: Apache-2.0
"""The baseline estimators find the posture of a noise-free nominal arm."""

import numpy as np
import pytest

from musculoskeletal_ae.experiments.baselines import (
    PolynomialFilter,
    TableSearch,
    without_elongation,
)
from musculoskeletal_ae.robot.robot import Robot


@pytest.fixture(
    scope='module',
    params=['arm26', pytest.param('musashi_left_arm', marks=pytest.mark.thorough)],
)
def robot(request):
    return Robot.load(request.param)


@pytest.fixture(scope='module')
def motion(robot):
    """Return θ, T and l of a slow wave through the joint range, with changing tensions."""
    phase = np.linspace(0.0, 2.0 * np.pi, 300)[:, None]
    middle, half = 0.5 * (robot.lower + robot.upper), 0.35 * (robot.upper - robot.lower)
    theta = middle + half * np.sin(phase * np.arange(1, robot.joint_count + 1) / 2.0)
    share = 0.5 + 0.5 * np.cos(phase * np.arange(1, robot.muscle_count + 1) / 3.0)
    tension = robot.tension.bias + 100.0 * share
    return theta, tension, robot.muscle_lengths(theta, tension)


def errors(estimate, theta):
    return np.linalg.norm(estimate - theta, axis=1)


def test_the_elongation_is_removed_exactly(robot, motion):
    theta, tension, length = motion
    off = without_elongation(robot, tension, length) - robot.routes.relative_lengths(theta)
    # The only error is a product of two small terms: relative stretch times elongation.
    assert np.abs(off).max() < 1e-5


def test_the_polynomial_filter_follows_the_motion(robot, motion):
    theta, tension, length = motion
    estimate = PolynomialFilter(robot).estimate(tension, length)
    # Polynomials of degree 3 have errors of a few hundredths of a radian for these muscles.
    assert errors(estimate, theta)[20:].mean() < 0.05


def test_table_search_errs_by_less_than_its_spacing(robot, motion):
    theta, tension, length = motion
    estimate = TableSearch(robot).estimate(tension, length)
    spacing = (robot.upper - robot.lower) / TableSearch.ROWS ** (1.0 / robot.joint_count)
    assert errors(estimate, theta).mean() < np.linalg.norm(spacing)


@pytest.mark.parametrize('kind', [PolynomialFilter, TableSearch])
def test_baselines_that_learn_improve_on_a_body_with_other_lengths(robot, motion, kind):
    rng = np.random.default_rng(0)

    def other(theta, tension):
        """Return lengths of a body whose first joint has 20 % larger moment arms than the model."""
        lengths = robot.muscle_lengths(theta, tension)
        middle = np.repeat(theta[:, :1], robot.joint_count, axis=1)
        middle[:, 1:] = 0.5 * (robot.lower + robot.upper)[1:]
        return lengths + 0.2 * robot.routes.relative_lengths(middle)

    observed = robot.random_postures(3000, rng)
    pull = rng.uniform(30.0, 130.0, (3000, robot.muscle_count))
    theta, tension, _ = motion
    initial_baseline, trained_baseline = kind(robot), kind(robot)
    trained_baseline.learn(observed, pull, other(observed, pull))
    length = other(theta, tension)
    before, after = (
        errors(each.estimate(tension, length), theta)[20:].mean()
        for each in (initial_baseline, trained_baseline)
    )
    assert after < before
