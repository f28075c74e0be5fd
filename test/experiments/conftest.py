# SPDX-License-Identifier: Apache-2.0
"""One quick run of every experiment, for all tests of this folder."""

from pathlib import Path

import pytest

from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools import experiment

#: duration of the exploration [min], long enough for updates of both presets
MINUTES = 0.25


@pytest.fixture(scope='session')
def quick(alone) -> Path:
    """Return the folder in which `experiment all --quick` has run once, on arm26."""
    with alone('experiments') as common:
        folder, done = common / 'experiments', common / 'experiments_done'
        if not done.exists():
            options = f'all --robot arm26 --quick --minutes {MINUTES} --jobs 2 --out {folder}'
            assert experiment.main(options.split()) == 0
            done.touch()
    return folder


@pytest.fixture(scope='session')
def arm26() -> Robot:
    return Robot.load('arm26')
