# SPDX-License-Identifier: Apache-2.0
"""Learning while muscles are isolated: it uses no data of them, but learns from the others."""

import numpy as np

from learning.conftest import job
from learning.test_learner import IdleTrainer
from musculoskeletal_ae.learning.learner import Learner
from musculoskeletal_ae.learning.recordings import collect
from musculoskeletal_ae.tables.table import Table

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


def test_isolated_muscles_are_left_out_of_samples_and_of_the_next_update(
    arm26, initial, stage, tmp_path
):
    learner = Learner(arm26, initial, trainer=IdleTrainer, directory=tmp_path)
    for _ in range(3):
        learner.accept(stage.sample())
    learner.use_body(learner.body.with_isolated((LOST,)))
    learner.accept(stage.sample())
    assert [each.known[LOST] for each in learner.samples.stored] == [True] * 3 + [False]
    assert learner.trainer.jobs == []
    learner.poll(0.0)
    assert learner.trainer.jobs[-1].isolated == (LOST,)
    learner.close()
    again = Learner(arm26, trainer=IdleTrainer, directory=tmp_path)
    assert [each.known[LOST] for each in again.samples.stored] == [True] * 3 + [False]
    again.close()


def test_a_table_of_rests_teaches_nothing_of_the_readings_of_an_isolated_muscle(
    arm26, initial, stage
):
    theta, tension, length = stage.states(10)
    learner = Learner(arm26, initial, trainer=IdleTrainer)
    learner.use_body(learner.body.with_isolated((LOST,)))
    collect(learner, Table.of(arm26, theta, length, tension))
    samples = learner.samples.samples
    assert len(samples) == 10
    assert all(sample.tension[LOST] == sample.length[LOST] == 0.0 for sample in samples)
    used = np.arange(6) != LOST
    np.testing.assert_array_equal([sample.tension[used] for sample in samples], tension[:, used])


def test_an_update_follows_when_muscles_are_isolated_or_restored(arm26, initial, stage):
    learner = Learner(arm26, initial, trainer=IdleTrainer)
    for _ in range(3):
        learner.accept(stage.sample())
    changes = [(), (), (LOST,), (LOST,), ()]
    for number, isolated in enumerate(changes):
        learner.use_body(learner.body.with_isolated(isolated))
        learner.poll(10.0 * number)
    assert [job.isolated for job in learner.trainer.jobs] == [(), (LOST,), ()]


def test_a_restarted_learner_isolates_nothing_and_keeps_its_network_as_it_was(
    arm26, initial, tmp_path
):
    learner = Learner(arm26, initial.without((LOST,)), trainer=IdleTrainer, directory=tmp_path)
    learner.close()
    again = Learner(arm26, trainer=IdleTrainer, directory=tmp_path)
    assert again.isolated == ()
    assert again.mae.isolated == (LOST,)
    saved = again.checkpoint
    again.use_body(again.body.with_isolated((LOST,)))
    again.use_body(again.body.with_isolated(()))
    assert again.checkpoint == saved
    again.close()
