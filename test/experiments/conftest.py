# SPDX-License-Identifier: Apache-2.0
"""One quick run of every experiment and two small networks, which all tests here look at."""

from __future__ import annotations

import fcntl
from pathlib import Path

import pytest

from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.presets import PRESETS
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.tools import experiment

#: of exploration: enough for updates of both presets
MINUTES = 0.5


@pytest.fixture(scope='session')
def quick(tmp_path_factory, worker_id) -> Path:
    """The folder of `experiment all --quick` on the small arm, from two processes; once a run."""
    folder = tmp_path_factory.getbasetemp()
    shared = folder if worker_id == 'master' else folder.parent
    folder, done = shared / 'experiments', shared / 'experiments_done'
    with (shared / 'experiments_lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            options = f'all --robot arm26 --quick --minutes {MINUTES} --jobs 2 --out {folder}'
            assert experiment.main(options.split()) == 0
            done.touch()
    return folder


@pytest.fixture(scope='session')
def arm26() -> Robot:
    return Robot.load('arm26')


@pytest.fixture(scope='session')
def networks(arm26) -> dict[str, Mae]:
    """Networks of the geometric model by preset, trained for a moment."""
    return {preset: initial_mae(arm26, preset, steps=600).mae for preset in PRESETS}
