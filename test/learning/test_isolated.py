# SPDX-License-Identifier: Apache-2.0
"""Learning while muscles are isolated: it uses no data of them, but learns from the others."""

import numpy as np

from learning.conftest import job
from learning.test_learner import IdleTrainer
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.signals.body_state import Anomaly

LOST = 2


def test_readings_of_an_isolated_muscle_do_not_change_its_body(learned):
    _, updater, store, stage = learned
    theta, tension, _ = stage.states(100)

    def lengths():
        (length,) = updater.body.lengths(theta, tension, np.zeros_like(tension))
        return length[:, LOST]

    before = lengths()
    known = np.arange(6) != LOST
    for _ in range(15):
        sample = stage.sample()
        lost = sample._replace(tension=sample.tension * known, length=sample.length * known)
        store.add(lost, known.copy())
    update = updater.update(job(store)._replace(isolated=(LOST,)))
    moved = np.abs(lengths() - before).max()
    # The body of the isolated muscle changes slightly, because the lengths of the other muscles
    # still improve the postures of the samples.
    assert moved < 3e-4
    assert update.mae.isolated == (LOST,)
    assert update.changed == ()
    assert np.isfinite(update.loss)


def test_isolated_muscles_and_samples_outlast_a_restart_of_the_learner(
    arm26, initial, stage, tmp_path
):
    learner = Learner(arm26, initial, trainer=IdleTrainer, directory=tmp_path)
    for _ in range(3):
        learner.accept(stage.sample())
    learner.isolate((LOST,))
    body = learner.body
    learner.accept(stage.sample()._replace(isolated=body.isolated))
    assert [known[LOST] for known in learner.samples.known] == [True] * 3 + [False]
    assert learner.trainer.jobs == []
    data = learner.poll(0.0)
    assert checkpoint.from_bytes(data, arm26).isolated == (LOST,)
    assert learner.trainer.jobs[-1].isolated == (LOST,)
    learner.close()
    again = Learner(arm26, trainer=IdleTrainer, directory=tmp_path)
    assert again.isolated == again.mae.isolated == (LOST,)
    assert len(again.samples) == 4
    assert [sample.isolated for sample in again.samples.samples] == [()] * 3 + [(LOST,)]
    again.isolate(())
    assert checkpoint.from_bytes(again.checkpoint, arm26).isolated == ()
    again.close()


def test_while_a_suspect_is_verified_nothing_is_published(arm26, initial):
    learner = Learner(arm26, initial, trainer=IdleTrainer)
    learner.use_body(learner.body.with_anomaly(Anomaly.FOUND, 0))
    version = learner.mae.version
    learner.isolate((LOST,))
    learner.isolate(())  # the verification has found that the muscle is healthy
    learner.use_body(learner.body.with_anomaly(Anomaly.ENDED, 0))
    assert learner.mae.version == version
    learner.use_body(learner.body.with_anomaly(Anomaly.FOUND, 0))
    learner.isolate((LOST,))
    learner.use_body(learner.body.with_anomaly(Anomaly.ENDED, 0))
    assert learner.mae.isolated == (LOST,)
