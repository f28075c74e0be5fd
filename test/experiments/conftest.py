# SPDX-License-Identifier: Apache-2.0
"""One quick run of every experiment, for all tests of this folder."""

from pathlib import Path

import pytest

from musculoskeletal_ae.experiments import results
from musculoskeletal_ae.experiments.study import Study
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools import experiment

#: duration of the exploration [min], long enough for samples of both presets and for updates of
#: preset `default`
MINUTES = 0.2
KEPT = 'experiments_kept'


@pytest.fixture(scope='session')
def quick(alone) -> Path:
    """Return the folder in which `experiment all --quick` has run once, on arm26."""
    with alone('experiments') as common:
        folder, done = common / 'experiments', common / 'experiments_done'
        if not done.exists():
            options = f'all --robot arm26 --quick --minutes {MINUTES} --jobs 1'
            files = f'--out {folder} --keep {common / KEPT}'
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(results, 'DPI', 30)  # plots are drawn faster
                assert experiment.main([*options.split(), *files.split()]) == 0
            done.touch()
    return folder


@pytest.fixture(scope='session')
def study(quick, arm26) -> Study:
    """Return access to the networks and streams that the quick run has kept."""
    return Study(arm26, 'default', (0,), MINUTES, True, quick.parent / KEPT)


@pytest.fixture(scope='session')
def arm26() -> Robot:
    return Robot.load('arm26')
