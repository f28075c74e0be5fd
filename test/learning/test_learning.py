# SPDX-License-Identifier: Apache-2.0
"""The network follows the body, the detector what is healthy, and the paper what it prints."""

from __future__ import annotations

import numpy as np
import pytest

from musculoskeletal_ae.estimation.anomaly import DISTANCE
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.learning import paper_updater
from musculoskeletal_ae.learning.body import CorrectedBody
from musculoskeletal_ae.learning.body_fit import Prior
from musculoskeletal_ae.learning.body_updater import BodyUpdater
from musculoskeletal_ae.learning.healthy import (
    GLITCHES,
    LEAST_SAMPLES,
    LEAST_TIME,
    Healthy,
    Reservoir,
    calibrate,
)
from musculoskeletal_ae.learning.online import OnlineLearner, make_updater
from musculoskeletal_ae.learning.paper_updater import PaperUpdater
from musculoskeletal_ae.learning.update import Job, learned_steps
from musculoskeletal_ae.mae.residuals import residuals


def error(mae, theta, tension, length):
    return float(np.linalg.norm(mae.estimate(tension, length).theta - theta, axis=1).mean())


def job(store, messages=None, time=0.0, steps=60, hold=True, rests=100):
    empty = np.empty((0, 12), dtype=np.float32)
    healthy = Healthy(empty if messages is None else messages, time, rests)
    return Job(store.observations(), healthy, hold, steps, 1)


@pytest.fixture(scope='module')
def learned(arm26, initial, other_body):
    from .conftest import Stage

    stage = Stage(other_body)
    updater = BodyUpdater(arm26, initial)
    store = stage.store(20)
    for _ in range(6):
        update = updater.update(job(store))
    return update.mae, updater, store, stage


def test_twenty_samples_halve_the_error(learned, initial):
    mae, _, _, stage = learned
    states = stage.states(1000)
    assert error(mae, *states) < 0.5 * error(initial, *states)


def test_old_postures_are_not_forgotten_when_new_samples_are_all_alike(learned):
    mae, updater, store, stage = learned
    states = stage.states(1000)
    before = error(mae, *states)
    newest = stage.sample()
    for _ in range(10):
        store.add(newest)
    for _ in range(3):
        update = updater.update(job(store))
    assert error(update.mae, *states) < 1.2 * before


def test_a_changed_muscle_is_noticed_unasked(arm26, initial, stage):
    updater, store = BodyUpdater(arm26, initial), stage.store(20)
    assert updater.update(job(store, steps=1)).changed == ()
    for _ in range(5):
        sample = stage.sample()
        shift = 0.01 * (np.arange(6) == 3)
        store.add(sample._replace(length=sample.length + shift))
    assert updater.update(job(store, steps=1)).changed == ((3, 5),)


def test_a_slipped_joint_sensor_reopens_no_muscle(arm26, initial, stage):
    updater, store = BodyUpdater(arm26, initial), stage.store(20)
    updater.update(job(store, steps=1))
    for _ in range(4):
        sample = stage.sample()
        store.add(sample._replace(theta=sample.theta + np.array([0.15, 0.0])))
    update = updater.update(job(store, steps=1))
    assert update.changed == ()
    assert len(update.doubtful) > 1


def messages(stage, count):
    _, tension, length = stage.states(count)
    return np.concatenate([tension, length], axis=1).astype(np.float32)


def test_the_detector_is_calibrated_only_with_enough_healthy_data(learned):
    _, updater, store, stage = learned
    few = updater.update(job(store, messages(stage, 100), LEAST_TIME - 1.0, 1)).mae.anomaly
    assert not few.calibrated
    enough = updater.update(job(store, messages(stage, 600), LEAST_TIME, 1)).mae
    assert enough.anomaly.calibrated
    kept = updater.update(job(store, messages(stage, 10), 1.0, 1)).mae.anomaly
    assert kept.calibrated  # as after a restart, whose messages are few
    lost = updater.update(job(store, messages(stage, 10), 1.0, 1, hold=False)).mae.anomaly
    assert not lost.calibrated  # after a muscle was replaced


def test_one_posture_is_not_enough_for_a_detector(learned):
    _, updater, store, stage = learned
    seen = messages(stage, 600)
    few = updater.update(job(store, seen, LEAST_TIME, 1, hold=False, rests=LEAST_SAMPLES - 1)).mae
    assert not few.anomaly.calibrated


def test_the_statistics_of_many_rests_are_kept_until_there_are_as_many_again(learned):
    _, updater, store, stage = learned
    before = updater.update(job(store, messages(stage, 600), LEAST_TIME, 1)).mae.anomaly
    assert before.calibrated
    after = updater.update(job(store, messages(stage, 600), LEAST_TIME, 1, rests=1)).mae.anomaly
    assert after is before


def test_a_glitch_does_not_spoil_the_detector(learned):
    mae, _, store, stage = learned
    seen = messages(stage, 1000)
    clean = calibrate(mae, Healthy(seen, LEAST_TIME, 50), len(store))
    for row in range(int(GLITCHES * len(seen))):
        seen[100 * row + 7, 6 + row] += 0.2
    spoilt = calibrate(mae, Healthy(seen, LEAST_TIME, 50), len(store))
    assert clean.samples == 1000
    assert spoilt.samples == 1000 - int(GLITCHES * len(seen))
    for name, threshold in clean.thresholds.items():
        assert spoilt.thresholds[name] == pytest.approx(threshold, rel=0.02)


