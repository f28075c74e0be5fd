# SPDX-License-Identifier: Apache-2.0
"""Fixtures with the briefly trained networks, for one preset at a time."""

import pytest

from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot


@pytest.fixture(scope='session')
def robot() -> Robot:
    return Robot.load('arm26')


@pytest.fixture(params=['default', 'paper'])
def mae(request: pytest.FixtureRequest, trained: dict[str, Mae]) -> Mae:
    return trained[request.param]
