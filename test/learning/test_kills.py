# SPDX-License-Identifier: Apache-2.0
"""A learner that is killed loses nothing: the quick form of a part of `bench attack`.

Other tests check it in each run: test_state_directory.py simulates a kill at each step of saving,
and test/nodes/test_learner.py kills a whole node.
"""

import pytest

from bench.attack_kills import digest, grown, run, samples
from musculoskeletal_ae.learning.samples import SampleStore
from musculoskeletal_ae.mae import checkpoint


@pytest.mark.thorough
def test_a_killed_learner_loses_nothing(arm26, initial, tmp_path):
    file = tmp_path / 'initial.safetensors'
    checkpoint.save(initial, file)
    assert run(arm26, tmp_path / 'state', file, kills=1, seed=0) == []


def test_a_missing_sample_would_be_noticed(arm26):
    drawn = samples(arm26, 0)
    store = SampleStore()
    store.add(next(drawn))
    before = digest(store)
    without, more = grown(store, arm26, 1, 0)
    assert digest(without) == before != digest(more)
