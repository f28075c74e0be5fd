# SPDX-License-Identifier: Apache-2.0
"""The measurement of heat runs and says how hot the windings are."""

from bench import heat
from musculoskeletal_ae.experiments.study import Study
from musculoskeletal_ae.mae import checkpoint


def test_winding_temperatures_of_an_emulated_arm_are_estimated_within_5_k(
    arm26, trained, tmp_path, monkeypatch
):
    monkeypatch.setattr(heat, 'HELD', 8.0)
    study = Study(arm26, 'default', (0,), 1.0, True, tmp_path)
    checkpoint.save(trained['default'], study.network_file('default', 0))
    numbers, traces = heat.measure(study, 0)
    assert numbers['core_error_k'] <= numbers['core_error_worst_k'] < 5.0
    assert numbers['heat_alarms'] == 0
    # It is the true winding that is compared with, which is warmer than the air.
    assert numbers['hottest_winding_c'] > 25.5
    assert traces['error'].shape == traces['core'].shape == (30, arm26.muscle_count)
