# SPDX-License-Identifier: Apache-2.0
"""The detector is calibrated on healthy data only."""

import numpy as np
import pytest

from musculoskeletal_ae.body_model.observations import Sample
from musculoskeletal_ae.estimation.detectors.residual_distance import DISTANCE
from musculoskeletal_ae.learning.detector_calibration import (
    GLITCH_SHARE,
    LEAST_SAMPLES,
    LEAST_TIME,
    RECENT_TIME,
    Healthy,
    Reservoir,
    calibrate,
)
from musculoskeletal_ae.mae.residuals import residuals

from .conftest import Stage, job


def test_the_detector_is_calibrated_only_with_enough_healthy_data(learned):
    _, updater, store, stage = learned
    few = updater.update(job(store, stage.messages(100), LEAST_TIME - 1.0, 1)).mae.anomaly
    assert not few.calibrated
    enough = updater.update(job(store, stage.messages(600), LEAST_TIME, 1)).mae
    assert enough.anomaly.calibrated
    kept = updater.update(job(store, stage.messages(10), 1.0, 1)).mae.anomaly
    # After a restart there are only few messages. They do not replace the earlier calibration.
    assert kept.calibrated
    lost = updater.update(job(store, stage.messages(10), 1.0, 1, hold=False)).mae.anomaly
    # After a muscle was replaced (hold=False), the earlier calibration is invalid.
    assert not lost.calibrated


def test_the_detector_is_not_calibrated_on_one_posture(learned):
    _, updater, store, stage = learned
    observed = stage.messages(600)
    few = updater.update(job(store, observed, LEAST_TIME, 1, rests=LEAST_SAMPLES - 1)).mae
    assert not few.anomaly.calibrated


def test_statistics_of_many_rests_are_kept_until_as_many_are_collected_again(learned):
    _, updater, store, stage = learned
    before = updater.update(job(store, stage.messages(600), LEAST_TIME, 1)).mae.anomaly
    assert before.calibrated
    after = updater.update(job(store, stage.messages(600), LEAST_TIME, 1, rests=1)).mae.anomaly
    assert after is before


@pytest.mark.parametrize('seed', range(5))
def test_glitches_do_not_change_the_threshold(learned, seed):
    mae, _, _, stage = learned
    observed = Stage(stage.body, seed).messages(1000)
    clean = calibrate(mae, Healthy(observed, LEAST_TIME, 50), 50)
    for row in range(int(GLITCH_SHARE * len(observed))):
        observed[100 * row + 7, 6 + row] += 0.2
    with_glitches = calibrate(mae, Healthy(observed, LEAST_TIME, 50), 50)
    assert clean.samples == 1000
    assert with_glitches.samples == 1000 - int(GLITCH_SHARE * len(observed))
    for name, threshold in clean.thresholds.items():
        assert with_glitches.thresholds[name] == pytest.approx(threshold, rel=0.02)


def test_healthy_messages_stay_below_the_threshold_and_a_rupture_does_not(learned):
    _, updater, store, stage = learned
    mae = updater.update(job(store, stage.messages(600), LEAST_TIME, 1)).mae

    def distance(tension, length):
        return mae.anomaly.distances(residuals(mae.estimate(tension, length), tension, length))

    _, tension, length = stage.states(2000)
    threshold = mae.anomaly.thresholds[DISTANCE]
    assert distance(tension, length).max() < threshold
    cut = distance(tension * (np.arange(6) != 2), length - 0.1 * (np.arange(6) == 2))
    assert cut.min() > threshold


def test_the_reservoir_is_a_uniform_draw_of_bounded_size():
    reservoir = Reservoir(1, capacity=200)
    for n in range(4000):
        reservoir.step(Sample(np.zeros(1), np.array([float(n)]), np.zeros(1), np.zeros(1)), 0.1)
    kept = reservoir.healthy().messages[:, 0]
    assert len(kept) == 200
    assert abs(kept.mean() - 2000.0) < 400.0
    assert reservoir.time == pytest.approx(400.0)


def reading(n, theta=0.0, tension=50.0, **others):
    return Sample(np.full(2, theta), np.full(3, tension), np.full(3, n), np.zeros(3), **others)


def test_every_second_message_is_learned_and_the_others_validate():
    reservoir = Reservoir(3)
    for n in range(10):
        reservoir.step(reading(float(n), theta=0.1 * n), 0.1)
    observed = reservoir.healthy()
    np.testing.assert_array_equal(observed.learned.length[:, 0], [0, 2, 4, 6, 8])
    np.testing.assert_array_equal(observed.judging.length[:, 0], [1, 3, 5, 7, 9])
    np.testing.assert_allclose(
        observed.judging.theta, 0.1 * observed.judging.length[:, :2], rtol=1e-6
    )
    assert observed.learned.known.all()


@pytest.mark.parametrize(
    'unfit',
    [
        {'theta': np.nan},  # θ was not measured
        {'tension': 0.0},  # a muscle was isolated or slack
        {'spread': np.full(2, 0.01)},  # θ was measured by a camera, with this uncertainty [rad]
    ],
)
def test_messages_that_do_not_determine_the_posture_are_not_learned(unfit):
    reservoir = Reservoir(3)
    for n in range(10):
        reservoir.step(reading(float(n), **(unfit if n < 6 else {})), 0.1)
    observed = reservoir.healthy()
    assert len(observed.messages) == 10
    np.testing.assert_array_equal(observed.learned.length[:, 0], [6, 8])


def test_messages_with_negative_motor_currents_are_learned_but_not_negative_tensions():
    for of_currents in (False, True):
        reservoir = Reservoir(3, of_currents=of_currents)
        for n in range(10):
            reservoir.step(reading(float(n), tension=-3.0 if n < 6 else 50.0), 0.1)
        observed = reservoir.healthy()
        assert len(observed.learned) + len(observed.judging) == (10 if of_currents else 4)


def test_messages_of_long_ago_are_not_learned_and_the_others_have_an_age():
    reservoir = Reservoir(3, capacity=20_000)
    for n in range(4):
        reservoir.step(reading(float(n)), 0.1)
        reservoir.rest(reading(float(n), theta=n))
    observed = reservoir.healthy().learned
    np.testing.assert_array_equal(observed.age, [4, 2])
    while reservoir.time < RECENT_TIME + 0.05:
        reservoir.step(reading(0.0, theta=np.nan), 0.2)
    np.testing.assert_array_equal(reservoir.healthy().learned.length[:, 0], [2.0])
