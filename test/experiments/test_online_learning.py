# SPDX-License-Identifier: Apache-2.0
"""Conditions of a fair comparison: same motion, same stream, same seeds."""

import math
import shutil
from dataclasses import replace

import numpy as np
import pytest

from musculoskeletal_ae.body_model.observations import Sample
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.experiments import online_learning, saved_results
from musculoskeletal_ae.experiments.online_learning import (
    Curve,
    exponential_fit,
    samples_to_halve,
)
from musculoskeletal_ae.experiments.recording import (
    EXPLORATION_STREAM,
    HELD_OUT_STREAM,
    SAMPLE_TIME,
    ClosedLoop,
    record,
)
from musculoskeletal_ae.experiments.sensors import SIGHTED, sighted
from musculoskeletal_ae.experiments.study import round_numbers
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.presets.registry import PRESETS


def saved_numbers(study):
    return saved_results.read(study.folder / 'online_learning_0.npz').numbers


@pytest.mark.thorough
def test_the_same_seed_gives_the_same_numbers_and_network_in_another_process(
    study, tmp_path, monkeypatch
):
    again = replace(study, folder=tmp_path)
    for preset in PRESETS:
        shutil.copy(study.network_file(preset, None), tmp_path)
    # Only preset `default` explores. Preset `paper` still learns, from the same stream.
    monkeypatch.setattr(online_learning, 'PRESETS', ('default',))
    numbers = online_learning.measure(again, 0).numbers
    before = saved_numbers(study)
    assert round_numbers(numbers) == {key: before[key] for key in numbers}
    assert {'after_rad', 'paper_same_stream_after_rad'} <= set(numbers)
    networks = [each.network(0, 'default') for each in (study, again)]
    for layer in range(len(networks[0].decoder)):
        np.testing.assert_array_equal(*[network.decoder[layer][0] for network in networks])


def test_both_presets_learn_each_from_its_own_exploration(study):
    numbers = saved_numbers(study)
    assert min(numbers[f'{prefix}samples'] for prefix in ('', 'paper_')) > 0
    assert numbers['updates'] > 0
    changed = study.network(0).decoder[0][0] - study.network(None).decoder[0][0]
    assert np.abs(changed).max() > 0.0


def test_exploration_goes_through_the_controller_with_the_network_being_learned(study):
    """No command jumps, and the targets follow the network as it learns."""
    taken = study.stream(0, 'exploring')
    step = np.abs(np.diff(taken.command, axis=0)).max()
    assert 0.0 < step <= Settings().rate_limit * SAMPLE_TIME + 1e-9
    driven = ClosedLoop(study.arm(0), study.network(None), seed=EXPLORATION_STREAM)
    fixed = np.array([driven.explore()[-1] for _ in taken.command])
    apart = np.abs(fixed - taken.command).max(axis=1)
    assert apart[0] == 0.0 and apart[-1] > 1e-4


def test_the_held_out_motion_has_the_same_commands_for_every_individual(study):
    other = record(study.arm(1), study.network(None), HELD_OUT_STREAM, study.held_out_time)
    one = study.stream(0, 'held_out')
    # Each arm starts its first ramp from another posture. From the second target on (sample 500),
    # the commands are equal.
    start = 500
    np.testing.assert_array_equal(one.command[start:], other.command[start:])
    assert np.abs(one.theta - other.theta).max() > 1e-3  # the arms differ


def test_the_held_out_motion_is_not_the_one_learned_from(study):
    learned, held_out = (study.stream(0, name).command for name in ('exploring', 'held_out'))
    assert np.abs(learned[499] - held_out[499]).max() > 1e-3


def test_the_fit_finds_an_exponential():
    time = 0.01 * np.arange(60_000)
    error = 0.15 + 0.17 * np.exp(-time / 90.0)
    np.testing.assert_allclose(exponential_fit(time, error), error, atol=1e-6)


def test_the_error_counts_as_halved_once_it_stays_below_half():
    samples, none = [0, 5, 10, 15], np.zeros(0)
    assert samples_to_halve(Curve(samples, [1.0, 0.4, 0.6, 0.3], none)) == 15
    assert samples_to_halve(Curve(samples, [1.0, 0.4, 0.3, 0.2], none)) == 5
    assert samples_to_halve(Curve(samples, [1.0, 0.4, 0.3, 0.6], none)) is None
    assert samples_to_halve(Curve([0], [math.e], none)) is None


def test_a_full_sample_store_does_not_change_how_often_a_marker_is_used(arm26):
    learner, nothing = Learner(arm26), np.zeros(arm26.muscle_count)
    learner.samples.capacity = 2 * SIGHTED
    observed = []
    for count in range(6 * SIGHTED):
        observed.append(sighted(learner))
        learner.accept(Sample(np.full(2, 0.1 * count), nothing, nothing, nothing))
    assert np.flatnonzero(observed).tolist() == list(range(0, 6 * SIGHTED, SIGHTED))
