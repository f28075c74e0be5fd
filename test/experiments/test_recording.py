# SPDX-License-Identifier: Apache-2.0
"""Recording an arm that follows commands, with a script of events."""

from dataclasses import replace

import numpy as np
import pytest
from readings import reading

from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.experiments.recording import (
    SAMPLE_TIME,
    end_tensions,
    record,
    rows_between,
    times,
)
from musculoskeletal_ae.experiments.study import Study
from musculoskeletal_ae.mae.residuals import TouchStatistics


@pytest.fixture(scope='module')
def mae(trained):
    return trained['default']


@pytest.fixture(scope='module')
def plain(arm26, mae):
    return record(EmulatedArm(arm26, 3), mae, 7, 8.0)


def test_a_recording_lasts_for_whole_steps_and_rests_at_the_end_of_each(plain):
    # Steps end after 5, 7 and 10 s, so a recording of at least 8 s takes 10 s.
    assert len(plain.theta) == round(10.0 / SAMPLE_TIME)
    for end in (5.0, 7.0, 10.0):
        commands = plain.command[rows_between(end - 0.5, end)]
        np.testing.assert_array_equal(commands, np.broadcast_to(commands[0], commands.shape))


def test_a_script_is_called_in_every_step_and_an_empty_one_changes_nothing(arm26, mae, plain):
    reported = []

    def script(arm, time):
        assert isinstance(arm, EmulatedArm)
        reported.append(time)

    recording = record(EmulatedArm(arm26, 3), mae, 7, 8.0, script)
    for ours, theirs in zip(recording, plain, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(reported, times(len(plain.theta)))


def test_a_script_changes_the_arm_from_its_time_on(arm26, mae, plain):
    def load(arm, time):
        if time == 2.0:
            arm.set_payload(3.6)

    loaded = record(EmulatedArm(arm26, 3), mae, 7, 8.0, load)
    before, after = rows_between(0.0, 2.0), rows_between(2.0, 5.0)
    np.testing.assert_array_equal(loaded.theta[before], plain.theta[before])
    assert np.abs(loaded.theta[after] - plain.theta[after]).max() > 0.01
    np.testing.assert_array_equal(loaded.command, plain.command)


def test_an_arm_without_friction_is_otherwise_the_same_body(arm26, tmp_path):
    study = Study(arm26, 'default', (3,), 1.0, True, tmp_path)
    smooth, rubbing = study.arm(3, friction=False).individual, study.arm(3).individual
    assert not smooth.tendon_friction.any() and not smooth.joint_friction.any()
    assert rubbing.tendon_friction.all() and rubbing.joint_friction.all()
    theta = arm26.random_postures(3, np.random.default_rng(0))
    np.testing.assert_array_equal(smooth.absolute_lengths(theta), rubbing.absolute_lengths(theta))


def test_a_recording_is_estimated_as_by_the_estimator(arm26, mae, plain):
    spread, rubbing = np.ones(arm26.joint_count), np.full(arm26.muscle_count, 0.1)
    mae = replace(mae, touch=TouchStatistics(rubbing, spread))
    core, estimated = Estimator(arm26), []
    core.use(mae)
    for now, tension, length in zip(times(len(plain.length)), plain.tension, plain.length):
        states = np.array([length, tension, np.full(arm26.muscle_count, 25.0)])
        estimated.append(core.take(reading(states), now, now).state.theta)
    tension = end_tensions(mae, plain)
    np.testing.assert_allclose(mae.estimate(tension, plain.length).theta, estimated, atol=1e-6)
    # Tendon friction must have had an effect, because the comparison would be trivial otherwise.
    assert np.abs(np.log(tension / plain.tension)).max() > 0.09
