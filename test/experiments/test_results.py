# SPDX-License-Identifier: Apache-2.0
"""What result.json says of several individuals."""

from __future__ import annotations

import pytest

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.results import combined
from musculoskeletal_ae.experiments.study import Measured, Study


def test_result_json_has_means_over_seeds_but_counts_alarms_in_all(arm26, tmp_path):
    study = Study(arm26, 'default', (0, 1), 1.0, True, tmp_path)
    rows = {
        0: {'after_rad': 0.1, 'false_alarms': 1, 'first': {'error_rad': 0.2}, 'joint': 'elbow'},
        1: {'after_rad': 0.3, 'false_alarms': 2, 'first': {'error_rad': 0.4}, 'joint': 'elbow'},
    }
    content = combined(study, {seed: Measured(row, {}) for seed, row in rows.items()})
    assert content['after_rad'] == 0.2
    assert content['false_alarms'] == 3
    assert content['first']['error_rad'] == pytest.approx(0.3)
    assert content['joint'] == 'elbow'
    assert content['seeds']['1']['after_rad'] == 0.3


def test_a_number_that_json_cannot_say_is_refused(arm26, tmp_path):
    study = Study(arm26, 'default', (0,), 1.0, True, tmp_path)
    with pytest.raises(MusculoskeletalError, match='finite'):
        combined(study, {0: Measured({'deep': {'list': [1.0, float('nan')]}}, {})})
