# SPDX-License-Identifier: Apache-2.0
"""Nothing is learned from lengths with wrong offsets, and a false finding costs no sample."""

from dataclasses import replace

import numpy as np
import pytest

from learning.test_learner import Arm, IdleTrainer
from musculoskeletal_ae.bags.streams import Pairs
from musculoskeletal_ae.estimation.finding import DETECTION_DELAY
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.recordings import learn
from musculoskeletal_ae.signals.body_state import LengthOffsets, Trust

OFF = 0.08 * np.array([1.0, 0.9, -0.8, -0.9, 0.9, -1.0])
POSTURE = 1.0 + DETECTION_DELAY + 0.5  # duration of a rest that is long enough for a sample [s]


class ArmWithOffsets(Arm):
    """An arm with length offsets."""

    off = np.zeros(6)

    def send(self, sample):
        super().send(sample._replace(length=sample.length + self.off))


@pytest.fixture
def learner(arm26, initial):
    return Learner(arm26, initial, trainer=IdleTrainer)


@pytest.fixture
def arm(learner, stage):
    arm = ArmWithOffsets(learner, stage)
    for _ in range(2):
        arm.rest(POSTURE)
    assert len(learner.samples) == 2
    return arm


def use(learner, offset, known=True):
    trust = Trust.KNOWN if known else Trust.UNKNOWN
    offsets = LengthOffsets.of(np.asarray(offset, dtype=float), 0.001, trust)
    learner.use_body(learner.body.with_offsets(offsets))


def revoke(learner):
    offsets = replace(learner.body.offsets, trust=np.full(6, Trust.REVOKED))
    learner.use_body(learner.body.with_offsets(offsets))


def lengths(learner):
    return [sample.length for sample in learner.samples.samples]


def test_a_calibration_that_finds_the_same_offsets_costs_nothing(learner, arm):
    before = lengths(learner)
    use(learner, np.zeros(6), known=False)
    for _ in range(2):
        arm.rest(POSTURE)
    assert len(learner.samples) == 2
    use(learner, np.full(6, 0.001))
    arm.rest(POSTURE)
    assert len(learner.samples) == 3
    np.testing.assert_array_equal(lengths(learner)[:2], before)
    assert learner.report().level == 'ok'


def test_zeros_that_a_power_cycle_changed_are_believed_and_older_samples_stay(learner, arm):
    before = lengths(learner)
    use(learner, np.zeros(6), known=False)
    arm.off = OFF
    arm.rest(POSTURE)
    use(learner, OFF)
    for _ in range(2):
        arm.rest(POSTURE)
    assert len(learner.samples) >= 3
    np.testing.assert_array_equal(lengths(learner)[:2], before)


def test_samples_of_the_last_seconds_before_a_finding_are_put_back_if_it_was_false(learner, arm):
    before = lengths(learner)
    revoke(learner)
    assert len(learner.samples) < 2
    use(learner, np.zeros(6), known=False)
    use(learner, np.full(6, 0.002))
    arm.rest(3.0)
    np.testing.assert_array_equal(lengths(learner)[:2], before)


@pytest.mark.parametrize(('found', 'kept'), [(0.002, 2), (0.09, 1)])
def test_a_learner_that_is_killed_after_a_finding_judges_the_same_samples(
    arm26, initial, stage, tmp_path, found, kept
):
    learner = Learner(arm26, initial, trainer=IdleTrainer, directory=tmp_path)
    arm = ArmWithOffsets(learner, stage)
    arm.rest(POSTURE)
    use(learner, np.full(6, 0.001))
    arm.rest(2.0 * POSTURE)
    before, accepted = lengths(learner), learner.samples.accepted
    assert len(before) == 2
    revoke(learner)
    assert len(learner.samples) == 1
    learner.keeper.close()  # all that remains of a killed learner is what it has saved
    learner = Learner(arm26, initial, trainer=IdleTrainer, directory=tmp_path)
    assert len(learner.samples) == 1
    assert learner.samples.accepted == accepted
    arm = ArmWithOffsets(learner, stage)
    use(learner, np.zeros(6), known=False)
    arm.off = np.full(6, found - 0.002)
    use(learner, np.full(6, found))
    arm.rest(3.0)
    np.testing.assert_array_equal(lengths(learner)[:kept], before[:kept])


def test_they_are_dropped_if_other_zeros_are_found(learner, arm):
    (first, *_), numbers = lengths(learner), learner.samples.accepted
    revoke(learner)
    held = 2 - len(learner.samples)
    assert held > 0
    use(learner, np.zeros(6), known=False)
    arm.off = OFF
    use(learner, OFF)
    np.testing.assert_array_equal(lengths(learner), [first][: 2 - held])
    arm.rest(POSTURE)
    assert learner.report().values['not learned: wrong length offsets'] == str(held)
    assert learner.samples.accepted >= numbers
    for each in learner.samples.stored:
        assert each.number == 1 or each.number > numbers


def test_nothing_of_a_recording_is_learned_after_its_lengths_have_jumped(arm26, initial, stage):
    sample, time = stage.sample(), 0.01 * np.arange(1200)
    has_jumped = np.repeat([False, True], 600)[:, None]
    recording = Pairs(
        time,
        np.tile(sample.theta, (len(time), 1)),
        sample.length + OFF * has_jumped,
        sample.tension + 20.0 * has_jumped,  # the rests after the jump would be new samples
        np.zeros((len(time), 6), dtype=int),
    )
    learner = Learner(arm26, initial, trainer=IdleTrainer)
    assert 'lengths_jumped' in learn(learner, recording)
    np.testing.assert_allclose(lengths(learner), [sample.length])
