# SPDX-License-Identifier: Apache-2.0
"""What all tests share: one small arm, and one network of it that is trained once."""

from __future__ import annotations

import pytest
from hypothesis import settings

from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial import initial_mae
from musculoskeletal_ae.robot.robot import Robot

# Compiled code is loaded in somebody's first example; no test here judges time.
settings.register_profile('no deadline', deadline=None)
settings.load_profile('no deadline')


@pytest.fixture(scope='session')
def arm26() -> Robot:
    return Robot.load('arm26')


@pytest.fixture(scope='session')
def arm26_mae(arm26):
    """Return a network of arm26's geometric model, trained for a few seconds."""
    return initial_mae(arm26, steps=600).mae


@pytest.fixture(scope='session')
def arm26_checkpoint(arm26_mae, tmp_path_factory) -> str:
    """Return the checkpoint file of `arm26_mae`."""
    path = tmp_path_factory.mktemp('checkpoint') / 'arm26.safetensors'
    checkpoint.save(arm26_mae, path)
    return str(path)
