# SPDX-License-Identifier: Apache-2.0
"""A healthy message of the geometric model, and faulty variants."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from musculoskeletal_ae.estimation.detectors.residual_distance import DISTANCE
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot


class Message(NamedTuple):
    """T [N] and l [m] of six muscles."""

    tension: np.ndarray
    length: np.ndarray


@pytest.fixture(scope='session')
def robot() -> Robot:
    return Robot.load('arm26')


@pytest.fixture(scope='session')
def mae(trained) -> Mae:
    return trained['default']


@pytest.fixture(scope='session')
def calibrated(mae) -> Mae:
    """Return the network with a calibrated detector of faults, whose threshold of d is 8."""
    statistics = replace(mae.anomaly, calibrated=True, thresholds={DISTANCE: 8.0})
    return replace(mae, anomaly=statistics)


@pytest.fixture
def healthy(robot) -> Message:
    theta, tension = 0.5 * (robot.lower + robot.upper), np.full(6, 60.0)
    return Message(tension, robot.muscle_lengths(theta, tension))


@pytest.fixture
def wound(healthy) -> Message:
    """Return a message in which muscle 1 has wound in by 10 cm."""
    return Message(healthy.tension, healthy.length - 0.1 * np.eye(6)[1])


@pytest.fixture
def slack(healthy) -> Message:
    """Return a message in which muscle 2 has no tension."""
    return Message(healthy.tension * (np.arange(6) != 2), healthy.length)
