# SPDX-License-Identifier: Apache-2.0
"""The network follows the calibrated body; preset `paper` does what the paper states."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from musculoskeletal_ae.body_model.body_fit import BodyFit
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.synthetic import UNKNOWN_FRICTION, synthetic_samples
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.learning.body_updater import BodyUpdater, learned_steps
from musculoskeletal_ae.learning.network_trainer import NetworkTrainer
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.learning.training_process import Trainer
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.network import from_mae
from musculoskeletal_ae.mae.units import scale_vector
from musculoskeletal_ae.paper.constants import THRESHOLD
from musculoskeletal_ae.paper.online_learning import OnlineLearning

from .conftest import Stage, drawn_body, job

QUANTILE = -2.0 * np.log(0.05)  # 95 % quantile of χ² with the 2 degrees of freedom of arm26


def error(mae, theta, tension, length):
    return float(np.linalg.norm(mae.estimate(tension, length).theta - theta, axis=1).mean())


def test_twenty_samples_halve_the_error(learned, initial):
    mae, _, _, stage = learned
    states = stage.states(1000)
    assert error(mae, *states) < 0.5 * error(initial, *states)


def test_constant_length_differences_are_learned_in_one_step(arm26, initial):
    longer = CalibratedBody(arm26)
    for parameters, layout in zip(longer.parameters, longer.layouts, strict=True):
        parameters[layout.offset] = 0.008
    stage = Stage(longer)
    states = stage.states(1000)
    update = BodyUpdater(arm26, initial).update(job(stage.store(30), steps=1))
    assert error(update.mae, *states) < 0.5 * error(initial, *states)


def test_old_postures_are_not_forgotten_when_new_samples_are_all_alike(learned):
    mae, updater, store, stage = learned
    states = stage.states(1000)
    before = error(mae, *states)
    newest = stage.sample()
    for _ in range(10):
        store.add(newest)
    update = updater.update(job(store))
    assert error(update.mae, *states) < 1.2 * before


class CompliantStage(Stage):
    """An arm with compliant route points, which no calibrated body can describe."""

    def observations(self, count):
        drawn = super().observations(count)
        give = 0.006 * np.sin(4.0 * drawn.theta[:, :1]) * (drawn.tension - 115.0) / 85.0
        return replace(drawn, length=drawn.length + give)


def test_motion_samples_teach_differences_that_the_body_model_cannot_represent(
    arm26, initial, other_body
):
    def learned(**parts):
        updater = BodyUpdater(arm26, initial)
        for _ in range(2):
            update = updater.update(job(store, steps=100, **parts))
        return error(update.mae, observed.theta, observed.tension, observed.length)

    stage = CompliantStage(other_body)
    store = stage.store(30)
    observed, messages = stage.observations(400), stage.observations(400)
    # For three bodies, motion samples multiplied the error by 0.89 to 0.96. After four updates of
    # 150 steps, the factor was 0.91 over eight bodies and streams (standard deviation 0.02).
    assert learned(learned=messages) < 0.98 * learned()


def test_motion_samples_that_contradict_the_body_model_are_not_learned(arm26, initial, stage):
    def learned(**parts):
        update = BodyUpdater(arm26, initial).update(job(store, steps=10, **parts))
        return update.mae.encoder[0][0]

    store, wrong = stage.store(30), stage.observations(300)
    wrong.theta[:, 0] += 0.3  # a joint sensor slipped by this angle [rad]
    np.testing.assert_array_equal(learned(learned=wrong), learned())


def test_the_covariance_covers_95_percent_of_validation_messages(arm26, initial, stage):
    judging, fresh = stage.observations(1000), stage.observations(1000)
    for observed in (judging, fresh):
        observed.length[:] += 0.003 * stage.rng.standard_normal(observed.length.shape)

    def inside(**parts):
        mae = BodyUpdater(arm26, initial).update(job(store, steps=40, **parts)).mae
        tension = fresh.end_tension(mae.transmission)
        off = mae.estimate(tension, fresh.length).theta - fresh.theta
        distance = np.einsum('ni,ni->n', off, np.linalg.solve(mae.covariance, off.T).T)
        return (distance <= QUANTILE).mean()

    store = stage.store(30)
    assert inside() < 0.8
    # After 100 steps, over eight drawn bodies, the share was 0.46 to 0.59 without validation
    # messages, and 0.94 with them (standard deviation 0.02). After 40 steps, it is the same.
    assert inside(judging=judging) == pytest.approx(0.95, abs=0.07)


def test_a_changed_muscle_is_detected(arm26, initial, stage):
    updater, store = BodyUpdater(arm26, initial), stage.store(20)
    assert updater.update(job(store, steps=1)).changed == ()
    for _ in range(5):
        sample = stage.sample()
        # In 20 drawn bodies, this shift was always detected, and one of 0.01 m in two of three.
        shift = 0.02 * (np.arange(6) == 3)
        store.add(sample._replace(length=sample.length + shift))
    assert updater.update(job(store, steps=1)).changed == ((3, 21),)  # the first of the five


def test_a_slipped_joint_sensor_is_not_taken_for_a_changed_muscle(arm26, initial, stage):
    updater, store = BodyUpdater(arm26, initial), stage.store(20)
    updater.update(job(store, steps=1))
    for _ in range(4):
        sample = stage.sample()
        store.add(sample._replace(theta=sample.theta + np.array([0.15, 0.0])))
    assert updater.update(job(store, steps=1)).changed == ()


@pytest.mark.thorough
def test_all_of_the_training_is_on_the_device_that_was_chosen(initial, other_body):
    data = synthetic_samples(other_body, np.zeros(6), 200, np.random.default_rng(0))
    # Tensors on the device `meta` have no values. Training therefore runs to its end, where reading
    # the loss fails.
    with torch.device('meta'):
        trainer = NetworkTrainer(from_mae(initial))
        with pytest.raises(RuntimeError, match='item'):
            trainer.train(data, 1)
    assert trainer.steps == 1


def test_synthetic_lengths_scatter_by_the_unknown_part_of_friction(other_body):
    data = synthetic_samples(other_body, np.zeros(6), 2000, np.random.default_rng(0))
    scale = scale_vector(2, 6)
    theta, tension, length = np.split(data.true / scale, [2, 8], axis=1)
    observed = data.entered / scale
    off = observed[:, 8:] - length
    np.testing.assert_array_equal(observed[:, :8], np.hstack([theta, tension]))
    all_of_it = [
        other_body.lengths(theta, tension, way * np.ones_like(length))[0] for way in (-1, 1)
    ]
    assert np.abs(off).max() < 1.5 * UNKNOWN_FRICTION * np.abs(all_of_it - length).max()
    assert abs(np.sign(off).mean()) < 0.1 and np.abs(off).mean() > 1e-5


def test_preset_paper_takes_100_steps_in_each_update(arm26, initial, stage):
    updater = OnlineLearning(arm26, initial)
    store = stage.store(THRESHOLD + 1)
    states = stage.states(500)
    for _ in range(3):
        update = updater.update(job(store))
    assert error(update.mae, *states) < error(initial, *states)
    assert f'preset paper, {3 * 100} steps' in update.mae.training


def test_preset_paper_learns_nothing_of_a_changed_muscle_from_old_samples(arm26, initial, stage):
    updater = OnlineLearning(arm26, initial)
    store = stage.store(30)
    store.forget(1, before=26)
    update = updater.update(job(store))
    np.testing.assert_array_equal(update.mae.encoder[0][0], initial.encoder[0][0])
    for _ in range(THRESHOLD - 4):
        store.add(stage.sample())
    update = updater.update(job(store))
    assert (update.mae.encoder[0][0] != initial.encoder[0][0]).any()


def test_an_unknown_preset_is_refused_with_the_legal_ones(arm26):
    with pytest.raises(MusculoskeletalError, match='default, paper'):
        Trainer(arm26, 'best')


def test_an_update_on_few_samples_keeps_most_of_a_learned_network(learned, arm26, initial):
    mae, _, _, stage = learned
    states, two = stage.states(1000), job(stage.store(2))
    # An update on two samples multiplies the error by 1.1 to 2.5, depending on the seed. Compare
    # the means of two seeds.
    going_on, anew = (
        np.mean([error(BodyUpdater(arm26, each, s).update(two).mae, *states) for s in range(2)])
        for each in (mae, initial)
    )
    assert going_on < 0.75 * anew


def test_a_restarted_learner_continues_with_small_changes(learned, arm26):
    mae, _, store, stage = learned
    assert learned_steps(mae) == 3 * 60
    states = stage.states(1000)
    updates = [BodyUpdater(arm26, mae, seed).update(job(store)) for seed in range(3)]
    errors = [error(update.mae, *states) for update in updates]
    assert np.mean(errors) < 1.1 * error(mae, *states)
    assert learned_steps(updates[0].mae) == learned_steps(mae) + 60


@pytest.mark.thorough
def test_a_network_of_another_arm_adapts_as_fast_as_an_initial_one(learned, arm26, initial):
    stage = Stage(drawn_body(arm26, 8, 5, 1.0))
    states = stage.states(1000)
    store = stage.store(20)
    ends = []
    for start in (learned[0], initial):
        update = BodyUpdater(arm26, start).update(job(store))
        ends.append(error(update.mae, *states))
    assert ends[0] < 1.3 * ends[1]


def test_sensor_offsets_and_creep_do_not_look_like_another_arm(learned, arm26):
    mae, _, _, stage = learned
    store, offset = SampleStore(), np.deg2rad([5.0, 5.0])
    for _ in range(60):
        sample, crept = stage.sample(), 0.01 * (len(store) < 40)  # tendons were shorter before
        store.add(sample._replace(theta=sample.theta + offset, length=sample.length - crept))
    assert not BodyFit(arm26, mae).is_of_another_arm(store.observations())
    other = Stage(drawn_body(arm26, 8, 5, 1.0))
    for count in (4, 60):
        assert BodyFit(arm26, mae).is_of_another_arm(other.observations(count))


def test_removing_tendon_friction_improves_the_estimate(learned):
    mae, _, _, stage = learned
    observed = stage.observations(500)
    read, end = (
        error(mae, observed.theta, tension, observed.length)
        for tension in (observed.tension, observed.end_tension(mae.transmission))
    )
    assert end < 0.8 * read


def test_an_initial_network_has_no_body_corrections(arm26, initial):
    assert learned_steps(initial) == 0
    body = BodyUpdater(arm26, initial).body
    assert all((parameters == 0.0).all() for parameters in body.parameters)


def test_the_covariance_of_a_network_covers_its_errors_and_is_saved(arm26, learned):
    mae, _, _, stage = learned
    theta, tension, length = stage.states(1000)
    error = mae.estimate(tension, length).theta - theta
    distance = np.einsum('ni,ni->n', error, np.linalg.solve(mae.covariance, error.T).T)
    inside = (distance <= QUANTILE).mean()
    # The ellipsoid covers 95 % of the errors if they follow the prior. This body is drawn from the
    # prior.
    assert inside > 0.8
    spread = np.sqrt(np.diag(mae.covariance))
    assert (spread < 5.0 * error.std(axis=0)).all()
    again = checkpoint.from_bytes(checkpoint.to_bytes(mae), arm26)
    np.testing.assert_array_equal(again.covariance, mae.covariance)
