# SPDX-License-Identifier: Apache-2.0
"""What all tests share."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import settings

# Compiled code is loaded in somebody's first example; no test here judges time.
settings.register_profile('no deadline', deadline=None)
settings.load_profile('no deadline')


@pytest.fixture(scope='session')
def trained() -> dict[str, Any]:
    """Return briefly trained networks of arm26, by preset."""
    # Torch is loaded for tests that want a network only.
    from musculoskeletal_ae.mae.training import initial_mae
    from musculoskeletal_ae.presets import PRESETS
    from musculoskeletal_ae.robot.robot import Robot

    robot = Robot.load('arm26')
    return {preset: initial_mae(robot, preset, seed=3, steps=600).mae for preset in PRESETS}


@pytest.fixture(scope='session')
def trained_file(trained, tmp_path_factory) -> str:
    """Return a checkpoint file of the network of preset `default`."""
    from musculoskeletal_ae.mae import checkpoint

    path = tmp_path_factory.mktemp('checkpoint') / 'arm26.safetensors'
    checkpoint.save(trained['default'], path)
    return str(path)
