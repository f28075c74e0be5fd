# SPDX-License-Identifier: Apache-2.0
import pytest

from musculoskeletal_ae.robot.robot import Robot


@pytest.fixture(scope='session')
def robot() -> Robot:
    return Robot.load('arm26')