def test_healthy_messages_stay_below_the_threshold_and_a_cut_muscle_does_not(learned):
    _, updater, store, stage = learned
    mae = updater.update(job(store, messages(stage, 600), LEAST_TIME, 1)).mae
    statistics = mae.anomaly

    def distance(tension, length):
        centred = residuals(mae.estimate(tension, length), tension, length) - statistics.mean
        whitened = np.linalg.solve(np.linalg.cholesky(statistics.covariance), centred.T)
        return np.linalg.norm(whitened, axis=0)

    _, tension, length = stage.states(2000)
    threshold = statistics.thresholds[DISTANCE]
    assert distance(tension, length).max() < threshold
    cut = distance(tension * (np.arange(6) != 2), length - 0.1 * (np.arange(6) == 2))
    assert cut.min() > threshold


def test_the_reservoir_is_a_uniform_draw_of_bounded_size():
    reservoir = Reservoir(1, capacity=200)
    for n in range(4000):
        reservoir.step(np.array([float(n)]), np.zeros(1), 0.1)
    kept = reservoir.messages()[:, 0]
    assert len(kept) == 200
    assert abs(kept.mean() - 2000.0) < 400.0
    assert reservoir.time == pytest.approx(400.0)


def test_preset_paper_waits_for_its_samples_and_takes_a_hundred_steps(arm26, initial, stage):
    updater = PaperUpdater(arm26, initial)
    assert updater.least_samples == paper_updater.THRESHOLD + 1
    store = stage.store(updater.least_samples)
    states = stage.states(500)
    for _ in range(10):
        update = updater.update(job(store))
    assert error(update.mae, *states) < error(initial, *states)


def test_one_stream_gives_one_network(arm26, initial, stage):
    rests = [stage.sample() for _ in range(4)]
    networks = []
    for _ in range(2):
        learner = OnlineLearner(arm26, initial, steps=3)
        for rest in rests:
            for _ in range(110):
                learner.step(rest.tension, rest.length, 0.01, rest.theta)
        for _ in range(300):
            learner.step(rest.tension, rest.length, 0.01)
        networks.append(learner.mae)
    assert networks[0].version >= 2
    np.testing.assert_array_equal(networks[0].encoder[0][0], networks[1].encoder[0][0])


def test_an_unknown_preset_is_refused_with_the_legal_ones(arm26, initial):
    with pytest.raises(MusculoskeletalError, match='default, paper'):
        make_updater(arm26, initial, 'best')


def test_preset_paper_learns_nothing_of_a_changed_muscle_from_old_samples(arm26, initial, stage):
    updater = PaperUpdater(arm26, initial)
    store = stage.store(30)
    store.forget(1, 5)
    update = updater.update(job(store))
    np.testing.assert_array_equal(update.mae.encoder[0][0], initial.encoder[0][0])
    for _ in range(updater.least_samples - 5):
        store.add(stage.sample())
    update = updater.update(job(store))
    assert (update.mae.encoder[0][0] != initial.encoder[0][0]).any()


def test_a_learned_network_without_its_samples_is_not_forgotten(learned, arm26):
    mae, _, _, stage = learned
    states = stage.states(1000)
    before = error(mae, *states)
    updater = BodyUpdater(arm26, mae)
    store = stage.store(2)
    for _ in range(3):
        update = updater.update(job(store))
        store.add(stage.sample())
    assert error(update.mae, *states) < 1.2 * before


def test_a_learner_that_starts_again_goes_on_as_calmly_as_it_was(learned, arm26):
    mae, _, store, stage = learned
    assert learned_steps(mae) > 0
    states = stage.states(1000)
    again = BodyUpdater(arm26, mae)
    for _ in range(2):
        update = again.update(job(store))
    assert error(update.mae, *states) < 1.1 * error(mae, *states)
    assert learned_steps(update.mae) == learned_steps(mae) + 2 * 60


def test_a_network_of_another_arm_is_learned_anew_as_fast_as_one_of_geometry(
    learned, arm26, initial
):
    from .conftest import Stage

    other = CorrectedBody(arm26, seed=8)
    rng = np.random.default_rng(5)
    for m, layout in enumerate(other.layouts):
        other.parameters[m] = Prior().spread(layout) * rng.standard_normal(layout.size)
    stage = Stage(other)
    states = stage.states(1000)
    store = stage.store(20)
    ends = []
    for start in (learned[0], initial):
        updater = BodyUpdater(arm26, start)
        for _ in range(6):
            update = updater.update(job(store))
        ends.append(error(update.mae, *states))
    assert ends[0] < 1.3 * ends[1]


def test_a_network_of_geometry_brings_no_body(arm26, initial):
    assert learned_steps(initial) == 0
    body = BodyUpdater(arm26, initial).body
    assert all((parameters == 0.0).all() for parameters in body.parameters)
