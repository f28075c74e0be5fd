# SPDX-License-Identifier: Apache-2.0
"""The regression from lengths to joint angles, and its weight beside the body."""

from dataclasses import replace

import numpy as np
import pytest

from learning.conftest import Stage
from musculoskeletal_ae.body_model.body_fit import BodyFit
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.synthetic import synthetic_samples
from musculoskeletal_ae.mae.units import scale_vector

LONGEST = 0.01  # lengths at which the slack tendons of the test body become taut [m]


@pytest.fixture
def stage(other_body):
    """Return samples of a body whose tendons do not wrap round bones."""
    return Stage(CalibratedBody(other_body.robot, other_body.parameters))


def fitted(robot, observed):
    fit = BodyFit(robot, None)
    for _ in range(2):
        fit.fit(observed, observed.theta)
    return fit.body


def with_slack(length):
    """Return lengths of a soft link: the link is compressed until the first tendon is slack."""
    return length + (LONGEST - length).min(axis=1, keepdims=True)


def error(estimate, theta):
    return np.linalg.norm(estimate - theta, axis=1).mean()


def test_the_body_decides_where_it_explains_the_lengths(arm26, stage):
    body = fitted(arm26, stage.observations(60))
    theta, tension, length = stage.states(300)
    moved = theta + 0.05
    assert np.abs(body.estimated(moved, tension, length) - moved).max() < 0.002


def test_the_regression_knows_the_posture_of_a_body_that_its_tendons_compress(arm26, stage):
    observed = stage.observations(20)
    body = fitted(arm26, replace(observed, length=with_slack(observed.length)))
    theta, tension, length = stage.states(300)
    # Estimates of the body have the errors that it has at left-out samples.
    variance = body.regressions[0].body_variance
    of_body = theta + np.sqrt(variance) * np.random.default_rng(0).standard_normal(theta.shape)
    estimate = body.estimated(of_body, tension, with_slack(length))
    assert error(estimate, theta) < 0.9 * error(of_body, theta)


def test_the_body_decides_far_from_all_samples(arm26, stage):
    observed = stage.observations(120)
    observed = replace(observed, length=with_slack(observed.length))
    shoulder = observed.theta[:, 0]
    body = fitted(arm26, observed[np.flatnonzero(shoulder < np.median(shoulder))])
    theta, tension, length = stage.states(300)
    moved = theta + 0.3
    change = np.abs(body.estimated(moved, tension, with_slack(length)) - moved).mean(axis=1)
    far = theta[:, 0] > np.quantile(shoulder, 0.9)
    near = theta[:, 0] < np.median(shoulder)
    assert np.median(change[far]) < 0.5 * np.median(change[near])


def test_only_measured_joints_are_estimated_by_regression(arm26, stage):
    observed = stage.observations(20)
    theta = observed.theta.copy()
    theta[:, 1] = np.nan
    fit = BodyFit(arm26, None)
    fit.fit(replace(observed, theta=theta), observed.theta)
    estimate = fit.body.estimated(observed.theta, observed.tension, observed.length)
    np.testing.assert_array_equal(estimate[:, 1], observed.theta[:, 1])
    fit.fit(replace(observed, theta=np.full_like(theta, np.nan)), observed.theta)
    assert not fit.body.regressions


@pytest.mark.parametrize('spread', [0.0, 0.01])
def test_a_joint_that_hardly_moved_in_the_samples_is_left_to_the_body(arm26, stage, spread):
    observed = stage.observations(20)
    theta, rng = observed.theta.copy(), np.random.default_rng(0)
    theta[:, 0] = spread * rng.uniform(-1.0, 1.0, len(theta))
    length = stage.body.lengths(theta, observed.tension, np.zeros_like(observed.tension))[0]
    body = fitted(arm26, replace(observed, theta=theta, length=with_slack(length)))
    theta, tension, length = stage.states(300)
    estimate = body.estimated(theta, tension, with_slack(length))
    assert np.abs(estimate[:, 0] - theta[:, 0]).max() < 0.02


def test_a_joint_that_hardly_moved_is_left_to_a_body_that_is_inaccurate_too(arm26, stage):
    observed, rng = stage.observations(20), np.random.default_rng(0)
    theta = observed.theta.copy()
    theta[:, 1] = -1.0 + 0.03 * rng.uniform(-1.0, 1.0, len(theta))
    length = stage.body.lengths(theta, observed.tension, np.zeros_like(observed.tension))[0]
    noisy = length + 0.006 * rng.standard_normal(length.shape)
    body = fitted(arm26, replace(observed, theta=theta, length=noisy))
    theta, tension, length = stage.states(300)
    change = body.estimated(theta, tension, length)[:, 1] - theta[:, 1]
    assert np.abs(change).max() < 0.06  # the body errs by about 0.045 rad


def test_a_muscle_that_no_sample_contains_is_no_input_of_the_regression(arm26, stage):
    observed = stage.observations(20)
    known = np.tile(np.arange(6) != 2, (20, 1))
    body = fitted(arm26, replace(observed, length=with_slack(observed.length), known=known))
    assert body.regressions[0].muscles.tolist() == [0, 1, 3, 4, 5]
    theta, tension, length = stage.states(300)
    assert np.isfinite(body.estimated(theta, tension, with_slack(length))).all()


def test_synthetic_samples_have_the_combined_estimate_as_target(arm26, stage):
    observed = stage.observations(60)
    body = fitted(arm26, replace(observed, length=with_slack(observed.length)))
    data = synthetic_samples(body, np.zeros(6), 200, np.random.default_rng(0))
    drawn, wanted = (part[:, :2] / scale_vector(2, 6)[:2] for part in data)
    tension, length = np.split(data.entered[:, 2:] / scale_vector(2, 6)[2:], 2, axis=1)
    read = body.transmission.reading(tension, np.zeros_like(tension))
    np.testing.assert_allclose(wanted, body.estimated(drawn, read, length))
    assert error(wanted, drawn) > 0.005
