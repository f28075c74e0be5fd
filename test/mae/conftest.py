# SPDX-License-Identifier: Apache-2.0
"""One briefly trained network of each preset, shared by all tests of the MAE."""

from __future__ import annotations

import pytest

from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.robot.robot import Robot


@pytest.fixture(scope='session')
def robot() -> Robot:
    return Robot.load('arm26')


@pytest.fixture(scope='session')
def trained(robot: Robot) -> dict[str, Mae]:
    return {
        'default': initial_mae(robot, 'default', seed=3, steps=300).mae,
        'paper': initial_mae(robot, 'paper', seed=3, steps=300).mae,
    }


@pytest.fixture(params=['default', 'paper'])
def mae(request: pytest.FixtureRequest, trained: dict[str, Mae]) -> Mae:
    return trained[request.param]
