# SPDX-License-Identifier: Apache-2.0
"""The remainder: lengths that the constants of the body model cannot express."""

from dataclasses import replace

import numpy as np
import pytest

from learning.conftest import Stage
from musculoskeletal_ae.body_model.body_fit import BodyFit
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.remainder import Remainder
from musculoskeletal_ae.body_model.synthetic import synthetic_samples
from musculoskeletal_ae.learning.body_updater import BodyUpdater
from musculoskeletal_ae.learning.detector_calibration import Healthy
from musculoskeletal_ae.learning.scheduler import Job
from musculoskeletal_ae.mae.units import scale_vector

AMPLITUDE = 0.015  # of the coupling [m]
NO_MESSAGES = Healthy(np.empty((0, 18), dtype=np.float32), 0.0, 0)


def coupling(theta):
    """Return the change of all lengths [m] (N, 6) of an elastic body, whose joints move together.

    It changes each muscle with both joints, also those muscles that cross only one.
    """
    shoulder, elbow = theta.T
    shapes = np.sin(1.5 * shoulder + 0.8), np.cos(1.2 * elbow), shoulder * elbow
    mixed = np.array([[1.0, -0.5, 0.3, 0.0, 0.8, 0.2], [0.4, 0.9, -0.7, 0.5, 0.0, -0.6], [0.5] * 6])
    return AMPLITUDE * np.stack(shapes, axis=1) @ mixed


def coupled(observed):
    return replace(observed, length=observed.length + coupling(observed.theta))


def fitted(robot, observed):
    fit = BodyFit(robot, None)
    for _ in range(3):  # as in three updates
        fit.fit(observed, observed.theta)
    return fit.body


def error(body, states):
    """Return the mean error of the lengths [m] in states without friction."""
    theta, tension, length = states
    (predicted,) = body.lengths(theta, tension, np.zeros_like(tension))
    return float(np.abs(predicted - length).mean())


def kernel_ridge(observed, states):
    """Return the mean error of kernel ridge regression, chosen by its error on the test states."""
    theta, tension, length = states
    inputs, asked = (
        np.hstack([angles, pull / 200.0])
        for angles, pull in ((observed.theta, observed.tension), (theta, tension))
    )
    mean, errors = observed.length.mean(axis=0), []
    for width in (0.5, 1.0, 2.0, 4.0, 8.0):
        for ridge in (1e-6, 1e-4, 1e-2):
            kernel, across = (
                np.exp(-np.square(own[:, None] - inputs).sum(axis=2) / (2.0 * width**2))
                for own in (inputs, asked)
            )
            weights = np.linalg.solve(kernel + ridge * np.eye(len(kernel)), observed.length - mean)
            errors.append(np.abs(across @ weights + mean - length).mean())
    return float(min(errors))


@pytest.fixture
def straight_stage(other_body):
    """Return samples of a body whose tendons do not wrap round bones."""
    return Stage(CalibratedBody(other_body.robot, other_body.parameters))


@pytest.fixture
def elastic_stage(other_body):
    """Return samples of a body, and states of it, to which a coupling was added."""
    stage = Stage(other_body)
    theta, tension, length = Stage(other_body, 1).states(300)
    return stage, (theta, tension, length + coupling(theta))


@pytest.mark.parametrize('count', [20, 60])
def test_a_body_that_the_model_cannot_express_is_learned_better_than_by_regression(
    arm26, elastic_stage, count
):
    stage, states = elastic_stage
    observed = coupled(stage.observations(count))
    assert error(fitted(arm26, observed), states) < kernel_ridge(observed, states)


def test_more_samples_of_such_a_body_reduce_the_error_to_the_noise(arm26, elastic_stage):
    stage, states = elastic_stage
    observed = coupled(stage.observations(120))
    few, many = (error(fitted(arm26, observed[:count]), states) for count in (15, 120))
    assert many < 0.5 * few
    assert many < 0.0005


