# SPDX-License-Identifier: Apache-2.0
"""The learner follows the estimator's decisions, and saves only networks that it has accepted."""

from dataclasses import replace

import numpy as np
import pytest

from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.scheduler import Update
from musculoskeletal_ae.learning.training_process import Trainer
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.residuals import TouchStatistics
from musculoskeletal_ae.signals.body_state import Anomaly

REASON = 'l by ①, brachialis: error 3 relative to the spread, from the geometric model, limit 1.7'


class ScriptedTrainer(Trainer):
    """A trainer whose updates the test chooses."""

    answer = None

    def poll(self):
        mae, self.answer = self.answer, None
        return None if mae is None else Update(mae, 0.0)


class Scene:
    """A learner with a state directory, and the checkpoints that it has published."""

    def __init__(self, robot, mae, directory):
        self._robot, self._directory, self._time = robot, directory, 0.0
        self.learner = Learner(robot, mae, trainer=ScriptedTrainer, directory=directory)
        self.published = []
        self.wait()

    def wait(self):
        """Let ten seconds pass, in which the learner publishes what is due."""
        self._time += 10.0
        if (data := self.learner.poll(self._time)) is not None:
            self.published.append(checkpoint.from_bytes(data, self._robot))

    def propose(self, mae):
        """Let an update end with this network; return the candidate that is published."""
        self.learner.trainer.answer = mae
        self.wait()
        return self.published[-1]

    def reject(self, mae):
        """Pass on that the estimator has rejected this network."""
        self.learner.note_rejected(mae.version, REASON)

    def saved(self):
        """End the learner; return the version with which the next one begins."""
        self.learner.close()
        with_state = Learner(self._robot, trainer=ScriptedTrainer, directory=self._directory)
        with_state.close()
        return with_state.mae.version

    @property
    def backups(self):
        """Number of backups in the state directory."""
        return len(list(self._directory.glob('backup-*.state')))


@pytest.fixture
def scene(arm26, initial, tmp_path):
    scene = Scene(arm26, initial, tmp_path / 'state')
    yield scene
    scene.learner.close()


def test_without_an_estimator_every_network_is_saved(scene, initial):
    candidate = scene.propose(initial)
    assert scene.saved() == candidate.version


def test_a_candidate_is_saved_when_the_estimator_has_accepted_it(scene, initial):
    first = scene.published[-1]
    scene.learner.note_accepted(first)
    candidate = scene.propose(initial)
    assert candidate.version > first.version
    assert checkpoint.from_bytes(scene.learner.checkpoint).version == first.version
    scene.learner.note_accepted(candidate)
    assert scene.saved() == candidate.version


def test_a_rejected_candidate_is_not_saved_and_the_network_in_use_is_published_again(
    scene, initial
):
    first = scene.published[-1]
    scene.learner.note_accepted(first)
    candidate = scene.propose(initial)
    scene.reject(candidate)
    scene.wait()
    assert scene.published[-1].version == first.version
    values = scene.learner.report().values
    assert values['rejected networks'] == '1'
    assert values['last rejected network'] == REASON
    # The number of a rejected network is not used again.
    assert scene.propose(initial).version > candidate.version
    assert scene.saved() == first.version
    assert scene.backups == 0


def test_an_answer_to_an_earlier_candidate_does_not_touch_a_newer_one(scene, initial):
    scene.learner.note_accepted(scene.published[-1])
    earlier, newer = scene.propose(initial), scene.propose(initial)
    scene.reject(earlier)
    scene.wait()
    assert scene.published[-1].version == newer.version
    scene.learner.note_accepted(newer)
    assert scene.saved() == newer.version


def test_a_decision_on_a_network_of_an_earlier_learner_concerns_no_network_of_this_one(
    scene, initial
):
    first = scene.published[-1]
    scene.learner.note_rejected(first.version + 1, REASON)
    candidate = scene.propose(initial)
    scene.learner.note_accepted(first)
    scene.wait()
    assert scene.published[-1].version == candidate.version > first.version + 1


def test_a_network_that_a_user_starts_from_anew_is_saved_at_once(scene, initial):
    scene.learner.note_accepted(scene.published[-1])
    scene.learner.replace(initial)
    scene.wait()
    assert scene.saved() == scene.published[-1].version


@pytest.mark.parametrize('is_rejected_first', [False, True])
def test_the_learner_returns_with_the_estimator_and_keeps_the_doubtful_network_as_a_backup(
    scene, initial, is_rejected_first
):
    first = scene.published[-1]
    scene.learner.note_accepted(first)
    doubtful = scene.propose(initial)
    scene.learner.note_accepted(doubtful)
    scene.learner.use_body(scene.learner.body.with_anomaly(Anomaly.FOUND, 0))
    # The messages on two topics may arrive in either order.
    if is_rejected_first:
        scene.reject(doubtful)
    scene.learner.note_accepted(first)
    if not is_rejected_first:
        scene.reject(doubtful)
    scene.wait()
    assert scene.published[-1].version == first.version
    assert scene.saved() == first.version
    assert scene.backups == 1


def test_a_network_that_a_user_gives_the_estimator_does_not_replace_the_learned_one(scene, initial):
    learned = scene.propose(initial)
    scene.learner.note_accepted(learned)
    scene.learner.note_accepted(replace(initial, version=77))
    scene.wait()
    assert scene.published[-1].version == learned.version
    assert scene.saved() == learned.version


def test_the_first_network_stays_if_it_is_rejected(scene):
    first = scene.published[-1]
    scene.reject(first)
    scene.wait()
    assert scene.learner.mae.version == first.version
    assert len(scene.published) == 1


def test_the_residual_torque_of_the_estimator_is_saved_and_stays_in_the_next_candidate(
    scene, initial
):
    unmeasured = TouchStatistics(np.zeros(6), np.ones(2))
    candidate = scene.propose(replace(initial, touch=unmeasured))
    measured = replace(unmeasured, spread=np.full(2, 0.3), time=90.0)
    scene.learner.note_accepted(replace(candidate, touch=measured))
    saved = checkpoint.from_bytes(scene.learner.checkpoint, scene.learner.robot)
    assert saved.version == candidate.version
    newer = scene.propose(replace(initial, touch=unmeasured))
    for touch in (saved.touch, newer.touch):
        assert touch.time == 90.0
        np.testing.assert_array_equal(touch.spread, 0.3)
