# SPDX-License-Identifier: Apache-2.0
"""Networks with isolated muscles ignore the readings of these muscles."""

from dataclasses import replace

import numpy as np
import pytest

from musculoskeletal_ae.exceptions import CheckpointError
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.residuals import AnomalyStatistics, anomaly, residuals
from musculoskeletal_ae.mae.units import Mask
from musculoskeletal_ae.presets.registry import PRESETS
from musculoskeletal_ae.robot.robot import Robot

ROBOT = Robot.load('arm26')


@pytest.fixture(scope='module')
def states():
    rng = np.random.default_rng(5)
    theta = ROBOT.random_postures(60, rng)
    tension = rng.uniform(30.0, 150.0, (60, 6))
    return theta, tension, ROBOT.muscle_lengths(theta, tension)


@pytest.mark.parametrize('lost', [(0,), (5,), (1, 3)])
@pytest.mark.parametrize('preset', PRESETS)
def test_readings_of_isolated_muscles_have_no_influence(trained, states, preset, lost):
    mae, (_, tension, length) = trained[preset].without(lost), states
    before = mae.estimate(tension, length)
    rng = np.random.default_rng(1)
    others = tension.copy(), length.copy()
    others[0][:, lost] = rng.uniform(-1e3, 1e3, (60, len(lost)))
    others[1][:, lost] = rng.uniform(-9.0, 9.0, (60, len(lost)))
    for got, want in zip(mae.estimate(*others), before, strict=True):
        np.testing.assert_array_equal(got, want)
    one = mae.estimate(others[0][7], others[1][7])  # a single message instead of a batch
    np.testing.assert_allclose(one.theta, before.theta[7], atol=1e-4)
    error = residuals(before, *others, lost)
    assert not error.reshape(60, 2, 6)[..., lost].any()
    assert np.isfinite(anomaly(error)).all()


def test_a_network_without_isolated_muscles_is_unchanged(trained, states):
    mae, (_, tension, length) = trained['default'], states
    assert mae.without(()) is mae
    back = mae.without((2,)).without(())
    for got, want in zip(back.estimate(tension, length), mae.estimate(tension, length)):
        np.testing.assert_array_equal(got, want)


def test_the_remaining_muscles_determine_the_posture(trained, states):
    mae, (theta, tension, length) = trained['default'], states
    for lost in range(6):
        off = mae.without((lost,)).estimate(tension, length).theta - theta
        # Measured: 0.1 rad with this briefly trained network. If the lost muscle had an influence,
        # the error would be 0.5 rad.
        assert np.linalg.norm(off, axis=1).mean() < 0.25
    at = mae.encode(Mask.THETA_TENSION, theta, tension)
    assert at.shape == mae.without((1,)).encode(Mask.THETA_TENSION, theta, tension).shape


def test_a_joint_at_its_end_is_not_taken_for_one_in_the_middle(trained):
    mae, tension = trained['default'], np.full((4, 6), 60.0)
    ends = np.array([ROBOT.lower, ROBOT.upper])
    theta = np.array([ends[[i, j], [0, 1]] for i in (0, 1) for j in (0, 1)])
    length = ROBOT.muscle_lengths(theta, tension)
    healthy = np.abs(mae.estimate(tension, length).theta - theta).mean()
    for lost in range(6):
        off = np.abs(mae.without((lost,)).estimate(tension, length).theta - theta)
        assert off.mean() < healthy


def test_the_statistics_are_those_of_the_remaining_muscles(trained):
    mae = trained['default']
    mae = replace(mae, anomaly=replace(mae.anomaly, calibrated=True))
    reduced = mae.without((1,))
    kept = [m for m in range(12) if m % 6 != 1]
    np.testing.assert_array_equal(
        reduced.anomaly.covariance[np.ix_(kept, kept)], mae.anomaly.covariance[np.ix_(kept, kept)]
    )
    np.linalg.cholesky(reduced.anomaly.covariance)
    assert reduced.anomaly.calibrated
    assert not reduced.without(()).anomaly.calibrated  # the restored muscle has no statistics


@pytest.mark.parametrize('reads_zero', [True, False])
def test_tension_and_length_of_a_lost_muscle_do_not_count_in_the_distance(reads_zero):
    rng, lost = np.random.default_rng(0), (1, 3)
    healthy, error = rng.normal(0.02, 0.01, (2, 50, 12)) @ rng.normal(size=(12, 12))
    kept = [m for m in range(12) if m % 6 not in lost]
    expected = AnomalyStatistics.of(healthy[:, kept], calibrated=True).distances(error[:, kept])
    statistics = AnomalyStatistics.of(healthy, calibrated=True)
    if reads_zero:  # as the residuals of isolated muscles
        error.reshape(50, 2, 6)[..., lost] = 0.0
    reduced = statistics.without(lost) if reads_zero else statistics.ignoring(lost)
    np.testing.assert_allclose(reduced.distances(error), expected, rtol=1e-2)


def test_a_checkpoint_stores_the_isolated_muscles(trained):
    reduced = trained['default'].without((4, 1))
    back = checkpoint.from_bytes(checkpoint.to_bytes(reduced), ROBOT)
    assert back.isolated == reduced.isolated == (1, 4)
    for wrong in ((6,), (1, 1)):
        data = checkpoint.to_bytes(replace(reduced, isolated=wrong))
        with pytest.raises(CheckpointError, match='isolated'):
            checkpoint.from_bytes(data, ROBOT)