def test_the_network_learns_that_lengths_far_from_all_samples_are_uncertain(arm26, elastic_stage):
    stage, _ = elastic_stage
    observed = coupled(stage.observations(60))
    shoulder = observed.theta[:, 0]
    lowest, highest = shoulder.min(), np.median(shoulder)
    body = fitted(arm26, observed[shoulder < highest])
    data = synthetic_samples(body, np.zeros(6), 1000, np.random.default_rng(0))
    spread = np.abs((data.entered - data.true) / scale_vector(2, 6))[:, 8:].mean(axis=1)
    angle = data.true[:, 0] / scale_vector(2, 6)[0]
    near = (angle > lowest) & (angle < highest)
    far = angle > highest + 0.5 * (highest - lowest)
    assert spread[far].mean() > 3.0 * spread[near].mean()


def test_errors_that_muscles_have_in_common_are_expected_in_common(arm26, straight_stage):
    observed = straight_stage.observations(60)
    common = 0.005 * np.random.default_rng(0).standard_normal((60, 1))
    body = fitted(arm26, replace(observed, length=observed.length + common))
    theta = arm26.random_postures(500, np.random.default_rng(1))
    tension = np.full((500, 6), 100.0)
    drawn = body.remainder.drawn_error(theta, tension, np.random.default_rng(2))
    assert np.corrcoef(drawn.T).min() > 0.5


def test_a_body_that_the_model_can_express_keeps_no_remainder(arm26, straight_stage):
    observed = straight_stage.observations(60)
    remainder = fitted(arm26, observed).remainder.at(observed.theta, observed.tension)
    assert np.abs(remainder).max() < 0.0002


def test_a_touched_arm_does_not_bend_the_remainder(arm26, stage):
    states, observed = stage.states(300), stage.observations(60)
    length = observed.length.copy()
    length[::12] += 0.03  # somebody held the arm, so these tendons were longer than usual
    assert error(fitted(arm26, replace(observed, length=length)), states) < 0.002


def test_bad_samples_hardly_bend_the_remainder_of_an_elastic_body(arm26, elastic_stage):
    stage, states = elastic_stage
    observed = coupled(stage.observations(30))
    length = observed.length.copy()
    length[::10] += 0.02 * np.array([1.0, -1.0, 1.0, 1.0, -1.0, -1.0])
    # With robust weights from the residuals of the fit alone, the error is 0.34 mm.
    assert error(fitted(arm26, replace(observed, length=length)), states) < 0.00028


def test_without_all_joint_angles_no_remainder_is_learned(arm26, stage):
    observed = stage.observations(20)
    theta = observed.theta.copy()
    theta[:, 1] = np.nan
    fit = BodyFit(arm26, None)
    fit.fit(replace(observed, theta=theta), observed.theta)
    assert not fit.body.remainder.groups


def test_a_body_without_samples_has_no_remainder(arm26):
    theta = arm26.random_postures(3, np.random.default_rng(0))
    remainder = CalibratedBody(arm26).remainder.at(theta, np.full((3, 6), 50.0))
    np.testing.assert_array_equal(remainder, Remainder(6).at(theta, np.zeros((3, 6))))
    np.testing.assert_array_equal(remainder, 0.0)


def test_learning_continues_from_a_network_without_losing_its_remainder(
    arm26, elastic_stage, initial
):
    stage, states = elastic_stage
    updater = BodyUpdater(arm26, initial)
    for _ in range(3):
        update = updater.update(Job(coupled(stage.observations(60)), NO_MESSAGES, True, 100))
    again = BodyFit(arm26, update.mae)
    few = coupled(stage.observations(6))
    again.fit(few, few.theta)
    assert error(again.body, states) < 0.5 * error(fitted(arm26, few), states)


def test_the_update_reports_what_the_body_model_cannot_express(arm26, straight_stage, initial):
    plain = straight_stage.observations(40)
    sizes = [
        BodyUpdater(arm26, initial).update(Job(observed, NO_MESSAGES, True, 1)).remainder.max()
        for observed in (plain, coupled(plain))
    ]
    assert sizes[0] < 0.0002
    assert sizes[1] > 0.002
