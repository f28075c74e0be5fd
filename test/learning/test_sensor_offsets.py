# SPDX-License-Identifier: Apache-2.0
"""Joint-sensor offsets that no sensor can have are refused, and the learner says so."""

from dataclasses import replace

import pytest

from learning.conftest import job
from learning.test_learner import IdleTrainer
from musculoskeletal_ae.learning.body_updater import BodyUpdater
from musculoskeletal_ae.learning.learner import Learner


class OneUpdate(IdleTrainer):
    """A trainer that answers with one update."""

    answer = None

    def poll(self):
        update, self.answer = self.answer, None
        return update


@pytest.mark.parametrize(('offset', 'is_possible'), [(0.1, True), (1.0, False)])
def test_an_update_with_an_impossible_sensor_offset_is_not_published(
    arm26, initial, stage, offset, is_possible
):
    store = stage.store(20)
    for sample in list(store.samples):
        sample.theta[0] += offset
    update = BodyUpdater(arm26, initial).update(job(store))
    learner = Learner(arm26, initial, trainer=OneUpdate)
    version = learner.mae.version
    learner.trainer.answer = update._replace(mae=replace(update.mae, version=version))
    learner.poll(1.0)
    assert (learner.mae.version > version) == is_possible
    assert (arm26.joints[0] in learner.report().message) != is_possible
    assert (learner.report().level == 'error') != is_possible
